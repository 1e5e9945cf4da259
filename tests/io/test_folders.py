"""Folders of results: checked first, whole or not at all, never over something else;
leftovers of kills are swept.
"""

import errno
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from mi_splat.errors import InvalidValueError
from mi_splat.io import documents
from mi_splat.io.documents import ASIDE, exchange, is_temporary, sweep_temporary
from mi_splat.io.errors import SplatFileError
from mi_splat.io.folders import (
    MANIFEST,
    check_new_folder,
    check_writable,
    files_in,
    new_folder,
    own_folder,
    read_manifest,
    write_manifest,
)


def names(folder: Path) -> list[str]:
    """What is in a folder, the manifest apart, which every new one has."""
    return sorted(path.name for path in folder.iterdir() if path.name != MANIFEST)


def result_in(folder: Path, text: str = "old") -> Path:
    with new_folder(folder) as made:
        (made / "result.json").write_text(text)
        (made / "before.png").write_text(text)
    return folder


def failing(out: Path, *, force: bool = False) -> None:
    """Fail when half of a folder is written."""
    with new_folder(out, force=force) as folder:
        (folder / "result.json").write_text("new")
        raise ZeroDivisionError


def have(out: Path, *records: str) -> None:
    """Have a folder for a moment, as a job that goes on where it stopped."""
    with own_folder(out, *records):
        pass


def test_what_fails_leaves_no_empty_folder(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError):
        failing(tmp_path / "out" / "deeper" / "detect")
    assert names(tmp_path) == []
    (tmp_path / "out").mkdir()
    with pytest.raises(ZeroDivisionError):
        failing(tmp_path / "out" / "deeper" / "detect")
    assert names(tmp_path) == ["out"], "what was there before stays"


def test_an_older_result_is_refused_or_replaced_whole(tmp_path: Path) -> None:
    out = result_in(tmp_path / "out")
    with pytest.raises(
        SplatFileError,
        match=(
            r"holds before\.png, manifest\.json, result\.json; .* or replace this"
            r" result with force"
        ),
    ):
        check_new_folder(out)
    with pytest.raises(ZeroDivisionError):
        failing(out, force=True)
    assert (out / "result.json").read_text() == "old"
    with new_folder(out, force=True) as folder:
        (folder / "result.json").write_text("new")
    assert names(out) == ["result.json"]
    assert names(tmp_path) == ["out"]


def test_the_old_result_comes_back_where_the_new_one_cannot_take_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(documents, "exchange", lambda first, second: False)
    out = result_in(tmp_path / "out")
    rename = os.rename

    def fails(source: os.PathLike[str], target: os.PathLike[str]) -> None:
        if os.fspath(target) == os.fspath(out) and (Path(source) / "new").exists():
            raise OSError(errno.EIO, "broken")
        rename(source, target)

    monkeypatch.setattr(os, "rename", fails)
    with (
        pytest.raises(
            SplatFileError,
            match=r"out: expected a name that .* got broken; see .*out-2, where",
        ),
        new_folder(out, force=True) as folder,
    ):
        (folder / "new").write_text("")
    assert names(out) == ["before.png", "result.json"]
    assert names(tmp_path / "out-2") == ["new"]
    assert names(tmp_path) == ["out", "out-2"]


KILLS = """
import os, shutil, signal, sys
from pathlib import Path
from mi_splat.io import documents
from mi_splat.io.folders import new_folder

def counted(function, step, point):
    def call(*words, **more):
        global done
        done += 1
        now = done
        if (now, point) == (step, "before"):
            os.kill(os.getpid(), signal.SIGKILL)
        try:
            return function(*words, **more)
        finally:
            if (now, point) == (step, "after"):
                os.kill(os.getpid(), signal.SIGKILL)
    return call

def replace(out, step, point):
    if not exchanges:
        documents.exchange = lambda first, second: False
    with new_folder(out, force=True) as made:
        for name in ("result.json", "after.png"):
            (made / name).write_text("new")
        documents.exchange = counted(documents.exchange, step, point)
        functions = [(os, name) for name in ("rename", "unlink", "rmdir")]
        for module, name in [*functions, (shutil, "rmtree")]:
            setattr(module, name, counted(getattr(module, name), step, point))

done = 0
exchanges = sys.argv[2] == "True"
for folder in Path(sys.argv[1]).iterdir():
    child = os.fork()
    if not child:
        point, step = folder.name.split()
        replace(folder / "out", int(step), point)
        os._exit(0)
    (folder / "ended").write_text(str(os.waitpid(child, 0)[1]))
"""
"""Replaces results, and is killed before or after one of the steps of that, as the
folder of each says.
"""


