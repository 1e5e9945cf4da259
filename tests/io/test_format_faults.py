"""Damaged files of every format: a valid scene or our one error, never another exception and never much memory."""

import gzip
import re
import struct
import tracemalloc
import warnings
from pathlib import Path

import hypothesis
import pytest
from hypothesis import strategies as st

from mi_splat.io import SplatFileError, SplatFileWarning, load_splat
from mi_splat.scene import GaussianScene
from tests.io.format_files import valid
from tests.io.ply_files import BODY, FACE, HEAD, LINE, LISTS, ROWS, TEXT_HEAD, listed, with_elements

MEMORY = 24 << 20

NAMES = ["a.compressed.ply", "a.glb", "a.sog", "a.splat", "v2.spz", "v3.spz", "v4.spz"]
PLY = {
    "a.ply": HEAD + BODY,
    "faces.ply": with_elements(FACE, b"\0\0"),
    "text.ply": TEXT_HEAD + LINE * 40,
    "lists.ply": listed("binary_little_endian", ROWS[:5], LISTS[:5]),
    "lists_in_text.ply": listed("ascii", ROWS[:5], LISTS[:5]),
}


def opened(path: Path) -> GaussianScene | None:
    """The scene, checked; None if the file was refused with our error."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SplatFileWarning)
        try:
            scene = load_splat(path, on_invalid="drop")
        except SplatFileError as error:
            assert re.match(rf"{re.escape(str(path))}.*: expected .+, got .+; .+", str(error), re.DOTALL)  # noqa: PT017
            assert len(str(error)) < len(str(path)) + 400  # noqa: PT017
            return None
    return GaussianScene(*scene.tensors())


@pytest.mark.parametrize("name", NAMES)
def test_truncation_at_each_length(name: str, tmp_path: Path) -> None:
    whole, path = valid(name), tmp_path / name
    lengths = sorted({*range(0, len(whole), max(1, len(whole) // 80)), *range(min(60, len(whole))), len(whole) - 1})
    tracemalloc.start()
    for length in lengths:
        path.write_bytes(whole[:length])
        scene = opened(path)
        assert scene is None or (name == "a.splat" and 32 * len(scene) == length)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < MEMORY
    path.write_bytes(whole + b"\0")
    scene = opened(path)
    assert scene is None or name in ("a.sog", *NAMES[-3:])  # an archive may have a comment, sections may be padded


def changed(data: st.DataObject, whole: bytes) -> bytes:
    """A file with a few bytes cut out, put in or replaced; mostly near its start, where sizes are."""
    damaged = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 3))):
        near = data.draw(st.sampled_from([24, 200, len(whole)]))
        start = data.draw(st.integers(0, min(near, len(damaged))))
        kind = data.draw(st.sampled_from(["cut", "insert", "change", "change", "number"]))
        if kind == "cut":
            del damaged[start : start + data.draw(st.integers(1, 50))]
        elif kind == "insert":
            damaged[start:start] = data.draw(st.binary(min_size=1, max_size=8))
        elif kind == "change":
            damaged[start : start + 4] = data.draw(st.binary(min_size=1, max_size=4))
        else:
            number = data.draw(st.sampled_from([0, 1, 255, 256, 2**16, 2**31 - 1, 2**31, 2**32 - 1]))
            damaged[start : start + 4] = struct.pack("<I", number)
    return bytes(damaged)


def small(path: Path, contents: bytes) -> None:
    """Open a damaged file with a bound on what is allocated."""
    path.write_bytes(contents)
    tracemalloc.start()
    opened(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < MEMORY


@pytest.mark.parametrize("name", [*NAMES, *PLY])
@hypothesis.settings(max_examples=25, deadline=None)
@hypothesis.given(data=st.data())
def test_damaged_files(name: str, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    small(tmp_path_factory.getbasetemp() / name, changed(data, PLY.get(name) or valid(name)))


@pytest.mark.parametrize("name", ["v2.spz", "v3.spz"])
@hypothesis.settings(max_examples=25, deadline=None)
@hypothesis.given(data=st.data())
def test_damage_inside_of_a_valid_gzip_stream(
    name: str, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    plain = gzip.decompress(valid(name))
    small(tmp_path_factory.getbasetemp() / name, gzip.compress(changed(data, plain), 1))
