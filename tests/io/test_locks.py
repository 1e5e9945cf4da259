"""Folders that one process has for itself."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from mi_splat.io.atomic import LOCK
from mi_splat.io.errors import SplatFileError
from mi_splat.io.folders import new_folder, own_folder
from mi_splat.io.locks import check_unlocked, locked_folder

fcntl = pytest.importorskip("fcntl")

HOLDER = (
    "import sys; from mi_splat.io.locks import locked_folder\n"
    "with locked_folder(sys.argv[1]):\n"
    "    print('there', flush=True); input()"
)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def holder(folder: Path) -> subprocess.Popen[str]:
    """A process that has a folder for itself until it reads a line or is killed."""
    words = [sys.executable, "-c", HOLDER, str(folder), "a word"]
    found = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert found.stdout is not None
    assert found.stdout.readline() == "there\n"
    return found


def test_the_second_process_is_refused_and_told_by_whom(tmp_path: Path) -> None:
    with holder(tmp_path / "out") as first:
        (tmp_path / "out" / "config.json").write_text("")
        says = rf"no other process .* in use by `-c .*'a word'`, process {first.pid} on .+, since 20\d\d-.*; wait for"
        with pytest.raises(SplatFileError, match=says), own_folder(tmp_path / "out", "config.json"):
            raise AssertionError("two have it")
        with pytest.raises(SplatFileError, match="in use by"), new_folder(tmp_path / "out", force=True):
            raise AssertionError("it would be replaced")
        first.communicate("\n")
    assert names(tmp_path / "out") == ["config.json"]
    with own_folder(tmp_path / "out", "config.json"):
        assert names(tmp_path / "out") == [LOCK, "config.json"]


def test_a_killed_process_has_nothing(tmp_path: Path) -> None:
    with holder(tmp_path / "out") as first:
        first.kill()
    assert names(tmp_path / "out") == [LOCK]
    with new_folder(tmp_path / "out") as place:  # what is left there does not count
        (place / "result.json").write_text("")
    assert names(tmp_path / "out") == ["manifest.json", "result.json"]
    (tmp_path / "out" / LOCK).write_text("")
    with own_folder(tmp_path / "out", "result.json"):
        pass
    assert names(tmp_path / "out") == ["manifest.json", "result.json"]


def test_a_thread_may_take_what_it_has_and_another_thread_may_not(tmp_path: Path) -> None:
    found: list[str] = []

    def other() -> None:
        with pytest.raises(SplatFileError) as caught:
            check_unlocked(tmp_path)
        found.append(str(caught.value))

    with locked_folder(tmp_path), locked_folder(tmp_path / "." / ""):
        check_unlocked(tmp_path)
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert f"process {os.getpid()} on" in found[0]
    check_unlocked(tmp_path)
    assert names(tmp_path) == []


def test_a_lock_that_its_holder_just_removed_is_taken_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flock, removed = fcntl.flock, [False]

    def late(descriptor: int, how: int) -> None:
        flock(descriptor, how)
        if not removed[0]:
            os.unlink(tmp_path / LOCK)
            removed[0] = True

    monkeypatch.setattr(fcntl, "flock", late)
    with locked_folder(tmp_path):
        assert names(tmp_path) == [LOCK]
        assert removed == [True]


def test_a_disk_without_locks_refuses_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(descriptor: int, how: int) -> None:
        raise OSError(errno.ENOLCK, "no locks available")

    monkeypatch.setattr(fcntl, "flock", none)
    with locked_folder(tmp_path):
        assert names(tmp_path) == [LOCK]


def test_what_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SplatFileError, match="expected a folder that can be written"), locked_folder(tmp_path / "file"):
        raise AssertionError("it is a file")
