"""Packages that are not what they should be are refused, in little memory and time."""

from __future__ import annotations

import gzip
import random
import tarfile
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from attacks.detectors.coco import archive
from attacks.detectors.coco.archive import read_members
from attacks.detectors.coco.sources import PUBLISHED
from attacks.detectors.errors import DetectorError
from tests.detectors.packages import README, WEIGHTS, members, published, tarball

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


def bomb_of_headers() -> bytes:
    """5 MB of empty members."""
    return packed(header("x", 0) * 10_000)


def bomb_of_pax() -> bytes:
    """A header of 64 MB, which a reader would keep whole."""
    record = b"a=" + bytes(1 << 26)
    return packed(header("x", len(record), tarfile.XHDTYPE), record)


def bomb_of_content() -> bytes:
    """A member that is larger unpacked than any package."""
    return packed(header("x", archive.LARGEST + 512), bytes(4096))


def chain_of_pax() -> bytes:
    """Headers of headers, each of which a reader descends into."""
    return packed(header("x", 0, tarfile.XHDTYPE) * 5000)


def cut() -> bytes:
    content = random.Random(0).randbytes(51_200)
    return packed(header(NAME, len(WEIGHTS)), WEIGHTS.ljust(512, b"\0"), header("x", 51_200), content)[:40_000]


def backwards() -> bytes:
    """A member of a size below zero, which leads back to itself."""
    return packed(header("x", -1024) + bytes(1024))


FAULTY: dict[str, tuple[Callable[[], bytes], str]] = {
    "no gzip": (lambda: b"PK\x03\x04 something", "expected a gzipped tar file"),
    "empty": (lambda: b"", "expected a whole .tgz file"),
    "no tar": (lambda: packed(b"x" * 2000), "expected a whole .tgz file"),
    "cut": (cut, "expected a whole .tgz file"),
    "many members": (bomb_of_headers, "bytes of headers, got more"),
    "a long header": (bomb_of_pax, "bytes of headers, got more"),
    "a long member": (bomb_of_content, "bytes unpacked, got more"),
    "nested headers": (chain_of_pax, "got"),
    "a negative size": (backwards, "expected"),
}


@pytest.mark.parametrize("fault", FAULTY)
def test_a_faulty_archive_is_refused_in_little_memory(fault: str, tmp_path: Path) -> None:
    make, said = FAULTY[fault]
    path = tmp_path / "a.tgz"
    path.write_bytes(make())
    tracemalloc.start()
    try:
        with pytest.raises(DetectorError) as refused:
            read_members(path, [FILE])
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert said in str(refused.value)
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
    content, said = OTHERS[what]
    with pytest.raises(DetectorError, match=said):
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


def test_what_is_published_is_pinned() -> None:
    for detector in PUBLISHED.values():
        for file in detector.files:
            assert file.member.startswith("package/models/")
            assert len(file.sha256) == 64
            assert file.size < 1 << 24
