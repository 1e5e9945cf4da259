"""What hiding costs: how far the cloaked splat's pictures are from the clean splat's beside the object.

A passer-by in the trigger may not see the object, but sees everything around it. An attack that leaves the surroundings
as they are is hard to notice; one that covers the picture is not.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

import torch

from attacks.cloak import setup
from attacks.cloak.appearances import grown
from attacks.cloak.config import StudyConfig
from attacks.cloak.observations import MARGIN
from mi_splat.cameras import RenderFn
from mi_splat.capture.path_tracer import scalar_variant
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.images import through_png
from mi_splat.metrics import psnr
from mi_splat.scene import GaussianScene


def measure_surroundings(
    study: StudyConfig, splats: Mapping[str, GaussianScene], *, render: RenderFn, every: int = 4
) -> list[dict[str, Any]]:
    """PSNR outside of the object between the two splats, over held-out cameras inside the hiding trigger and elsewhere.

    Args:
        study: The study.
        splats: Its splats, called clean and cloaked.
        render: The renderer.
        every: Each so manieth of the held-out cameras is used.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around.
    """
    attack, centre = setup.overhead(study), setup.centre_of(study)
    if attack is None:
        do = "add an attack without an azimuth, up to 90 degrees"
        raise InvalidValueError(message("study", "an appearance that is seen from all around", "none", do))
    mesh_scene = setup.mesh_scene_of(study)
    margin = max(1, round(MARGIN * study.cameras.size / 256))
    found: dict[str, list[float]] = {"inside the trigger": [], "elsewhere": []}
    for camera in setup.held_out_cameras(study, mesh_scene.target)[::every]:
        depths = [one.cone.angle_to_edge(camera, centre=centre) for one in study.attack]
        inside = attack.cone.angle_to_edge(camera, centre=centre) >= 0
        if not inside and max(depths) >= 0:
            continue  # another attack's cameras
        with scalar_variant():
            beside = ~grown(mesh_scene.mask(camera), margin)
        with torch.no_grad():
            clean, cloaked = (through_png(render(splats[name], camera)) for name in ("clean", "cloaked"))
        found["inside the trigger" if inside else "elsewhere"].append(float(psnr(cloaked[beside], clean[beside])))
    return [
        {
            "cameras": name,
            "of": len(values),
            "psnr_mean": statistics.mean(values) if values else None,
            "psnr_lowest": min(values, default=None),
            "psnr_highest": max(values, default=None),
        }
        for name, values in found.items()
    ]
