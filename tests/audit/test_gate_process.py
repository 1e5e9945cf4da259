"""`mi-splat gate` as a service: the processes that read files share limits and end
together, and no verdict is lost.
"""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from attacks.audits.judging import Judge, ReaderProcess
from mi_splat.audit.gate import CLAIMS, Policy
from mi_splat.io import save_splat
from mi_splat.ledger import Store
from mi_splat.process_group import GroupEndedError, Limits, ProcessGroup, members
from tests.audit.test_lint import cloud
from tests.project.layers import ROOT

LINT = Policy(claims=CLAIMS[:3])


@pytest.fixture(scope="module")
def reader() -> Iterator[ReaderProcess]:
    """One process that reads for all tests: importing torch takes seconds."""
    made = ReaderProcess(
        Limits(seconds=60.0, megabytes=4000.0), environment={"OMP_NUM_THREADS": "1"}
    )
    yield made
    made.close()


@pytest.fixture
def judge(reader: ReaderProcess, tmp_path: Path) -> Judge:
    return Judge(reader, LINT, Store(tmp_path / "store"))


def verdict(judge: Judge, file: str | Path) -> tuple[str, str]:
    """Verdict on a file, and why it was not judged."""
    judged = judge.judge({"file": str(file)})
    return LINT.verdict(judged.rows)["verdict"], judged.error


def test_what_is_no_file_of_a_disk_or_too_large_is_not_read(
    judge: Judge, tmp_path: Path
) -> None:
    with (tmp_path / "sparse.ply").open("wb") as file:
        file.truncate(3 << 40)
    os.mkfifo(tmp_path / "pipe.ply")
    started = time.monotonic()
    for name, why in (
        ("sparse.ply", "at most 2,000 MB, got 3,298,535 MB"),
        ("pipe.ply", "a regular file on a disk"),
        (".", "a regular file on a disk"),
        ("none.ply", "No such file"),
        ("/dev/zero", "a regular file on a disk"),
        ("/proc/self/maps", "a regular file on a disk"),
        ("a\0b.ply", "null"),
    ):
        told, error = verdict(judge, tmp_path / name)
        assert told == "not judged", name
        assert why in error
    assert time.monotonic() - started < 120  # reading one would never end


def test_a_record_belongs_to_a_content_and_knows_no_name(
    judge: Judge, tmp_path: Path
) -> None:
    names = [os.fsdecode(b"secret\xff.ply"), "uploads_of_b/b.ply"]
    (tmp_path / "uploads_of_b").mkdir()
    for name in names:
        save_splat(cloud(), tmp_path / "clean.ply")
        os.replace(tmp_path / "clean.ply", tmp_path / name)
        assert verdict(judge, tmp_path / name) == ("accept", "")
        (tmp_path / "junk.ply").write_text("junk")
        assert verdict(judge, tmp_path / "junk.ply")[0] == "refuse"
    store = tmp_path / "store"
    assert len(Store(store).keys()) == 2
    kept = b"".join(path.read_bytes() for path in store.rglob("*") if path.is_file())
    for word in ("secret", "uploads_of_b", "junk.ply", str(tmp_path)):
        assert word.encode() not in kept
    assert not [path for path in store.rglob("*") if "secret" in path.name]


def test_a_file_that_changes_while_it_is_read_has_no_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from attacks.audits import gated

    path = tmp_path / "a.ply"
    said = list[dict[str, Any]]()
    save_splat(cloud(), path)
    config = {"claims": CLAIMS[:3], "most_gaussians": 1000, "ending": ".ply"}
    request = {"files": {"splat": str(path)}, "config": config, "file_megabytes": 1.0}

    def change() -> bool:
        save_splat(cloud(seed=1), path)
        return True

    gated.answer(request, said.append, change)
    assert said[-1]["state"] == "failed"
    assert "{file}: expected a file that stays the same" in said[-1]["error"]


