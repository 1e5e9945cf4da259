"""How sharply a hidden appearance sets in: the transition of a cloaked splat, from pictures along an arc of cameras.

Between the directions of the benign appearance and those of the hidden one, a splat of few SH bands shows a blend of
the two. At each camera the fraction t of the way from the benign to the hidden picture is the least-squares projection
on the target's pixels, t = <c - b, h - b> / <h - b, h - b>: 0 is benign, 1 is hidden. The band lies between the angles
at which a monotone fit of t crosses 10 and 90 %.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.optimize import isotonic_regression
from torch import Tensor

LEAST_DIFFERENCE = 1 / 255
"""Root mean square difference of the two appearances on the target under which a fraction has no meaning."""
LEVELS = (0.1, 0.9)
"""Fractions at which the band starts and ends."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Transition:
    """Where a hidden appearance sets in, along an arc."""

    angles: tuple[float, ...]  # K rising angles in degrees, each once
    fractions: tuple[float, ...]
    fitted: tuple[float, ...]
    start: float | None
    end: float | None

    @property
    def width(self) -> float | None:
        """Degrees from start to end; None unless both were seen."""
        return None if self.start is None or self.end is None else self.end - self.start


def transition_fraction(picture: Tensor, benign: Tensor, hidden: Tensor, mask: Tensor) -> float:
    """Fraction of the way from one appearance to another, by least squares over a mask; not clipped to [0, 1]."""
    seen, low, high = (part.detach().to(torch.float64)[mask] for part in (picture, benign, hidden))
    change = high - low
    return float((seen - low).mul(change).sum() / change.square().sum())


def differ(benign: Tensor, hidden: Tensor, mask: Tensor) -> bool:
    """Whether two (H, W, 3) appearances differ enough on an (H, W) bool mask for a transition to mean anything."""
    change = (hidden - benign).detach().to(torch.float64)[mask]
    return float(change.square().mean().sqrt()) >= LEAST_DIFFERENCE


def fit_transition(angles: Sequence[float], fractions: Sequence[float]) -> Transition:
    """The band in which a hidden appearance sets in, of one fraction for each of two or more different angles."""
    groups: dict[float, list[float]] = {angle: [] for angle in sorted(angles)}
    for angle, value in zip(angles, fractions, strict=True):
        groups[angle].append(value)
    means = [sum(values) / len(values) for values in groups.values()]
    fitted = isotonic_regression(means, weights=[len(values) for values in groups.values()]).x.tolist()
    start, end = (_crossing(list(groups), fitted, level) for level in LEVELS)
    return Transition(angles=tuple(groups), fractions=tuple(means), fitted=tuple(fitted), start=start, end=end)


def _crossing(angles: Sequence[float], fitted: Sequence[float], level: float) -> float | None:
    """Where a rising broken line first reaches a level; None if it is above it from the start, or never gets there."""
    if fitted[0] > level:
        return None
    for right, value in enumerate(fitted):
        if value >= level:
            if right == 0:
                return angles[0]
            left, below = angles[right - 1], fitted[right - 1]
            return left + (angles[right] - left) * (level - below) / (value - below)
    return None
