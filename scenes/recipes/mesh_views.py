"""Views and depths of a mesh scene, path traced, for the recipes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from mi_splat.cameras.camera import Camera, View
from mi_splat.capture.path_tracer import PathTracer


def capture(
    scene: dict[str, Any] | Path,
    cameras: Sequence[Camera],
    *,
    samples: int = 32,
    seed: int = 0,
) -> list[View]:
    """Path-traced views of a mesh scene."""
    tracer = PathTracer(scene, samples=samples)
    return [
        View(camera, tracer.picture(camera, seed=seed + number))
        for number, camera in enumerate(cameras)
    ]


def depth_maps(
    scene: dict[str, Any] | Path, cameras: Sequence[Camera], *, seed: int = 0
) -> list[Tensor]:
    """Of each camera, (H, W) float32 distance from its centre to the first surface, 0
    where there is none.
    """
    tracer = PathTracer(scene, alpha=True)
    return [tracer.surface(camera, seed=seed)[1] for camera in cameras]