GROUP = """
import subprocess, sys, tempfile, time
from mi_splat.process_group import connection, inbox
pipe = connection(sys.argv[-1])
messages = inbox(pipe.recv_bytes)
tempfile.mkstemp()
code = "x = b'x' * 300_000_000; import time; time.sleep(60)"
child = subprocess.Popen([sys.executable, "-c", code])
pipe.send_bytes(b"ready")
time.sleep(60)
"""


@pytest.fixture
def group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ProcessGroup]:
    """A group whose first process waits, and whose second one takes 300 MB."""
    (tmp_path / "has_a_child.py").write_text(GROUP)
    monkeypatch.syspath_prepend(str(tmp_path))
    made = ProcessGroup("has_a_child")
    made.wait(Limits(seconds=60.0), time.monotonic())
    made.pipe.recv_bytes()
    yield made
    made.close()


def test_limits_hold_for_a_group_together(group: ProcessGroup) -> None:
    with pytest.raises(GroupEndedError, match="MB of memory, more than 200"):
        group.wait(Limits(seconds=60.0, megabytes=200.0), time.monotonic())
    with pytest.raises(GroupEndedError, match=r"ran longer than 0\.2 s"):
        group.wait(Limits(seconds=0.2), time.monotonic())


def test_a_group_ends_whole(group: ProcessGroup) -> None:
    leader = _leader("has_a_child")
    assert len(members(leader)) == 2
    assert not group.is_alone()
    assert [*group.folder.iterdir()]
    group.close()
    assert not members(leader)
    assert not group.folder.exists()


def test_a_group_ends_with_whoever_watches_it(group: ProcessGroup) -> None:
    leader = _leader("has_a_child")
    group.pipe.close()
    until_gone(leader)
    assert not group.folder.exists()


def test_a_group_ends_with_whoever_watches_it_while_it_imports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "imports_for_long.py").write_text("import time; time.sleep(60)")
    monkeypatch.syspath_prepend(str(tmp_path))
    group = ProcessGroup("imports_for_long")
    leader = _leader("imports_for_long")
    group.pipe.close()
    until_gone(leader)
    assert not group.folder.exists()
    group.close()


def _leader(module: str) -> int:
    """Number of the first process of a group that this process has started for a
    module.
    """
    if not Path("/proc/self/stat").exists():
        pytest.skip("no /proc")
    found = []
    for path in Path("/proc").iterdir():
        if not path.name.isdecimal():
            continue
        with contextlib.suppress(OSError):  # it has ended meanwhile
            text = (path / "stat").read_text()
            _, parent, its_group = text[text.rindex(")") + 2 :].split()[:3]
            is_own = int(parent) == os.getpid() and its_group == path.name
            if is_own and module in _command(path):
                found.append(int(path.name))
    (leader,) = found
    return leader


def _command(path: Path) -> str:
    return (path / "cmdline").read_text()