@pytest.mark.parametrize("exchanges", [True, False])
def test_a_kill_at_any_step_leaves_the_old_result_or_the_new_one(
    exchanges: bool, tmp_path: Path
) -> None:
    whole = {"old": ["before.png", "result.json"], "new": ["after.png", "result.json"]}
    folders = [
        tmp_path / f"{point} {step}"
        for step in range(1, 20)
        for point in ("before", "after")
    ]
    for folder in folders:
        result_in(folder / "out")
    subprocess.run(
        [sys.executable, "-c", KILLS, str(tmp_path), str(exchanges)], check=True
    )
    seen = []
    for folder in folders:
        for left in folder.glob(".*.tmp"):
            os.utime(left, (time.time() - 90,) * 2)
        check_new_folder(folder / "out", force=True)  # what the next command does first
        text = (folder / "out" / "result.json").read_text()
        assert names(folder / "out") == whole[text]
        assert names(folder) == ["ended", "out"]
        seen.append((text, int((folder / "ended").read_text())))
    killed = int(signal.SIGKILL)
    assert [*dict.fromkeys(seen)] == [("old", killed), ("new", killed), ("new", 0)]


def test_of_two_results_for_one_name_none_is_lost(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (tmp_path / "out-2").mkdir()

    def write(text: str, meanwhile: Callable[[], None]) -> None:
        with new_folder(out) as folder:
            (folder / "result.json").write_text(text)
            meanwhile()

    with pytest.raises(
        SplatFileError,
        match=r"wrote there meanwhile; see .*out-3, where this result is",
    ):
        write("second", meanwhile=lambda: write("first", meanwhile=lambda: None))
    assert (out / "result.json").read_text() == "first"
    assert (tmp_path / "out-3" / "result.json").read_text() == "second"
    assert names(tmp_path) == ["out", "out-2", "out-3"]


@pytest.mark.parametrize("exchanges", [True, False])
def test_a_folder_of_the_user_with_a_name_like_ours_is_never_touched(
    exchanges: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not exchanges:
        monkeypatch.setattr(documents, "exchange", lambda first, second: False)
    mine = [tmp_path / ".out.old", tmp_path / ".out.0123456789abcdef.old"]
    for folder in mine:
        folder.mkdir()
        (folder / "thesis.txt").write_text("precious")
    check_new_folder(tmp_path / "out", force=True)
    assert not (tmp_path / "out").exists()
    result_in(tmp_path / "out")
    with new_folder(tmp_path / "out", force=True) as folder:
        (folder / "result.json").write_text("new")
    assert names(tmp_path) == [".out.0123456789abcdef.old", ".out.old", "out"]
    assert [(folder / "thesis.txt").read_text() for folder in mine] == ["precious"] * 2
    assert names(tmp_path / "out") == ["result.json"]
    assert not (tmp_path / "out" / ASIDE).exists()


def test_names_are_exchanged_where_the_disk_can(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).touch()
    if not exchange(tmp_path / "a", tmp_path / "b"):
        pytest.skip("the disk exchanges no names")
    assert names(tmp_path / "a") == ["b"]
    assert not exchange(tmp_path / "a", tmp_path / "none")


def test_force_never_replaces_what_is_no_result(tmp_path: Path) -> None:
    (tmp_path / "photographs").mkdir()
    (tmp_path / "photographs" / "wedding.jpg").write_text("dear")
    with pytest.raises(SplatFileError, match="delete the folder yourself"):
        check_new_folder(tmp_path / "photographs", force=True)
    with pytest.raises(SplatFileError, match="holds photographs"):
        have(tmp_path, "config.json")


def hide(out: Path) -> None:
    """A file in a folder that the manifest leaves out."""
    document = json.loads((out / MANIFEST).read_text())
    (out / MANIFEST).write_text(json.dumps({**document, "without": ["src"]}))
    (out / "src").mkdir()
    (out / "src" / "a.py").write_text("")


def link(out: Path) -> None:
    (out / "before.png").rename(out.parent / "old.png")
    (out / "before.png").symlink_to("../old.png")


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda out: (out / "before.png").write_text("retouched"), "before.png"),
        (lambda out: (out / "mine.txt").write_text(""), "mine.txt"),
        (lambda out: (out / MANIFEST).unlink(), "before.png, result.json"),
        (lambda out: (out / ".git").mkdir(), ".git"),
        (link, "before.png"),
        (hide, "src/a.py"),
    ],
)
def test_force_replaces_only_what_the_manifest_lists(
    change: Callable[[Path], object], name: str, tmp_path: Path
) -> None:
    out = result_in(tmp_path / "out")
    change(out)
    before = sorted(out.rglob("*"))
    with pytest.raises(
        SplatFileError,
        match=rf"what its manifest\.json lists, got also {name}; move it elsewhere",
    ):
        check_new_folder(out, force=True)
    assert sorted(out.rglob("*")) == before


@pytest.mark.parametrize("where", [".", "..", "home"])
def test_the_working_directory_and_the_home_directory_are_never_replaced(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result_in(tmp_path / "out")
    (tmp_path / "out" / "in").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "out" if where == "home" else tmp_path))
    monkeypatch.chdir(
        tmp_path
        if where == "home"
        else tmp_path / "out" / ("in" if where == ".." else "")
    )
    with pytest.raises(
        SplatFileError,
        match=r"got (a folder above )?the (working|home) directory; pass another",
    ):
        check_new_folder("out" if where == "home" else where, force=True)
    assert (tmp_path / "out" / "result.json").read_text() == "old"


