"""Pictures of a Mitsuba scene, as a set that trainings read: an honest scene among files that hide something."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from attacks.cloak.config import CameraConfig
from attacks.cloak.setup import SET
from mi_splat.camera_sets import framing, tiers
from mi_splat.capture.settings import CaptureSettings
from mi_splat.capture.sources import open_source
from mi_splat.capture.writer import write_capture
from mi_splat.fields import Checked, at_least
from mi_splat.io.images import save_picture
from mi_splat.io.picture_files import load_picture

if TYPE_CHECKING:
    from mi_splat.ledger import Out

VARIES = (f"{SET}/capture.json",)


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotographedConfig(Checked):
    """How a scene is photographed."""

    cameras: CameraConfig  # they look at the point `height` above the origin
    exposure: Annotated[float, at_least(0, "stops")] = 0.0  # standard deviation; sRGB is scaled by 2^(drawn / 2.2)


def run(config: PhotographedConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Photograph the scene of a job."""
    cameras, source = config.cameras, open_source(str(inputs["scene"]))
    size = (cameras.size, cameras.size)
    distance, focal = framing(source.radius, fov=cameras.fov, size=size)
    distance = distance if cameras.distance is None else cameras.distance
    placed = {"distance": distance, "focal": focal, "size": size, **cameras.tiers}
    poses = tiers((0.0, 0.0, cameras.height), count=cameras.train, **placed)
    write_capture(
        source,
        poses,
        out.partial / SET,
        settings=CaptureSettings(samples=cameras.samples, rgba=True, points=cameras.points),
        on_step=partial(out.progress, "photographing the scene"),
    )
    if config.exposure > 0:
        _expose(out.partial / SET, config.exposure)
    os.replace(out.partial / SET, out / SET)


def _expose(folder: Path, deviation: float) -> None:
    rng = np.random.default_rng(0)
    for path in sorted(folder.rglob("*.png")):
        values = np.asarray(load_picture(path).convert("RGBA"), np.float64)
        values[..., :3] *= 2.0 ** (rng.normal(0.0, deviation) / 2.2)
        save_picture(values.clip(0, 255).round().astype(np.uint8), path)