def until_gone(group: int, seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while members(group):
        assert time.monotonic() < end
        time.sleep(0.02)


def command(store: Path, *words: str) -> list[str]:
    return [
        sys.executable,
        "-m",
        "attacks",
        "gate",
        "--only",
        "lint",
        "--strict",
        "--store",
        str(store),
        *words,
    ]


def environment(tmp_path: Path) -> dict[str, str]:
    folder = tmp_path / "temporary"
    folder.mkdir(exist_ok=True)
    return {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(folder)}


def in_shell(tmp_path: Path, redirected: str, *words: str) -> int:
    """Exit status of the gate with its output redirected by a shell."""
    line = [
        "bash",
        "-c",
        f'"$@" {redirected}; exit ${{PIPESTATUS[0]}}',
        "bash",
        *command(tmp_path / "store", *words),
    ]
    return subprocess.run(
        line, env=environment(tmp_path), stderr=subprocess.DEVNULL, timeout=120
    ).returncode


ALSO = [
    pytest.param(words, marks=pytest.mark.nightly)
    for words in (">&-", "| head -0", "<&- >&- 2>&-")
]


@pytest.mark.parametrize("redirected", [">/dev/full", *ALSO])
def test_a_verdict_counts_whoever_can_read_it(redirected: str, tmp_path: Path) -> None:
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full")
    (tmp_path / "bad.ply").write_text("junk")
    sarif = tmp_path / "found.sarif"
    assert (
        in_shell(tmp_path, redirected, "--sarif", str(sarif), str(tmp_path / "bad.ply"))
        == 3
    )
    (run,) = json.loads(sarif.read_text())["runs"]
    assert [result["ruleId"] for result in run["results"]] == ["unreadable"]
    assert run["artifacts"][0]["properties"]["verdict"] == "refuse"


HUGE = 900_000


def slow_file(path: Path) -> Path:
    """An OpenUSD file that takes its reader half a minute."""
    path.write_bytes(
        b"#usda 1.0\n"
        + b"".join(b'def Xform "a%d" {}\n' % number for number in range(HUGE))
    )
    return path


def readers_of(process: int) -> dict[int, Sequence[int]]:
    """Processes of each group of readers that a gate has started."""
    found: dict[int, Sequence[int]] = {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            text = (path / "stat").read_text()
        except OSError:
            continue
        _, parent, its_group = text[text.rindex(")") + 2 :].split()[:3]
        if int(parent) == process and its_group == path.name:
            found[int(path.name)] = [*members(int(path.name))]
    return found


@pytest.mark.parametrize(
    "how", [signal.SIGTERM, pytest.param(signal.SIGKILL, marks=pytest.mark.nightly)]
)
def test_a_gate_that_is_ended_leaves_nothing(
    how: signal.Signals, tmp_path: Path
) -> None:
    pytest.importorskip("pxr")
    if not Path("/proc/self/stat").exists():
        pytest.skip("no /proc")
    words = [str(slow_file(tmp_path / "many.usda")), "--workers", "1"]
    gate = subprocess.Popen(
        command(tmp_path / "store", *words),
        env=environment(tmp_path),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    end = time.monotonic() + 90
    while not any(len(processes) > 1 for processes in readers_of(gate.pid).values()):
        assert time.monotonic() < end, (
            "the process that reads OpenUSD was never started"
        )
        time.sleep(0.05)
    groups = readers_of(gate.pid)
    gate.send_signal(how)
    started = time.monotonic()
    assert gate.wait(30) == (143 if how == signal.SIGTERM else -how)
    for group in groups:
        until_gone(group, 5.0)
    assert time.monotonic() - started < 3
    said, errors = gate.communicate()
    assert said == b""
    assert errors == (b"mi-splat: terminated\n" if how == signal.SIGTERM else b"")
    assert not [*(tmp_path / "temporary").iterdir()]
    assert not [*(tmp_path / "store").rglob("*.tmp")]


def hostile_files(folder: Path, count: int) -> list[Path]:
    """Tiny files, each of which wants something that it should not get."""
    kinds = [
        ("junk.ply", b"junk"),
        (
            "none.ply",
            (
                b"ply\nformat binary_little_endian 1.0\nelement vertex"
                b" 4000000000\nend_header\n"
            ),
        ),
        ("cut.spz", b"\x1f\x8b\x08\x00"),
        ("zip.sog", b"PK\x03\x04" + b"\xff" * 40),
        ("gltf.glb", b"glTF\x02\x00\x00\x00\xff\xff\xff\x7f"),
        ("short.splat", b"\x00" * 31),
        ("pickle.pt", b"\x80\x04cos\nsystem\n"),
        ("empty.ply", b""),
    ]
    made = []
    for number in range(count):
        name, data = kinds[number % len(kinds)]
        path = folder / f"{number} {name}"
        path.write_bytes(data + f"{number}".encode() * bool(data))
        made.append(path)
    os.mkfifo(folder / "pipe.ply")
    (folder / "circle.ply").symlink_to("circle.ply")
    (folder / os.fsdecode(b"\xff\n.ply")).write_bytes(b"junk")
    (folder / "folder.ply").mkdir()
    with (folder / "sparse.ply").open("wb") as file:
        file.truncate(1 << 42)
    special = [
        "pipe.ply",
        "circle.ply",
        os.fsdecode(b"\xff\n.ply"),
        "folder.ply",
        "sparse.ply",
    ]
    return made + [folder / name for name in special]


@pytest.mark.parametrize("count", [24, pytest.param(1000, marks=pytest.mark.nightly)])
def test_no_hostile_file_passes_or_ends_the_gate(count: int, tmp_path: Path) -> None:
    folder = tmp_path / "uploads"
    folder.mkdir()
    files = hostile_files(folder, count)
    save_splat(cloud(), folder / "honest.ply")
    sarif = tmp_path / "found.sarif"
    words = ["--json", "--sarif", str(sarif), "--workers", "2", "--seconds", "20"]
    words += [*map(str, files), str(folder / "honest.ply")]
    done = subprocess.run(
        command(tmp_path / "store", *words),
        env=environment(tmp_path),
        capture_output=True,
        timeout=600,
    )
    assert done.returncode == 3
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    verdicts = {line["file"]: line["verdict"] for line in lines}
    assert verdicts.pop(str(folder / "honest.ply")) == "accept"
    assert verdicts.keys() == {str(file) for file in files}
    assert set(verdicts.values()) <= {"refuse", "not judged"}
    (run,) = json.loads(sarif.read_text())["runs"]
    named = {
        result["locations"][0]["physicalLocation"]["artifactLocation"]["uri"]
        for result in run["results"]
    }
    assert len(named) == len(files), "each file that does not pass has a result"
    assert not [*(tmp_path / "temporary").iterdir()]


def test_a_store_on_a_full_disk_changes_no_verdict(
    reader: ReaderProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def is_full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Store, "keep", is_full)
    (tmp_path / "junk.ply").write_text("junk")
    judged = Judge(reader, LINT, Store(tmp_path / "store")).judge(
        {"file": str(tmp_path / "junk.ply")}
    )
    assert LINT.verdict(judged.rows)["verdict"] == "refuse"
    assert judged.record is None


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Path]:
    """A small disk of its own, without a free byte; only root can have one."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=32k", "tmpfs", str(folder)]
    if sys.platform != "linux" or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("no disk can be made")
    try:
        (folder / "store").mkdir()
        with contextlib.suppress(OSError):
            (folder / "fill").write_bytes(bytes(1 << 16))
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.nightly  # >/dev/full above is a full disk, too
def test_a_full_disk_changes_no_exit_status(full_disk: Path, tmp_path: Path) -> None:
    (tmp_path / "junk.ply").write_text("junk")
    sarif = full_disk / "found.sarif"
    words = command(
        full_disk / "store",
        "--sarif",
        str(sarif),
        "--workers",
        "1",
        str(tmp_path / "junk.ply"),
    )
    done = subprocess.run(
        words, env=environment(tmp_path), capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 3
    assert "junk.ply: refuse" in done.stdout
    assert "No space left on device" in done.stderr
    assert not sarif.exists()
    assert not [*full_disk.rglob("*.tmp")]


def test_a_sarif_file_is_replaced_only_when_forced(tmp_path: Path) -> None:
    (tmp_path / "package.json").write_text("mine")
    words = command(
        tmp_path / "store",
        "--sarif",
        str(tmp_path / "package.json"),
        str(tmp_path / "none.ply"),
    )
    done = subprocess.run(
        words, env=environment(tmp_path), capture_output=True, text=True
    )
    assert done.returncode == 1
    assert "something that is there" in done.stderr
    assert "--force" in done.stderr
    assert (tmp_path / "package.json").read_text() == "mine"


def test_the_action_installs_its_own_revision() -> None:
    """Its folder is three below the root of the revision that a workflow names; nothing
    comes from a registry.
    """
    folder = ROOT / ".github" / "actions" / "audit-splats"
    text = (folder / "action.yml").read_text()
    (line,) = (line for line in text.splitlines() if "pip install" in line)
    (path,) = re.findall(r'"\$\(realpath "\$ACTION/([./]+)"\)', line)
    assert "ACTION: ${{ github.action_path }}" in text
    assert (folder / path).resolve() == ROOT
    assert (ROOT / "pyproject.toml").is_file()
