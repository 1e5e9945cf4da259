"""Small valid files of every format, and some with other contents, for the tests of
damaged files.
"""

import io
import json
import math
import struct
import zipfile
from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import Tensor

from mi_splat.io.formats.format import Saving
from mi_splat.io.loaded import arrays_of
from mi_splat.io.splat_files import format_to_write
from mi_splat.maths.rotation import multiply
from mi_splat.maths.sh import colour_to_dc, dc_to_colour
from mi_splat.scene import GaussianScene
from tests.gaussians import random_scene

WRITTEN = [".ply", ".glb", ".compressed.ply", ".sog", ".spz", ".splat"]
"""Endings of the formats that are written; OpenUSD, each of whose files is read by a
new process, is in test_usd.py.
"""


@cache
def valid(name: str) -> bytes:
    """A small valid file: 20 Gaussians of SH degree 1."""
    scene = arrays_of(tame_scene(20, 1))
    chosen, suffix = format_to_write(name)
    version = int(name[1]) if name.startswith("v") else None
    assert chosen.write is not None
    return bytes(chosen.write(scene, Saving(suffix=suffix, version=version)).data)


def rezipped(
    change: Callable[[dict[str, bytes]], None], method: int = zipfile.ZIP_STORED
) -> bytes:
    """The valid SOG with other members."""
    with zipfile.ZipFile(io.BytesIO(valid("a.sog"))) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, contents in members.items():
            archive.writestr(name, contents)
    return buffer.getvalue()


def gltf_document() -> dict[str, Any]:
    """The document of the valid glTF."""
    data = valid("a.glb")
    document: dict[str, Any] = json.loads(
        data[20 : 20 + struct.unpack_from("<I", data, 12)[0]]
    )
    return document


def gltf_with(change: Callable[[dict[str, Any]], None]) -> bytes:
    """The valid glTF with another document."""
    data = valid("a.glb")
    document = gltf_document()
    change(document)
    part = json.dumps(document).encode()
    part += b" " * (-len(part) % 4)
    body = (
        struct.pack("<I4s", len(part), b"JSON")
        + part
        + data[20 + struct.unpack_from("<I", data, 12)[0] :]
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def tame_scene(count: int, degree: int, *, seed: int = 0) -> GaussianScene:
    """Random Gaussians without any symmetry, whose values lie in the ranges of every
    format.
    """
    scene = random_scene(count, degree, seed=seed)
    generator = torch.Generator().manual_seed(seed + 1)
    sh = torch.rand(count, (degree + 1) ** 2, 3, generator=generator) * 1.8 - 0.9
    sh[:, 0] = colour_to_dc(torch.rand(count, 3, generator=generator))
    return scene.replace(sh=sh, opacities=scene.opacities.clamp(0.01, 0.99))


def degrees(one: Tensor, two: Tensor) -> Tensor:
    """(N,) angles between rotations of ellipsoids, which half turns about their own
    axes leave as they are.
    """
    first = one.double()
    second = two.double()
    half_turns = torch.cat(
        [torch.eye(4, dtype=torch.float64), -torch.eye(4, dtype=torch.float64)]
    )
    chords = torch.stack(
        [(first - multiply(second, turn)).norm(dim=1) for turn in half_turns]
    )
    return (chords.amin(dim=0) / 2).clamp(max=1).asin() * 4 * 180 / math.pi


def differences(one: GaussianScene, two: GaussianScene) -> dict[str, Tensor]:
    """Absolute differences by name, row by row: of logarithms for scales, degrees for
    rotations, colours for dc.
    """
    return {
        "means": (one.means.double() - two.means.double()).abs(),
        "scales": (one.scales.double().log() - two.scales.double().log()).abs(),
        "rotations": degrees(one.rotations, two.rotations),
        "opacities": (one.opacities.double() - two.opacities.double()).abs(),
        "colours": (
            (
                dc_to_colour(one.sh[:, 0].double())
                - dc_to_colour(two.sh[:, 0].double())
            ).abs()
        ),
        "sh": (one.sh[:, 1:].double() - two.sh[:, 1:].double()).abs(),
    }


def assert_close(one: GaussianScene, two: GaussianScene, **tolerances: float) -> None:
    """Raise unless all differences are within their tolerances, 2e-5 where none is
    given (0.05 degrees).
    """
    assert len(one) == len(two)
    assert one.degree == two.degree
    limits = {"rotations": 0.05, **tolerances}
    worst = {
        name: float(value.max())
        for name, value in differences(one, two).items()
        if value.numel()
    }
    wrong = {
        name: value for name, value in worst.items() if value > limits.get(name, 2e-5)
    }
    assert not wrong, f"too far apart: {wrong}, all: {worst}"
