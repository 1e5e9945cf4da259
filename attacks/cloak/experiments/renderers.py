"""Whether a cloaked splat hides its object in other renderers than the one that it was made with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from attacks.cloak import setup
from attacks.cloak.config import StudyConfig
from attacks.cloak.experiments.distance import camera_groups, count_found
from attacks.cloak.experiments.formats import psnr_between
from attacks.detectors.base import Detector
from mi_splat.cameras import Camera, RenderFn
from mi_splat.comparison.methods import load_method
from mi_splat.rendering import RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.sh import colour_to_dc

_OWN, _OTHERS = ("tile", "tile-antialiased", "ray", "ray-to-mean"), ("volprim",)


def renderers_of(settings: RenderSettings) -> dict[str, RenderFn]:
    """The renderers, as `mi_splat.comparison` names them; the first is the one that splats are trained with.

    Args:
        settings: Background and near plane.
    """
    found = {name: load_method(name, settings).render for name in _OWN}
    black = replace(settings, background=(0.0, 0.0, 0.0))
    for name in _OTHERS:
        found[name] = before(load_method(name, black).render, settings.background)
    return found


def before(render: RenderFn, background: tuple[float, float, float]) -> RenderFn:
    """A renderer of black backgrounds with another one: a white copy of the splat shows how much it covers."""

    def rendered(scene: GaussianScene, camera: Camera) -> Tensor:
        white = scene.replace(sh=colour_to_dc(torch.ones_like(scene.means))[:, None])
        covered = render(white, camera)
        return render(scene, camera) + (1 - covered) * torch.tensor(background).to(covered)

    return rendered


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
                place["psnr"] = None if render is first else psnr_between((scene, first), (scene, render), cameras)
                counts = count_found(study, target, scene, cameras, detectors, render=render)
                report += [{**place, "detector": detector, "found": found} for detector, found in counts.items()]
    return report
