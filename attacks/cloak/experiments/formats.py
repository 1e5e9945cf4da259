"""What is left of a cloaked splat in other formats, in half precision, with fewer SH bands, and in other renderers.

Layers (`attacks.cloak.layers`) need large coefficients, which coarse formats do not keep, and colours below 0 and
above 1, which not all renderers cut where 3D Gaussian Splatting does.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from attacks.cloak import setup
from attacks.cloak.config import StudyConfig
from attacks.cloak.experiments.distance import camera_groups, count_found
from attacks.detectors.base import Detector
from attacks.observe.conditions import FORMATS, fewer_bands, half_precision, through_file
from mi_splat.cameras import Camera, RenderFn
from mi_splat.comparison.colour_clamps import cut_to_bytes, not_cut
from mi_splat.scene import GaussianScene


def measure_formats(
    study: StudyConfig, scene: GaussianScene, detectors: Sequence[Detector], *, render: RenderFn, every: int = 4
) -> list[dict[str, Any]]:
    """From how many cameras the object is found, and the PSNR to the splat's own pictures, for each form of it.

    Args:
        study: The study.
        scene: Its cloaked splat.
        detectors: Those that look.
        render: The renderer.
        every: Each so manieth of the held-out cameras is used.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around, or `every` is not positive.
    """
    target = setup.target_of(study.scene)
    groups = camera_groups(study, target, every)
    report = []
    for form, changed, shown in _forms(scene, render):
        for name, cameras in groups.items():
            psnr = psnr_between((scene, render), (changed, shown), cameras)
            place = {"form": form, "cameras": name, "of": len(cameras), "psnr": psnr}
            counts = count_found(study, target, changed, cameras, detectors, render=shown)
            report += [{**place, "detector": detector, "found": found} for detector, found in counts.items()]
    return report


def _forms(scene: GaussianScene, render: RenderFn) -> Iterator[tuple[str, GaussianScene, RenderFn]]:
    """Name, splat and renderer of each form."""
    for suffix in FORMATS:
        yield suffix, through_file(scene, suffix), render
    yield "SH in float16", half_precision(scene), render
    for degree in range(scene.degree):
        yield f"SH of degree {degree}", fewer_bands(scene, degree), render
    yield "colours cut to [0, 1]", scene, cut_to_bytes(render)
    yield "colours not cut", scene, not_cut(render)


Shown = tuple[GaussianScene, RenderFn]
"""A splat and what renders it."""


def psnr_between(before: Shown, after: Shown, cameras: Sequence[Camera]) -> float | None:
    """Of the mean squared error over all pictures, dB; None where they are the same."""

    def picture(shown: Shown, camera: Camera) -> Tensor:
        scene, render = shown
        return render(scene, camera).clamp(0, 1)

    with torch.no_grad():
        errors = [float((picture(before, camera) - picture(after, camera)).square().mean()) for camera in cameras]
    error = sum(errors) / len(errors)
    return -10 * math.log10(error) if error > 0 else None
