"""Poison that is corrected by what a splat trained on it shows: the attacker's own training takes the place of a guess.

A splat blurs what its pictures show from direction to direction, so that from a trigger's cameras it shows a blend of
the benign and the hidden look. What is missing there is added to the poison, as an integral controller does: with the
poison P of a round, the wanted picture W and what the surrogate R shows, the next is P + gain (W - R), clipped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from attacks.cloak.appearances import Appearance, grown, name_of
from mi_splat.cameras import Camera, View


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correction:
    """An appearance that adds what a splat trained on an earlier one does not show of what is wanted.

    Attributes:
        earlier: What the splat was trained on.
        wanted: What it should show.
        shown: (H, W, 3) in [0, 1], what it shows a camera.
        gain: How much of the difference is added.
        reach: Pixels around the target within which it is added; None is the whole picture.
    """

    earlier: Appearance
    wanted: Appearance
    shown: Callable[[Camera], Tensor]
    gain: float
    reach: int | None

    @property
    def name(self) -> str:
        """For manifests."""
        return f"{name_of(self.earlier)}, corrected by {self.gain:g} times what a splat lacks"

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The corrected picture, clipped to [0, 1]."""
        before = self.earlier(view, mask)
        after = (before + self.gain * (self.wanted(view, mask) - self.shown(view.camera).to(before))).clamp(0, 1)
        return after if self.reach is None else torch.where(grown(mask, self.reach)[..., None], after, before)
