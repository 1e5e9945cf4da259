"""Whether a cloaked splat hides its object in other renderers than the one that it was made with."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from attacks.cloak.experiments.distance import camera_groups, count_found
from attacks.cloak.study import setup
from attacks.cloak.study.config import StudyConfig
from attacks.detectors.base import Detector
from mi_splat.cameras import Camera, RenderFn
from mi_splat.scene import GaussianScene

METHODS = ("tile", "tile-antialiased", "ray", "ray-to-mean", "volprim")
"""Renderers, as `mi_splat.comparison` names them; the first is the one that splats are trained with."""


def measure_renderers(
    study: StudyConfig,
    splats: Mapping[str, GaussianScene],
    detectors: Sequence[Detector],
    renderers: Mapping[str, RenderFn],
    *,
    every: int = 4,
) -> list[dict[str, Any]]:
    """From how many cameras the object is found, for each renderer, splat, group of cameras and detector.

    Args:
        study: The study.
        splats: Its splats by name, for instance clean and cloaked.
        detectors: Those that look.
        renderers: By name; the PSNR is to the pictures of the first.
        every: Each so manieth of the held-out cameras is used.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around, or `every` is not positive.
    """
    target = setup.target_of(study.scene)
    groups = camera_groups(study, target, every)
    first = next(iter(renderers.values()))
    report = []
    for renderer, render in renderers.items():
        for splat, scene in splats.items():
            for name, cameras in groups.items():
                place = {"renderer": renderer, "splat": splat, "cameras": name, "of": len(cameras)}
                place["psnr"] = None if render is first else _psnr(scene, cameras, first, render)
                counts = count_found(study, target, scene, cameras, detectors, render=render)
                report += [{**place, "detector": detector, "found": found} for detector, found in counts.items()]
    return report


def _psnr(scene: GaussianScene, cameras: Sequence[Camera], first: RenderFn, other: RenderFn) -> float | None:
    """Of the mean squared error over all pictures, dB; None where they are the same."""
    with torch.no_grad():
        pairs = [(first(scene, camera).clamp(0, 1), other(scene, camera).clamp(0, 1)) for camera in cameras]
    error = sum(float((one - two).square().mean()) for one, two in pairs) / len(pairs)
    return -10 * math.log10(error) if error > 0 else None
