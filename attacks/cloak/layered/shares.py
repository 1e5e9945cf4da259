"""Shares: which part of which look each layer shows, from each direction.

The cameras of a trigger see one look, all others the benign one. A look has one layer, or two: one for what is near its
edge and one for what is further inside. A polynomial that has to be 1 on all of its side is less steep at the edge than
one that may fall again further inside, where the other takes over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from attacks.cloak.layered.config import LayerConfig
from attacks.cloak.triggers import Trigger
from mi_splat.cameras import Camera
from mi_splat.directions import Point


def depths(
    triggers: Sequence[Trigger], cameras: Sequence[Camera], *, centre: Point, config: LayerConfig | None = None
) -> Tensor:
    """(1 + L, D) how far inside the region of each look D cameras are, in gaps: whole from 1, black below -1.

    The first look is what no trigger holds.

    Args:
        triggers: L triggers.
        cameras: D cameras.
        centre: (3,) point that the triggers' directions are measured from.
        config: Gaps and shift.

    Raises:
        InvalidValueError: There is another number of gaps than one for all or one for each trigger.
    """
    config = config or LayerConfig()
    return _in_gaps(_angles(triggers, cameras, centre, config), config)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Share:
    """What one layer shows of a look, for D cameras all around.

    Attributes:
        look: Number of the look, the benign one is 0.
        amount: (D,) in [0, 1], the part of the look that it shows; those of all layers of a look make 1.
        shown: (D,) bool, where it shows that part.
        hidden: (D,) bool, where it is black; where it is neither, it may be what it likes.
    """

    look: int
    amount: Tensor
    shown: Tensor
    hidden: Tensor


def shares(
    triggers: Sequence[Trigger], cameras: Sequence[Camera], *, centre: Point, config: LayerConfig | None = None
) -> list[Share]:
    """What each layer shows: one for each look, and one more for what is near the edge of a look that has a band.

    Args:
        triggers: L triggers; the first look is what no trigger holds.
        cameras: D cameras.
        centre: (3,) point that the triggers' directions are measured from.
        config: Gaps, bands and shift.

    Raises:
        InvalidValueError: There is another number of gaps than one for all or one for each trigger, or of bands than
            one for all or one for each look.
    """
    config = config or LayerConfig()
    angles = _angles(triggers, cameras, centre, config)
    sides, angles = _in_gaps(angles, config), _with_benign(angles)
    found = []
    for look, (depth, angle, band) in enumerate(zip(sides, angles, config.bands(len(sides)), strict=True)):
        far = (angle / band).clamp(0, 1) if band else torch.ones_like(angle)
        for amount in (far, 1 - far) if band else (far,):
            shown = (depth >= 1) & (amount > 0)
            hidden = (depth <= -1) | ((depth >= 1) & (amount == 0))
            found.append(Share(look=look, amount=amount, shown=shown, hidden=hidden))
    return found


def _angles(triggers: Sequence[Trigger], cameras: Sequence[Camera], centre: Point, config: LayerConfig) -> Tensor:
    """(L, D) degrees by which cameras are inside of where each trigger's look begins."""
    rows = [[trigger.angle_to_edge(camera, centre=centre) for camera in cameras] for trigger in triggers]
    return config.shift + torch.tensor(rows)


def _in_gaps(angles: Tensor, config: LayerConfig) -> Tensor:
    """(1 + L, D) of (L, D) degrees, how far inside cameras are in gaps, the benign look first."""
    inside = angles / torch.tensor(config.gaps(len(angles))).clamp(min=1e-6)[:, None]
    if config.apart:
        whole = inside >= 1
        elsewhere = (whole.sum(0) - whole.long() > 0) & ~whole
        inside = torch.where(elsewhere, inside.clamp(max=-1), inside)
    return _with_benign(inside)


def _with_benign(inside: Tensor) -> Tensor:
    """(1 + L, D) of (L, D): the benign look is as far inside as all others are outside."""
    return torch.cat([-inside.amax(0, keepdim=True), inside])
