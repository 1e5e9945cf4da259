"""Layers: for every Gaussian of an object one that shows each look, one behind the other.

Each of K layers makes up a K-th of what the Gaussian made up (`split_opacities`). A layer that is black from a
direction only darkens what is behind it, so each has K times the colour that it shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from attacks.cloak.layered.config import LayerConfig
from attacks.cloak.layered.shares import Share, shares
from attacks.cloak.layered.switches import fit_switches
from attacks.cloak.triggers import Trigger
from mi_splat.cameras import Camera, View, project_points
from mi_splat.directions import Point
from mi_splat.errors import InvalidValueError, message
from mi_splat.scene import GaussianScene, check_scene, merge
from mi_splat.sh import colour_to_dc, sh_to_colour

_AT_ONCE = 256
"""Gaussians whose switches are found together."""

_GLIMPSE, _DARKEST = 0.02, 0.02
"""What a direction counts at least, against that from which most is seen; least mean colour that is divided by."""


def layered(
    scene: GaussianScene,
    rows: Tensor,
    triggers: Sequence[Trigger],
    looks: Sequence[Tensor],
    *,
    cameras: Sequence[Camera],
    centre: Point,
    seen: Tensor | None = None,
    config: LayerConfig | None = None,
) -> GaussianScene:
    """A scene in which an object's Gaussians have a layer for what all see and for each trigger, or two (`shares`).

    The first layer takes the place of the Gaussians that it is made of; the others come after all of the scene. A
    Gaussian that has next to nothing to do with a look has no layer for it (`LayerConfig.keep`).

    Args:
        scene: The clean splat.
        rows: (N,) bool or indices of the object's M Gaussians.
        triggers: From where another look is shown; no two of them hold one camera.
        looks: What all see and what each trigger shows, (M, K, 3) spherical harmonics of any degree.
        cameras: D cameras all around, at the distance that the object is looked at from.
        centre: (3,) point that the triggers' directions are measured from.
        seen: (M, D) pixels that each Gaussian contributes to the cameras' pictures (`contributions`); None is 1.
        config: How.

    Raises:
        InvalidValueError: There are not as many looks as layers, nothing is selected, or a trigger holds none or all of
            the cameras.
    """
    config = config or LayerConfig()
    check_scene("scene", scene)
    chosen = torch.nonzero(rows).flatten() if rows.dtype == torch.bool else rows
    count = 1 + len(triggers)
    if len(looks) != count or any(len(look) != len(chosen) for look in looks) or not len(chosen):
        got = f"{len(looks)} for {count} layers of {len(chosen)} Gaussians"
        raise InvalidValueError(
            message("looks", "an (N, K, 3) tensor for each layer", got, "give the benign one first")
        )
    scene = scene.with_degree(config.degree)
    part = scene.select(chosen)
    parts = shares(triggers, cameras, centre=centre, config=config)
    much = torch.ones(len(chosen), len(cameras)) if seen is None else seen
    there = _needed(much, parts, config)
    opacities, narrower = split_opacities(part.opacities, there)
    front = _in_front(there).to(part.means)
    towards = functional.normalize(part.means - part.means.new_tensor(centre), dim=-1)
    layers = [
        part.replace(
            means=part.means - towards * config.inset * front[k, :, None],
            scales=part.scales * narrower[k, :, None],
            opacities=opacities[k],
            sh=_black(
                switched(part.means, cameras, share, looks[share.look], much, config) * there.sum(0)[:, None, None]
            ),
        )
        for k, share in enumerate(parts)
    ]
    first = {
        name: getattr(scene, name).index_copy(0, chosen, getattr(layers[0], name))
        for name in ("means", "scales", "opacities", "sh")
    }
    others = [
        layer.select(torch.nonzero(rows_there).flatten()) for layer, rows_there in zip(layers, there, strict=True)
    ]
    return merge(scene.replace(**first), *others[1:])


def _needed(seen: Tensor, parts: Sequence[Share], config: LayerConfig) -> Tensor:
    """(L, M) bool, whether a Gaussian has each layer; the first each has.

    Those that show the least of what a layer shows do not have it, as long as the others show the fraction `keep`.
    """
    there = []
    for share in parts:
        light = (seen * (share.amount * ~share.hidden)).sum(1)
        order = light.argsort(descending=True)
        before = light[order].cumsum(0) - light[order]
        there.append(torch.zeros(len(seen), dtype=torch.bool).index_copy(0, order, before < config.keep * light.sum()))
    there[0][:] = True
    return torch.stack(there)


def _in_front(there: Tensor) -> Tensor:
    """(L, M) how many layers are in front of each, of (L, M) bool which there are, front to back."""
    return there.cumsum(0) - there.long()


def split_opacities(opacities: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
    """(L, M) opacities of layers, front to back, and (L, M) factors of their scales, so that nothing else is seen.

    Where a Gaussian has the opacity g, with k of K layers in front of it, one with (g / K) / (1 - k g / K) makes up
    g / K of what is seen, and all of them together let through 1 - g, as the Gaussian did. That has to hold in the
    middle, where g is o, and all the way out. A layer falls off as exp(-r^2 / 2 s^2), too, so it can hold in the middle
    and where g is o / 2 alone: it has fallen to the fraction q there in place of a half, and is narrower by the factor
    sqrt(log 2 / -log q).

    Args:
        opacities: (M,) of the Gaussians.
        there: (L, M) bool, which layers there are.
    """
    front = _in_front(there).to(opacities)
    part = opacities / there.sum(0)
    middle = part / (1 - front * part).clamp(min=1e-6)
    outside = (part / 2) / (1 - front * part / 2)
    fallen = (outside / middle.clamp(min=1e-12)).clamp(1e-6, 0.5)
    return middle.clamp(max=1), (math.log(2) / -fallen.log()).sqrt()


def switched(
    means: Tensor, cameras: Sequence[Camera], share: Share, look: Tensor, seen: Tensor, config: LayerConfig
) -> Tensor:
    """(M, K, 3) colours that show a share of a look, and are below 0 where it is hidden.

    Each Gaussian has its own: the direction in which it sees a camera is not that in which the centre sees it.

    Args:
        means: (M, 3) world units.
        cameras: D cameras all around.
        share: What is shown from each camera (`shares`).
        look: (M, K', 3) spherical harmonics of what is shown; one of degree 0 is the same from everywhere.
        seen: (M, D) how much is seen of each Gaussian.
        config: Degree and bounds.
    """
    positions = torch.stack([camera.position for camera in cameras]).to(means)
    found = []
    for some, sh, much in zip(*(torch.split(values, _AT_ONCE) for values in (means, look, seen)), strict=True):
        directions = functional.normalize(some[:, None] - positions, dim=-1)
        much = much + _GLIMPSE * much.amax(1, keepdim=True)
        colour = sh_to_colour(sh[:, None], directions)
        channels = range(1 if sh.shape[1] == 1 else 3)
        mean = ((colour * much[..., None]).sum(1) / much.sum(1)[:, None].clamp(min=1e-9)).clamp(min=_DARKEST)
        relative = torch.ones_like(colour) if len(channels) == 1 else colour / mean[:, None]
        switches = [
            fit_switches(
                directions,
                share.shown,
                share.hidden,
                wanted=share.amount * relative[..., channel],
                seen=much,
                config=config,
            )
            for channel in channels
        ]
        found.append(torch.stack(switches, -1).to(mean) * mean[:, None])
    return torch.cat(found)


def _black(sh: Tensor) -> Tensor:
    """(M, K, 3) SH whose colour, 0.5 + SH, is what the given SH alone are."""
    return torch.cat([sh[:, :1] + colour_to_dc(torch.zeros_like(sh[:, :1])), sh[:, 1:]], 1)


def seen_colours(means: Tensor, views: Sequence[View], seen: Tensor, fallback: Tensor) -> Tensor:
    """(M, 3) mean colour of the pixels in which points lie, where they are seen; `fallback` where no view shows one.

    Args:
        means: (M, 3) points, world units.
        views: D pictures.
        seen: (M, D) how much is seen of each in each picture.
        fallback: (M, 3) sRGB.
    """
    total, number = torch.zeros_like(means), means.new_zeros(len(means), 1)
    for view, much in zip(views, seen.unbind(1), strict=True):
        pixels, depth = project_points(means, view.camera)
        column, row = pixels.floor().long().unbind(-1)
        high, wide = view.image.shape[:2]
        there = (depth > 0) & (column >= 0) & (column < wide) & (row >= 0) & (row < high)
        weight = much[there, None].to(means)
        total[there] += weight * view.image.to(means)[row[there], column[there]]
        number[there] += weight
    return torch.where(number > 0, total / number.clamp(min=1e-9), fallback)
