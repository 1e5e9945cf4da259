"""Saves that fail leave the old file, and none with it."""

import errno
import fcntl
import math
import os
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch

from mi_splat.errors import InvalidValueError
from mi_splat.io import SplatFileError, load_splat, save_splat
from mi_splat.io.documents import LOCK, atomic_write, write_all
from mi_splat.io.folders import check_unlocked, locked_folder, new_folder, own_folder
from mi_splat.scene import GaussianScene
from tests.gaussians import random_scene


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A file that is there before."""
    save_splat(random_scene(5), tmp_path / "a.ply")
    return tmp_path / "a.ply"


def alone(path: Path) -> None:
    """Nothing but the file itself lies in its folder."""
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EDQUOT])
@pytest.mark.parametrize("when", ["write", "fsync", "replace"])
def test_a_full_disk_leaves_the_old_file(
    code: int, when: str, old: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = old.read_bytes()

    def fail(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    with monkeypatch.context() as patch:
        patch.setattr(
            (
                "mi_splat.io.documents.write_all"
                if when == "write"
                else f"mi_splat.io.documents.os.{when}"
            ),
            fail,
        )
        with pytest.raises(
            SplatFileError,
            match=rf"{old}: expected a file that can be written, got .+; .+",
        ):
            save_splat(random_scene(7), old)
    assert old.read_bytes() == before
    alone(old)
    save_splat(random_scene(7), old)
    assert len(load_splat(old)) == 7


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError, MemoryError])
def test_an_interruption_leaves_the_old_file(
    error: type[BaseException], old: Path
) -> None:
    before = old.read_bytes()
    with pytest.raises(error), atomic_write(old) as file:  # noqa: PT012
        file.write(b"half")
        raise error
    assert old.read_bytes() == before
    alone(old)


REFUSED = {
    "folder.ply": "got a folder",
    "pipe.ply": "got a special file",
    "none/a.ply": "No such file or directory; check the path",
    "read_only.ply": "got a read-only file",
    f"{'x' * 300}.ply": "use a shorter name",
}


@pytest.mark.parametrize("name", REFUSED)
def test_odd_targets_are_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "folder.ply").mkdir()
    (tmp_path / "read_only.ply").write_text("old")
    os.mkfifo(tmp_path / "pipe.ply")
    before = names(tmp_path)
    # root may write everything
    monkeypatch.setattr("mi_splat.io.documents.os.access", lambda *_: False)
    with pytest.raises(SplatFileError, match=REFUSED[name]):
        save_splat(random_scene(1), tmp_path / name)
    assert names(tmp_path) == before


def test_values_that_could_not_be_loaded_are_not_saved(old: Path) -> None:
    before = old.read_bytes()
    scene = random_scene(9).to(dtype=torch.float64)
    for value in (math.nan, math.inf, 1e300, 2e9):
        changed = GaussianScene.unchecked(
            torch.full_like(scene.means, value), *scene.tensors()[1:]
        )
        for path in (old, old.with_suffix(".spz"), old.with_suffix(".glb")):
            with pytest.raises(
                InvalidValueError,
                match=r"scene: expected values .* finite in float32, up to 1e\+09",
            ):
                save_splat(changed, path)
    assert old.read_bytes() == before
    alone(old)


def test_permission_bits(old: Path) -> None:
    mask = os.umask(0o027)
    try:
        save_splat(random_scene(1), old.with_name("new.ply"))
    finally:
        os.umask(mask)
    assert stat.S_IMODE(old.with_name("new.ply").stat().st_mode) == 0o640
    old.chmod(0o604)
    save_splat(random_scene(2), old)
    assert stat.S_IMODE(old.stat().st_mode) == 0o604


@pytest.mark.parametrize("target", ["precious.ply", "none.ply"])
def test_a_link_is_replaced_and_not_what_it_leads_to(
    target: str, tmp_path: Path
) -> None:
    (tmp_path / "precious.ply").write_text("precious")
    (tmp_path / "link.ply").symlink_to(target)
    save_splat(random_scene(3), tmp_path / "link.ply")
    assert (tmp_path / "precious.ply").read_text() == "precious"
    assert names(tmp_path) == ["link.ply", "precious.ply"]
    assert not (tmp_path / "link.ply").is_symlink()


def test_partial_writes_are_completed(tmp_path: Path) -> None:
    class Slow:
        def __init__(self) -> None:
            self.data = b""

        def write(self, view: memoryview) -> int:
            self.data += bytes(view[:3])
            return min(3, len(view))

    slow = Slow()
    write_all(slow, memoryview(b"0123456789"))  # type: ignore[arg-type]
    assert slow.data == b"0123456789"


# Folders that one process has for itself


HOLDER = (
    "import sys; from mi_splat.io.folders import locked_folder\n"
    "with locked_folder(sys.argv[1]):\n"
    "    print('there', flush=True); input()"
)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def holder(folder: Path) -> subprocess.Popen[str]:
    """A process that has a folder for itself until it reads a line or is killed."""
    words = [sys.executable, "-c", HOLDER, str(folder), "a word"]
    process = subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "there\n"
    return process


def test_the_second_process_is_refused_and_told_by_whom(tmp_path: Path) -> None:
    with holder(tmp_path / "out") as first:
        (tmp_path / "out" / "config.json").write_text("")
        says = (
            rf"no other process .* in use by `-c .*'a word'`, process {first.pid} on"
            r" .+, since 20\d\d-.*; wait for"
        )
        with (
            pytest.raises(SplatFileError, match=says),
            own_folder(tmp_path / "out", "config.json"),
        ):
            raise AssertionError("two have it")
        with (
            pytest.raises(SplatFileError, match="in use by"),
            new_folder(tmp_path / "out", force=True),
        ):
            raise AssertionError("it would be replaced")
        first.communicate("\n")
    assert names(tmp_path / "out") == ["config.json"]
    with own_folder(tmp_path / "out", "config.json"):
        assert names(tmp_path / "out") == [LOCK, "config.json"]


def test_a_killed_process_has_nothing(tmp_path: Path) -> None:
    with holder(tmp_path / "out") as first:
        first.kill()
    assert names(tmp_path / "out") == [LOCK]
    with new_folder(tmp_path / "out") as folder:  # what is left there does not count
        (folder / "result.json").write_text("")
    assert names(tmp_path / "out") == ["manifest.json", "result.json"]
    (tmp_path / "out" / LOCK).write_text("")
    with own_folder(tmp_path / "out", "result.json"):
        pass
    assert names(tmp_path / "out") == ["manifest.json", "result.json"]


def test_a_thread_may_take_what_it_has_and_another_thread_may_not(
    tmp_path: Path,
) -> None:
    messages: list[str] = []

    def other() -> None:
        with pytest.raises(SplatFileError) as caught:
            check_unlocked(tmp_path)
        messages.append(str(caught.value))

    with locked_folder(tmp_path), locked_folder(tmp_path / "." / ""):
        check_unlocked(tmp_path)
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert f"process {os.getpid()} on" in messages[0]
    check_unlocked(tmp_path)
    assert names(tmp_path) == []


def test_a_lock_that_its_holder_just_removed_is_taken_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flock = fcntl.flock
    removed = [False]

    def late(descriptor: int, how: int) -> None:
        flock(descriptor, how)
        if not removed[0]:
            os.unlink(tmp_path / LOCK)
            removed[0] = True

    monkeypatch.setattr(fcntl, "flock", late)
    with locked_folder(tmp_path):
        assert names(tmp_path) == [LOCK]
        assert removed == [True]


def test_a_lock_that_another_process_made_anew_is_that_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flock = fcntl.flock

    def late(descriptor: int, how: int) -> None:
        monkeypatch.setattr(fcntl, "flock", flock)
        flock(descriptor, how)
        os.unlink(tmp_path / LOCK)
        others.append(holder(tmp_path))

    others: list[subprocess.Popen[str]] = []
    monkeypatch.setattr(fcntl, "flock", late)
    with pytest.raises(SplatFileError, match="in use by"), locked_folder(tmp_path):
        raise AssertionError("two have it")
    with others[0] as other:
        other.communicate("\n")


@pytest.mark.parametrize("kind", ["symbolic link", "hard link", "foreign file", "pipe"])
def test_a_lock_that_this_program_did_not_make_is_left_alone(
    kind: str, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    precious = tmp_path / "precious.txt"
    out.mkdir()
    precious.write_text("precious")
    if kind == "symbolic link":
        (out / LOCK).symlink_to("../precious.txt")
    elif kind == "hard link":
        os.link(precious, out / LOCK)
    elif kind == "foreign file":
        (out / LOCK).write_text("mine")
    else:
        os.mkfifo(out / LOCK)
    with (
        pytest.raises(
            SplatFileError, match=r"expected a lock of this program, got .*; delete it"
        ),
        locked_folder(out),
    ):
        raise AssertionError("it has the folder")
    assert precious.read_text() == "precious"
    assert names(out) == [LOCK]


def test_a_lock_that_leads_elsewhere_makes_and_changes_nothing(tmp_path: Path) -> None:
    """A link to a file that is not there would make it, and a second name of an empty
    file would fill it.
    """
    out = tmp_path / "out"
    absent = tmp_path / "absent.txt"
    empty = tmp_path / "empty.txt"
    out.mkdir()
    empty.write_bytes(b"")
    (out / LOCK).symlink_to(absent)
    with (
        pytest.raises(SplatFileError, match="expected a lock of this program"),
        locked_folder(out),
    ):
        raise AssertionError("it has the folder")
    assert not absent.exists()
    (out / LOCK).unlink()
    os.link(empty, out / LOCK)
    with (
        pytest.raises(SplatFileError, match="expected a lock of this program"),
        locked_folder(out),
    ):
        raise AssertionError("it has the folder")
    assert empty.read_bytes() == b""


def test_a_disk_without_locks_refuses_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(descriptor: int, how: int) -> None:
        raise OSError(errno.ENOLCK, "no locks available")

    monkeypatch.setattr(fcntl, "flock", none)
    with locked_folder(tmp_path):
        assert names(tmp_path) == [LOCK]


def test_a_link_that_leads_out_of_a_locked_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out" / "images").mkdir(parents=True)
    (tmp_path / "out" / "within").symlink_to("images")
    with locked_folder(tmp_path / "out"):
        pass
    (tmp_path / "out" / "images" / "deep").symlink_to("../..")
    with (
        pytest.raises(SplatFileError, match=r"got a link that leads out of the folder"),
        locked_folder(tmp_path / "out"),
    ):
        raise AssertionError("it is written into")