@pytest.mark.parametrize("below", [(), ("deeper",), ("deeper", "still")])
def test_a_file_in_the_way_is_seen_first(
    below: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    for check in (check_writable, check_new_folder, have):
        with pytest.raises(
            SplatFileError, match="expected a folder, or a free name, got the file"
        ):
            check(tmp_path.joinpath("file", *below))


def test_an_empty_folder_and_ones_own_can_be_used(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / ".0123456789abcdef.tmp").write_text("")
    check_new_folder(tmp_path / "empty")
    have(tmp_path / "empty")
    have(tmp_path / "none" / "deeper")
    have(result_in(tmp_path / "own"), "checkpoint", "result.json")
    assert names(tmp_path) == [
        "empty",
        "own",
    ], "a folder that nothing was written into is not left there"


WRITES = {
    "file": (
        "with atomic_write(sys.argv[1] + '/a.bin') as file:\n    file.write(b'part'); "
    ),
    "folder": "with new_folder(sys.argv[1] + '/a') as folder:\n    ",
}


@pytest.mark.parametrize("what", WRITES)
def test_leftovers_of_a_killed_program_are_swept_and_those_of_a_running_one_are_not(
    what: str, tmp_path: Path
) -> None:
    imports = (
        "import sys, time; from mi_splat.io.documents import atomic_write; from"
        " mi_splat.io.folders import new_folder\n"
    )
    command = [
        sys.executable,
        "-c",
        f"{imports}{WRITES[what]}print('writing', flush=True); time.sleep(60)",
    ]
    writer = subprocess.Popen([*command, str(tmp_path)], stdout=subprocess.PIPE)
    assert writer.stdout is not None
    assert writer.stdout.readline() == b"writing\n"
    (left,) = tmp_path.iterdir()
    assert is_temporary(left.name)
    os.utime(left, (time.time() - 90,) * 2)
    assert sweep_temporary(tmp_path) == 0
    writer.send_signal(signal.SIGKILL)
    writer.wait()
    writer.stdout.close()
    os.utime(left)
    assert sweep_temporary(tmp_path) == 0, (
        "a new one may be a file that its maker has not come to lock"
    )
    os.utime(left, (time.time() - 90,) * 2)
    assert sweep_temporary(tmp_path) == 1
    assert names(tmp_path) == []
    target = tmp_path / "of_the_user"
    target.write_text("kept")
    link = tmp_path / left.name
    link.symlink_to(target)
    os.utime(link, (0, 0), follow_symlinks=False)
    assert sweep_temporary(tmp_path) == 0, "this program makes no links"
    assert link.is_symlink()


# Every file of a result is in its manifest, and a manifest of strangers leads nowhere
# else


DIGEST = hashlib.sha256(b"x").hexdigest()


def test_a_folder_of_results_has_a_manifest_of_all_its_files(tmp_path: Path) -> None:
    with new_folder(tmp_path / "out") as folder:
        (folder / "result.json").write_text("x")
        (folder / "pictures").mkdir()
        (folder / "pictures" / "één a.png").write_text("x")
    manifest = read_manifest(tmp_path / "out")
    assert manifest.files == {
        "pictures/één a.png": (DIGEST, 1),
        "result.json": (DIGEST, 1),
    }
    assert (
        manifest.sha256
        == hashlib.sha256((tmp_path / "out" / MANIFEST).read_bytes()).hexdigest()
    )


def test_folders_that_are_no_part_are_left_out_and_links_are_not_followed(
    tmp_path: Path,
) -> None:
    (tmp_path / "stages").mkdir()
    (tmp_path / "stages" / "big.ply").write_text("x")
    (tmp_path / "a.txt").write_text("x")
    assert write_manifest(tmp_path, without=("stages",)) == write_manifest(
        tmp_path, without=("stages",)
    )
    assert read_manifest(tmp_path).files.keys() == {"a.txt"}
    assert read_manifest(tmp_path).without == ("stages",)
    (tmp_path / "link").symlink_to(tmp_path / "stages")
    assert [name for name, _ in files_in(tmp_path, ("stages",))] == ["a.txt", "link"]


@pytest.mark.parametrize(
    "name",
    [
        "../outside",
        "/etc/passwd",
        "a/../../x",
        ".hidden",
        "C:\\x",
        "a/b/c/d/e/f/g",
        "",
        "a\n",
    ],
)
def test_names_that_lead_elsewhere_are_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / MANIFEST).write_text(
        json.dumps({"without": [], "files": {name: {"sha256": DIGEST, "bytes": 1}}})
    )
    with pytest.raises(
        InvalidValueError, match="expected names of files in its folder"
    ):
        read_manifest(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "Expecting value"),
        ('{"files": [], "without": []}', "files, and folders without"),
        ('{"files": {"a": 3}, "without": []}', "sha256 and bytes of a"),
        (
            (
                f'{{"files": {{"a": {{"sha256": "{DIGEST}", "bytes": -1}}}}, "without":'
                " []}"
            ),
            "sha256 and bytes of a",
        ),
    ],
)
def test_a_broken_manifest_is_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / MANIFEST).write_text(text)
    with pytest.raises(InvalidValueError, match="get the result again") as error:
        read_manifest(tmp_path)
    assert message in str(error.value)
