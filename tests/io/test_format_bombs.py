"""Small files that claim, or expand to, half a gigabyte: refused in a process that
grows by less than 100 MB.
"""

import io
import json
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard

from mi_splat.io.formats.sog import picture_bytes
from tests.io.format_files import gltf_with, rezipped, valid
from tests.project.layers import ROOT

EXPANDED = 1 << 29
LOAD = """
import resource, sys
from mi_splat.io import SplatFileError, load_splat
load_splat(sys.argv[1])
unit = 1 if sys.platform == "darwin" else 1024
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
for path in sys.argv[2:]:
    try:
        load_splat(path)
    except SplatFileError as error:
        after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
        print(path, "refused", (after - before) >> 20, error)
    else:
        print(path, "loaded")
"""


def deflated(start: bytes, total: int) -> bytes:
    """A raw deflate stream of `start` and `total` zeros, without the work of
    compressing them all.
    """
    block = 1 << 24
    compressor = zlib.compressobj(9, zlib.DEFLATED, -15)
    first = compressor.compress(start) + compressor.flush(zlib.Z_FULL_FLUSH)
    zeros = compressor.compress(bytes(block)) + compressor.flush(zlib.Z_FULL_FLUSH)
    return first + zeros * (total // block) + compressor.flush()


def gzipped(start: bytes) -> bytes:
    return b"\x1f\x8b\x08\0\0\0\0\0\0\xff" + deflated(start, EXPANDED) + bytes(8)


def spz_header(version: int, count: int) -> bytes:
    return struct.pack(
        "<4sIIBBBB", b"NGSP", version, count, 0, 12, 0, 5 if version == 4 else 0
    )


def zipped(name: str, claimed: int) -> bytes:
    """A SOG in which one member expands to half a gigabyte, whatever it claims."""
    packed = deflated(b"", EXPANDED)
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(valid("a.sog"))) as source,
        zipfile.ZipFile(buffer, "w") as archive,
    ):
        for member in source.namelist():
            archive.writestr(member, packed if member == name else source.read(member))
    data = bytearray(buffer.getvalue())
    # method and sizes in both headers of the member
    for mark, offset in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        at = data.find(mark)
        while at >= 0:
            shift = 30 if mark == b"PK\x03\x04" else 46
            if data[at + shift : at + shift + len(name)] == name.encode():
                data[at + offset : at + offset + 2] = struct.pack(
                    "<H", zipfile.ZIP_DEFLATED
                )
                data[at + offset + 14 : at + offset + 18] = struct.pack("<I", claimed)
            at = data.find(mark, at + 1)
    return bytes(data)


def zstandard_bomb(count: int) -> bytes:
    """SPZ of version 4 whose first section expands to half a gigabyte."""
    frame = zstandard.ZstdCompressor(level=1).compressobj()
    packed = (
        b"".join(frame.compress(bytes(1 << 24)) for _ in range(EXPANDED >> 24))
        + frame.flush()
    )
    head = spz_header(4, count) + struct.pack("<I12x", 32)
    sizes = [(len(packed), 9 * count), *((0, size * count) for size in (1, 3, 3, 4))]
    return head + b"".join(struct.pack("<QQ", *pair) for pair in sizes) + packed


def wide_picture() -> bytes:
    """A WebP of one colour whose header claims 16384 x 16384 pixels, a gigabyte."""
    small = bytearray(picture_bytes(np.full((8, 8, 4), 7, np.uint8)))
    bits = struct.unpack_from("<I", small, 21)[0]
    struct.pack_into("<I", small, 21, bits | 0x0FFFFFFF)
    return bytes(small)


def sog_of(count: int) -> bytes:
    def change(members: dict[str, bytes]) -> None:
        meta = json.loads(members["meta.json"])
        members["meta.json"] = json.dumps({**meta, "count": count}).encode()
        members["means_l.webp"] = wide_picture()

    return rezipped(change)


def repeated_mesh() -> bytes:
    """A glTF that places one mesh a hundred thousand times."""
    count = 100_000
    nodes = [{"mesh": 0}] * count
    return gltf_with(
        lambda document: document.update(
            nodes=nodes, scenes=[{"nodes": list(range(count))}]
        )
    )


BOMBS: dict[str, Callable[[], bytes]] = {
    "claims.spz": lambda: gzipped(spz_header(3, EXPANDED // 20)),
    "hides.spz": lambda: gzipped(spz_header(3, 1)),
    "claims_v4.spz": lambda: zstandard_bomb(EXPANDED // 9),
    "hides_v4.spz": lambda: zstandard_bomb(1000),
    "claims.sog": lambda: zipped("meta.json", EXPANDED),
    "hides.sog": lambda: zipped("meta.json", 1000),
    "picture.sog": lambda: zipped("quats.webp", 400),
    "wide.sog": lambda: sog_of(20),
    "wide_count.sog": lambda: sog_of(1 << 28),
    "nodes.glb": repeated_mesh,
    "count.compressed.ply": (
        lambda: valid("a.compressed.ply").replace(b"vertex 20", b"vertex 999999999")
    ),
}


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What a process says of each file, one after the other."""
    folder = tmp_path_factory.mktemp("bombs")
    (folder / "fine.spz").write_bytes(valid("v3.spz"))
    for name, make in BOMBS.items():
        (folder / name).write_bytes(make())
        assert (folder / name).stat().st_size < 2_500_000, name
    words = [
        sys.executable,
        "-c",
        LOAD,
        str(folder / "fine.spz"),
        *(str(folder / name) for name in BOMBS),
    ]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    return {
        Path(line.split()[0]).name: line.split(" ", 1)[1]
        for line in done.stdout.splitlines()
    }


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_are_refused_within_little_memory(
    name: str, outcomes: dict[str, str]
) -> None:
    word, grown, text = outcomes[name].split(" ", 2)
    assert word == "refused"
    assert int(grown) < 100, text
