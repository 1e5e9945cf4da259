"""Arrays of unknown origin: nothing is allocated, unpacked or run that the size of the file does not bear."""

from __future__ import annotations

import io
import random
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mi_splat.io import SplatFileError
from mi_splat.io.arrays import load_array
from tests.project.layers import PACKAGES, ROOT


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
    "huge": (lambda: header("{'descr': '|b1', 'fortran_order': False, 'shape': (10000000000000,), }\n"), "asks for"),
    "negative": (lambda: header("{'descr': '|b1', 'fortran_order': False, 'shape': (-1, -5), }\n") + bytes(5), "bytes"),
    "deep": (lambda: header("(" * 5000), "npy"),
    "words": (lambda: header("__import__('os').system('touch ran')"), "npy"),
    "a kind that is none": (lambda: header("{'descr': 'x9', 'fortran_order': False, 'shape': (1,), }\n"), "npy"),
    "a shape that is none": (lambda: header("{'descr': '|b1', 'fortran_order': False, 'shape': 'a', }\n"), "shape"),
    "a long header": (lambda: b"\x93NUMPY\2\0" + b"\xff" * 4 + b" " * 20_000, "npy"),
    "another version": (lambda: header("{}", b"\3\0"), r"version 3\.0"),
    "objects": (lambda: saved(np.array([{}, None])), "pickled objects"),
    "an archive": (packed, "npy"),
    "cut off": (lambda: saved(np.arange(100))[:-1], "927 bytes where the header asks for 928"),
    "something behind": (lambda: saved(np.arange(100)) + b"1", "929 bytes"),
    "empty": (lambda: b"", "npy"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_array_is_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    [np.arange(12).reshape(3, 4), np.asfortranarray(np.arange(12.0).reshape(3, 4)), np.zeros(0, bool), np.array(3)],
)
def test_arrays_come_back(values: np.ndarray[Any, Any], tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", values)
    found = load_array(tmp_path / "a.npy")
    assert np.array_equal(found, values)
    assert found.dtype == values.dtype


def test_mutants_are_arrays_or_refused(tmp_path: Path) -> None:
    dice, data, path = random.Random(0), saved(np.arange(50) % 3 == 0), tmp_path / "a.npy"
    refused = 0
    for _ in range(300):
        mutant = bytearray(data)
        for _ in range(dice.randint(1, 4)):
            mutant[dice.randrange(128)] = dice.randrange(256)
        path.write_bytes(mutant[: dice.choice([len(mutant), dice.randrange(len(mutant))])])
        try:
            assert load_array(path).nbytes == 50
        except SplatFileError:
            refused += 1
    assert 100 < refused < 300


def test_no_array_is_loaded_elsewhere() -> None:
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    assert not [file for file in files if "np.load(" in file.read_text()]
