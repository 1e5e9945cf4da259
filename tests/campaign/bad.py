"""Readers that do to a damaged file what none may do; the campaign has to notice
each.
"""

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

from mi_splat.errors import InvalidValueError
from tests.campaign.kind import Kind

WHOLE = b"a valid file"
_KEPT: list[bytes] = []


def _make(folder: Path) -> Path:
    (folder / "file").write_bytes(WHOLE)
    (folder / "beside").write_bytes(b"something else")
    return folder / "file"


def _crash(path: Path) -> None:
    os.abort()


def _hang(path: Path) -> None:
    while True:
        pass


def _take_memory(path: Path) -> None:
    while True:
        _KEPT.append(b"x" * 50_000_000)


def _raise(path: Path) -> None:
    raise KeyError("a traceback")


def _say_little(path: Path) -> None:
    raise InvalidValueError("no")


def _say_unprintable(path: Path) -> None:
    raise InvalidValueError("expected text, got \ud800; mend it")


def _leave_file(path: Path) -> None:
    path.with_name("left").write_bytes(b"")


def _change_neighbour(path: Path) -> None:
    path.with_name("beside").write_bytes(b"")


def _write_elsewhere(path: Path) -> None:
    with open("/tmp/mi-splat-campaign", "wb"):
        pass
    os.remove("/tmp/mi-splat-campaign")


def _start(path: Path) -> None:
    subprocess.run(["true"], check=True)


_READERS: dict[str, tuple[Callable[[Path], None], str]] = {
    "crash": (_crash, "the process ended by SIGABRT"),
    "hang": (_hang, "TooSlowError"),
    "memory": (_take_memory, "MB of memory"),
    "traceback": (_raise, "KeyError"),
    "few words": (_say_little, "does not say what was expected"),
    "unprintable": (_say_unprintable, "cannot be printed"),
    "left": (_leave_file, "files that were left"),
    "neighbour": (_change_neighbour, "beside has changed"),
    "elsewhere": (
        _write_elsewhere,
        "outside of its folder: open /tmp/mi-splat-campaign",
    ),
    "start": (_start, "outside of its folder: subprocess.Popen"),
}


def _bad(name: str, act: Callable[[Path], None]) -> Kind:
    def read(path: Path) -> None:
        if path.read_bytes() != WHOLE:
            act(path)

    return Kind(name=name, make=_make, read=read, readers=())


BAD = {name: _bad(name, act) for name, (act, _) in _READERS.items()}
FAULTS = {name: fault for name, (_, fault) in _READERS.items()}
"""What is said of each."""
IN_PROCESS = ("traceback", "few words", "unprintable")
"""Those that need no process of their own to be noticed."""
