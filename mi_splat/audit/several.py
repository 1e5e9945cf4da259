"""Several looks of one object: when the strongest is taken off, is there another?"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from mi_splat.audit.results import EXCESS
from mi_splat.audit.surfaces import LEAST_VIEWS, Elements, Sight
from mi_splat.audit.switches import Scores, angles_between, cameras_of_look, explain

MOST_LOOKS = 3
_EDGE = 20.0
"""Degrees beyond the cameras of a look in which it may fade: they are left out with it."""
_STRONG = 0.4
"""Score of another look by that of the first, from which it is no ripple of it: spherical harmonics have some."""
_LEFT = 1 / 3
"""Share of the cameras that has to be left to look for another look."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """A look, and the surface as it was found on.

    Attributes:
        scores: How well each explanation fits.
        shown: (K,) bool, the cameras that see it.
        pieces: The surface, without what cameras see that were left out.
    """

    scores: Scores
    shown: Tensor
    pieces: Elements


def looks_of(pieces: Elements, view: Sight) -> list[Found]:
    """The look that explains most, and others that are hidden ones by themselves, found without the cameras before.

    Of a look the smaller side is left out, and what lies near it: no file can tell which side is the true one.

    Args:
        pieces: The surface.
        view: From where it was seen.

    Returns:
        At least one, and at most `MOST_LOOKS`.
    """
    found: list[Found] = []
    kept = torch.ones(len(view.cameras), dtype=torch.bool)
    for _ in range(MOST_LOOKS):
        scores = explain(pieces, view)
        another = scores.excess >= EXCESS
        if found and not (another and scores.direction >= _STRONG * found[0].scores.direction):
            break
        shown = cameras_of_look(pieces, view, scores) & kept
        found.append(Found(scores=scores, shown=shown, pieces=pieces))
        small = shown if 2 * int(shown.sum()) <= int(kept.sum()) else ~shown & kept
        if not another or not bool(small.any()):
            break
        kept = kept & (angles_between(view.directions, view.directions[small]).amin(1) > _EDGE)
        if int(kept.sum()) < _LEFT * len(kept):
            break
        moments = pieces.moments * kept.float()[None, :, None]
        judged = pieces.judged & (moments[..., 0].sum(1) >= LEAST_VIEWS)
        if not bool(judged.any()):
            break
        pieces = dataclasses.replace(pieces, moments=moments, judged=judged)
    return found
