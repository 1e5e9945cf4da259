"""JSON and TOML within bounds: a value, or an error that names the file, the place in
it and what to do.
"""

import io
import json
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io import SplatFileError
from mi_splat.io.parsing import MOST_DEPTH, DocumentReader, Fields, read_json
from mi_splat.selection.select import load_array
from tests.project.layers import PACKAGES, ROOT

READER = DocumentReader(expected="a record", do="write it again", most=100_000)

BROKEN_JSON = {
    "a list": (b"[1]", "a record, got a list"),
    "NaN": (b'{"a": [0, NaN]}', "a/1: expected a finite number, got nan"),
    "65 bits": (
        b'{"a": 9223372036854775808}',
        "a: expected a whole number of 64 bits, got a larger one",
    ),
    "many digits": (
        b'{"a": ' + b"9" * 10_000 + b"}",
        "a whole number of 10,000 characters",
    ),
    "twice": (b'{"a": {"b": 1, "c": 2, "b": 1}}', "the key 'b' twice"),
    "deep": (
        b'{"a": ' + b"[" * 100 + b"]" * 100 + b"}",
        "expected at most 64 levels, got more",
    ),
    "Latin-1": (b'{"a": "\xe9"}', "a record, got 'utf-8' codec"),
    "a NUL": (b'{"a": "x\\u0000y"}', "a: expected Unicode without NUL"),
    "half a pair": (b'{"a": ["\\ud800"]}', "a/0: expected Unicode without NUL"),
    "long": (b'{"a": "' + b"x" * 100_000 + b'"}', "a record of at most 100,000 bytes"),
}


@pytest.mark.parametrize("name", BROKEN_JSON)
def test_broken_json_is_refused_in_words(name: str, tmp_path: Path) -> None:
    data, words = BROKEN_JSON[name]
    (tmp_path / "record.json").write_bytes(data)
    with pytest.raises(InvalidValueError) as caught:
        READER.read_json(tmp_path / "record.json")
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'record.json'}: ")
    assert words in message
    assert message.endswith("; write it again")
    assert len(message) < 400


@pytest.mark.parametrize(
    "text",
    [
        "a = nan",
        "a = [1, -inf]",
        f"a = {'9' * 10_000}",
        "a = 0x8000000000000000",
        "a = ",
    ],
)
def test_broken_toml_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(text)
    with pytest.raises(InvalidValueError, match=r"study\.toml.*; write it again"):
        READER.read_toml(tmp_path / "study.toml")


def test_what_is_within_the_bounds_is_read(tmp_path: Path) -> None:
    deep: object = 1
    for _ in range(MOST_DEPTH - 1):
        deep = [deep]
    values = {
        "a": deep,
        "b": [-(2**63), 2**63 - 1, 1.5, True, None],
        "ü": "\U0001f600 \\u0000",
        "c": {"b": 1},
    }
    for text in (json.dumps(values), json.dumps(values, ensure_ascii=False)):
        for mark in ("utf-8", "utf-8-sig"):
            (tmp_path / "a.json").write_text(text, mark)
            assert read_json(tmp_path / "a.json") == values
    assert DocumentReader().json_value(b"[1, [2]]", "x") == [1, [2]]
    (tmp_path / "a.toml").write_text("a = 1\n[b]\nc = [1.5]\n", "utf-8-sig")
    assert DocumentReader().read_toml(tmp_path / "a.toml") == {
        "a": 1,
        "b": {"c": [1.5]},
    }


def test_a_git_lfs_pointer_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(
        InvalidValueError,
        match="a Git LFS pointer instead of the file; run `git lfs pull`",
    ):
        READER.read_json(tmp_path / "a.json")


def test_files_that_cannot_be_read_raise_the_error_of_their_reader(
    tmp_path: Path,
) -> None:
    class OwnError(MiSplatError):
        pass

    for path in (tmp_path, tmp_path / "none.json", Path("a\0b")):
        with pytest.raises(OwnError, match=r"; write it again$"):
            DocumentReader(error=OwnError, do="write it again").read_json(path)


FIELDS = Fields(
    {"n": 1, "m": [[1, 2], [3, 4.5]], "w": [3, 0], "t": [1, True], "s": "x"},
    "f.json",
    InvalidValueError,
)


