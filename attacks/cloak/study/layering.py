"""The layers of a study: which Gaussians of the clean splat they are made of, and what each shows at first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from attacks.cloak.layered.layers import layered, seen_colours
from attacks.cloak.layered.shares import depths
from attacks.cloak.study import setup
from attacks.cloak.study.attack_config import AttackConfig
from attacks.cloak.study.config import StudyConfig
from mi_splat.assets.mesh import Asset
from mi_splat.camera_sets import hemisphere
from mi_splat.cameras import Camera, RenderFn, View
from mi_splat.errors import InvalidValueError, message
from mi_splat.frozen_view import FrozenView
from mi_splat.scene import GaussianScene
from mi_splat.selection.masks import box_mask
from mi_splat.selection.visibility import contributions
from mi_splat.sh import colour_to_dc, dc_to_colour
from mi_splat.view_freezing import freeze_views

DIRECTIONS = 400
"""Cameras over the hemisphere for which a layer's switch is made."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Layering:
    """The clean splat with the object in layers, and how their colours are trained.

    Attributes:
        scene: N Gaussians, before the training.
        trained: (N,) bool, those of the layers, and all others if the study wants it.
        views: The poisoned pictures, without those from where a look changes: a layer may show there what it likes.
        iterations: Steps of the training; each looks at one picture.
        geometry: Whether more than colours is trained.
    """

    scene: GaussianScene
    trained: Tensor
    views: list[View]
    iterations: int
    geometry: bool = False

    def rendered_by(self, render: RenderFn) -> RenderFn:
        """The same renderer, through which gradients reach what is trained.

        Where that is colours alone, the pictures of `views` come from frozen views as far as these fit; they are made
        with the first picture, of the scene as it is trained.
        """
        if self.geometry:
            return render
        frozen: dict[Camera, FrozenView] | None = None
        rows = None if bool(self.trained.all()) else self.trained.nonzero().flatten()

        def with_layers_trained(scene: GaussianScene, camera: Camera) -> Tensor:
            nonlocal frozen
            if frozen is None:
                cameras = [view.camera for view in self.views]
                pictures = self.iterations // len(cameras)
                frozen = freeze_views(scene, cameras, render=render, pictures=pictures, rows=rows)
            if camera in frozen:
                return frozen[camera](scene.sh if rows is None else scene.sh.index_select(0, rows))
            trained = self.trained[:, None, None]
            return render(scene.replace(sh=torch.where(trained, scene.sh, scene.sh.detach())), camera)

        return with_layers_trained


def layer_object(
    study: StudyConfig, clean: GaussianScene, target: Asset, views: Sequence[View], *, render: RenderFn
) -> Layering:
    """The clean splat with the object in layers.

    Args:
        study: A study with layers.
        clean: The victim's splat of clean pictures.
        target: The object.
        views: The poisoned pictures.
        render: The renderer, by which it is known which Gaussian is seen from where.

    Raises:
        InvalidValueError: The layers alone are more Gaussians than the study allows.
    """
    assert study.layers is not None
    making, centre = study.layers.making, setup.centre_of(study)
    cones = [attack.cone for attack in layered_attacks(study)]
    inside = depths(cones, [view.camera for view in views], centre=centre, config=making)
    decided = (inside.abs() >= 1).all(0)
    rows = torch.nonzero(object_rows(study, clean, target)).flatten()
    part = clean.select(rows)
    benign = dc_to_colour(part.sh[:, :1]).clamp(0, 1)[:, 0]
    looks = [part.sh]
    for depth in inside[1:]:
        showing = [view for view, keep in zip(views, (decided & (depth > 0)).tolist(), strict=True) if keep]
        seen = contributions(clean, [view.camera for view in showing], render=render, rows=rows)
        looks.append(colour_to_dc(seen_colours(part.means, showing, seen, benign))[:, None])
    cameras = hemisphere(centre, count=DIRECTIONS, **setup.lens_of(study, target))  # type: ignore[arg-type]
    scene = layered(
        clean,
        rows,
        cones,
        looks,
        cameras=cameras,
        centre=centre,
        seen=contributions(clean, cameras, render=render, rows=rows),
        config=making,
    )
    most = study.layers.max_gaussians
    if study.layers.geometry and len(scene) > most:
        got = f"{most:,}, and the layers make the splat one of {len(scene):,}"
        raise InvalidValueError(message("layers.max_gaussians", "room for the layers", got, "raise it"))
    trained = torch.arange(len(scene)) >= len(clean)
    trained[rows] = True
    kept = [view for view, keep in zip(views, decided.tolist(), strict=True) if keep]
    return Layering(
        scene=scene,
        trained=trained | study.layers.surroundings | study.layers.geometry,
        views=kept,
        iterations=study.layers.iterations,
        geometry=study.layers.geometry,
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
