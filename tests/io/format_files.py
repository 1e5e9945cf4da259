"""Small valid files of every format, and some with other contents, for the tests of damaged files."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from mi_splat.io.formats.compressed_ply import write_compressed_ply
from mi_splat.io.formats.gltf import write_glb
from mi_splat.io.formats.sog import write_sog
from mi_splat.io.formats.splat32 import write_splat
from mi_splat.io.formats.spz import write_spz
from mi_splat.io.formats.table import FORMATS
from mi_splat.io.formats.usd import write_usd
from tests.io.closeness import tame_scene

DATA = Path(__file__).parent / "data"
WRITTEN = [entry.suffix for entry in FORMATS if entry.writes and entry.suffix != ".usdc"]
"""Endings of the formats that are written; OpenUSD, each of whose files is read by a new process, is in test_usd.py."""


@cache
def valid(name: str) -> bytes:
    """A small valid file: 20 Gaussians of SH degree 1, or 40 of degree 2 for ksplat."""
    if name.endswith(".ksplat"):
        return gzip.decompress((DATA / f"{name}.gz").read_bytes())
    scene = tame_scene(20, 1)
    writers: dict[str, Callable[[], bytes]] = {
        "a.compressed.ply": lambda: write_compressed_ply(scene).data,
        "a.glb": lambda: write_glb(scene).data,
        "a.sog": lambda: write_sog(scene).data,
        "a.splat": lambda: write_splat(scene).data,
        "a.usdc": lambda: write_usd(scene, ".usdc").data,
        "a.usda": lambda: write_usd(scene, ".usda").data,
        "v2.spz": lambda: write_spz(scene, 2).data,
        "v3.spz": lambda: write_spz(scene, 3).data,
        "v4.spz": lambda: write_spz(scene, 4).data,
    }
    return writers[name]()


def rezipped(change: Callable[[dict[str, bytes]], None], method: int = zipfile.ZIP_STORED) -> bytes:
    """The valid SOG with other members."""
    with zipfile.ZipFile(io.BytesIO(valid("a.sog"))) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, contents in members.items():
            archive.writestr(name, contents)
    return buffer.getvalue()


def gltf_with(change: Callable[[dict[str, Any]], None]) -> bytes:
    """The valid glTF with another document."""
    whole = valid("a.glb")
    (size,) = struct.unpack_from("<I", whole, 12)
    document = json.loads(whole[20 : 20 + size])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + whole[20 + size :]
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