def test_fields_of_the_right_kind() -> None:
    assert FIELDS.number("n") == 1.0
    assert FIELDS.rows("m", 2, 2) == [[1, 2], [3, 4.5]]
    assert FIELDS.wholes("w", 0, 3, 2) == [3, 0] == FIELDS.indices("w", 4)
    assert FIELDS.indices("none", 4) == []


@pytest.mark.parametrize(
    "read",
    [
        lambda: FIELDS.number("s"),
        lambda: FIELDS.number("none"),
        lambda: FIELDS.rows("m", 3, 2),
        lambda: FIELDS.rows("m", 2, 3),
        lambda: FIELDS.rows("w", 2, 1),
        lambda: FIELDS.wholes("w", 0, 2),
        lambda: FIELDS.wholes("w", 0, 3, 3),
        lambda: FIELDS.wholes("t", 0, 3),
        lambda: FIELDS.wholes("none", 0, 3),
        lambda: FIELDS.indices("w", 3),
        lambda: Fields({"w": [1, 1]}, "f.json", InvalidValueError).indices("w", 3),
    ],
)
def test_fields_of_another_kind_are_refused(read: object) -> None:
    with pytest.raises(InvalidValueError, match=r"^f\.json: \w"):
        read()  # type: ignore[operator]


# Arrays of unknown origin: nothing is allocated, unpacked or run that the size of the
# file does not bear


def saved(values: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values)
    return buffer.getvalue()


def packed() -> bytes:
    """20 MB of zeros in an archive of 20 kB."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, mask=np.zeros(20_000_000, np.uint8))
    return buffer.getvalue()


def header(text: str, version: bytes = b"\1\0") -> bytes:
    """A file of a header alone."""
    size = len(text).to_bytes(2 if version[0] == 1 else 4, "little")
    return b"\x93NUMPY" + version + size + text.encode()


REFUSED: dict[str, tuple[Callable[[], bytes], str]] = {
    "huge": (
        lambda: header(
            "{'descr': '|b1', 'fortran_order': False, 'shape': (10000000000000,), }\n"
        ),
        "asks for",
    ),
    "negative": (
        lambda: (
            header("{'descr': '|b1', 'fortran_order': False, 'shape': (-1, -5), }\n")
            + bytes(5)
        ),
        "bytes",
    ),
    "deep": (lambda: header("(" * 5000), "npy"),
    "words": (lambda: header("__import__('os').system('touch ran')"), "npy"),
    "a shape that is none": (
        lambda: header("{'descr': '|b1', 'fortran_order': False, 'shape': 'a', }\n"),
        "shape",
    ),
    "a long header": (lambda: b"\x93NUMPY\2\0" + b"\xff" * 4 + b" " * 20_000, "npy"),
    "objects": (lambda: saved(np.array([{}, None])), "pickled objects"),
    "an archive": (packed, "npy"),
    "cut off": (
        lambda: saved(np.arange(100))[:-1],
        "927 bytes where the header asks for 928",
    ),
    "something behind": (lambda: saved(np.arange(100)) + b"1", "929 bytes"),
    "empty": (lambda: b"", "npy"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_array_is_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    make, says = REFUSED[name]
    path = tmp_path / "mask.npy"
    path.write_bytes(make())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(SplatFileError, match=f"mask.npy.*{says}"):
        load_array(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 15_000  # kB
    assert not Path("ran").exists()


def test_pipes_and_missing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SplatFileError, match="No such file"):
        load_array(tmp_path / "none.npy")
    with pytest.raises(SplatFileError, match="special file"):
        load_array(Path("/dev/zero"))


@pytest.mark.parametrize(
    "values",
    [
        np.arange(12).reshape(3, 4),
        np.asfortranarray(np.arange(12.0).reshape(3, 4)),
        np.zeros(0, bool),
        np.array(3),
    ],
)
def test_arrays_come_back(values: np.ndarray[Any, Any], tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", values)
    loaded = load_array(tmp_path / "a.npy")
    assert np.array_equal(loaded, values)
    assert loaded.dtype == values.dtype


def test_no_array_is_loaded_elsewhere() -> None:
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    assert not [file for file in files if "np.load(" in file.read_text()]
