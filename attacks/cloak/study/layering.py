"""The layers of a study: which Gaussians of the clean splat they are made of, and what each shows at first."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from attacks.cloak.layered.layers import layered, seen_colours
from attacks.cloak.study import setup
from attacks.cloak.study.config import AttackConfig, StudyConfig
from mi_splat.assets.mesh import Asset
from mi_splat.camera_sets import hemisphere
from mi_splat.cameras import View
from mi_splat.scene import GaussianScene
from mi_splat.selection.masks import box_mask
from mi_splat.sh import dc_to_colour

DIRECTIONS = 800
"""Cameras over the hemisphere for which a layer's switch is made."""


def layered_start(study: StudyConfig, clean: GaussianScene, target: Asset, views: Sequence[View]) -> GaussianScene:
    """The clean splat with the object in layers, before their colours are trained.

    Args:
        study: A study with layers.
        clean: The victim's splat of clean pictures.
        target: The object.
        views: The poisoned pictures.
    """
    assert study.layers is not None
    centre = setup.centre_of(study)
    chosen = layered_attacks(study)
    rows = torch.nonzero(object_rows(study, clean, target)).flatten()
    part = clean.select(rows)
    benign = dc_to_colour(part.sh[:, 0]).clamp(0, 1)
    cones = [attack.cone for attack in chosen]
    cameras = [view.camera for view in views]
    inside = [cone.holds(cameras, centre=centre) for cone in cones]
    colours = [
        seen_colours(part.means, [view for view, holds in zip(views, held.tolist(), strict=True) if holds], benign)
        for held in inside
    ]
    return layered(
        clean,
        rows,
        cones,
        [benign, *colours],
        cameras=hemisphere(centre, count=DIRECTIONS, **setup.lens_of(study, target)),  # type: ignore[arg-type]
        centre=centre,
        config=study.layers.making,
    )


def layered_attacks(study: StudyConfig) -> list[AttackConfig]:
    """The attacks whose appearances have layers of their own; all others are in the benign layer."""
    assert study.layers is not None
    return [attack for attack in study.attack if attack.name in study.layers.attacks]


def object_rows(study: StudyConfig, scene: GaussianScene, target: Asset) -> Tensor:
    """(N,) bool, the Gaussians in the box around the object, a little larger."""
    assert study.layers is not None
    (x0, y0, z0), (x1, y1, z1) = target.bounds.tolist()
    margin = study.layers.margin
    return box_mask(
        scene, (x0 - margin, y0 - margin, z0 + study.layers.clearance, x1 + margin, y1 + margin, z1 + margin)
    )
