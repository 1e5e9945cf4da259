"""Layers: for every Gaussian of an object one that shows each look, one behind the other.

Of K layers with opacities o / K, o / (K - 1), ..., o, front to back, each makes up a K-th of what one sees where o is
1. A layer that is black from a direction only darkens what is behind it, so each has K times the colour that it shows.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from attacks.cloak.layered.config import LayerConfig
from attacks.cloak.layered.switches import fit_switches
from attacks.cloak.triggers import Trigger
from mi_splat.cameras import Camera, View, project_points
from mi_splat.directions import Point
from mi_splat.errors import InvalidValueError, message
from mi_splat.scene import GaussianScene, check_scene, merge
from mi_splat.sh import colour_to_dc

_AT_ONCE = 256
"""Gaussians whose switches are found together."""


def depths(triggers: Sequence[Trigger], cameras: Sequence[Camera], *, centre: Point, shift: float = 0.0) -> Tensor:
    """(1 + L, D) degrees from D cameras to where each look changes, inside > 0; the first is what no trigger holds.

    Args:
        triggers: L triggers.
        cameras: D cameras.
        centre: (3,) point that the triggers' directions are measured from.
        shift: Degrees outside of the triggers' edges at which looks change.
    """
    inside = shift + torch.tensor(
        [[trigger.angle_to_edge(camera, centre=centre) for camera in cameras] for trigger in triggers]
    )
    return torch.cat([-inside.amax(0, keepdim=True), inside])


def layered(
    scene: GaussianScene,
    rows: Tensor,
    triggers: Sequence[Trigger],
    colours: Sequence[Tensor],
    *,
    cameras: Sequence[Camera],
    centre: Point,
    config: LayerConfig | None = None,
) -> GaussianScene:
    """A scene in which an object's Gaussians have one layer for what all see and one for each trigger.

    The first layer takes the place of the Gaussians that it is made of; the others come after all of the scene.

    Args:
        scene: The clean splat.
        rows: (N,) bool or indices of the object's Gaussians.
        triggers: From where another look is shown; no two of them hold one camera.
        colours: What each layer shows, (N, 3) sRGB, the benign one first.
        cameras: Cameras all around, at the distance that the object is looked at from.
        centre: (3,) point that the triggers' directions are measured from.
        config: How.

    Raises:
        InvalidValueError: There are not as many colours as layers, nothing is selected, or a trigger holds none or all
            of the cameras.
    """
    config = config or LayerConfig()
    check_scene("scene", scene)
    chosen = torch.nonzero(rows).flatten() if rows.dtype == torch.bool else rows
    count = 1 + len(triggers)
    if len(colours) != count or any(colour.shape != (len(chosen), 3) for colour in colours) or not len(chosen):
        got = f"{len(colours)} for {count} layers of {len(chosen)} Gaussians"
        raise InvalidValueError(message("colours", "an (N, 3) tensor for each layer", got, "give the benign one first"))
    scene = scene.with_degree(config.degree)
    part = scene.select(chosen)
    inside = depths(triggers, cameras, centre=centre, shift=config.shift)
    layers = []
    for number, (depth, colour) in enumerate(zip(inside, colours, strict=True)):
        switch = switches(part.means, cameras, depth, config)
        behind = functional.normalize(part.means - part.means.new_tensor(centre), dim=-1) * config.inset * number
        layers.append(
            part.replace(
                means=part.means - behind,
                opacities=part.opacities / (count - number),
                sh=_shown(switch.to(colour), count * colour),
            )
        )
    first = {
        name: getattr(scene, name).index_copy(0, chosen, getattr(layers[0], name))
        for name in ("means", "opacities", "sh")
    }
    return merge(scene.replace(**first), *layers[1:])


def switches(means: Tensor, cameras: Sequence[Camera], depth: Tensor, config: LayerConfig) -> Tensor:
    """(N, K) functions that show a look where `depth` exceeds the gap, for Gaussians at (N, 3) means.

    Each Gaussian has its own: the direction in which it sees a camera is not that in which the centre sees it.

    Args:
        means: (N, 3) world units.
        cameras: D cameras all around.
        depth: (D,) degrees inside the region of the look, outside < 0.
        config: Gap, degree and bounds.
    """
    positions = torch.stack([camera.position for camera in cameras]).to(means)
    found = []
    for some in torch.split(means, _AT_ONCE):
        directions = functional.normalize(some[:, None] - positions, dim=-1)
        found.append(
            fit_switches(
                directions,
                depth >= config.gap,
                depth <= -config.gap,
                degree=config.degree,
                weight=config.weight,
                lowest=config.lowest,
                black=config.black,
            )
        )
    return torch.cat(found)


def _shown(switch: Tensor, colour: Tensor) -> Tensor:
    """(N, K, 3) SH whose colour 0.5 + SH is `colour` times the switch."""
    sh = switch[:, :, None] * colour[:, None]
    sh[:, 0] += colour_to_dc(torch.zeros_like(colour))
    return sh


def seen_colours(means: Tensor, views: Sequence[View], fallback: Tensor) -> Tensor:
    """(N, 3) mean colour of the pixels in which (N, 3) points lie; `fallback` (N, 3) where no view shows one."""
    total, number = torch.zeros_like(means), means.new_zeros(len(means))
    for view in views:
        pixels, depth = project_points(means, view.camera)
        column, row = pixels.floor().long().unbind(-1)
        high, wide = view.image.shape[:2]
        there = (depth > 0) & (column >= 0) & (column < wide) & (row >= 0) & (row < high)
        total[there] += view.image.to(means)[row[there], column[there]]
        number += there
    return torch.where(number[:, None] > 0, total / number.clamp(min=1)[:, None], fallback)
