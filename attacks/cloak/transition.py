"""How sharply a hidden appearance sets in: the transition of a cloaked splat, from pictures along an arc of cameras.

Between the directions of the benign appearance and those of the hidden one, a splat of few SH bands shows a blend of
the two. At each camera the fraction t of the way from the benign to the hidden picture is the least-squares projection
on the target's pixels, t = <c - b, h - b> / <h - b, h - b>: 0 is benign, 1 is hidden. The band lies between the angles
at which a monotone fit of t crosses 10 and 90 %.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.optimize import isotonic_regression
from torch import Tensor

from mi_splat.errors import InvalidValueError

LEAST_DIFFERENCE = 1 / 255
"""Root mean square difference of the two appearances on the target under which a fraction has no meaning."""
LEVELS = (0.1, 0.9)
"""Fractions at which the band starts and ends."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Transition:
    """Where a hidden appearance sets in, along an arc.

    Attributes:
        angles: K rising angles in degrees, each once.
        fractions: Mean fraction of the way between the appearances at each angle.
        fitted: The rising sequence nearest to `fractions`, by least squares.
        start: Angle at which `fitted` reaches the first of `LEVELS`; None if it is past it at the first angle, or never
            there.
        end: The same for the second.
    """

    angles: tuple[float, ...]
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
    if not (picture.shape == benign.shape == hidden.shape == (*mask.shape, 3) and mask.dtype == torch.bool):
        got = [tuple(part.shape) for part in (picture, benign, hidden, mask)]
        expected = "three of shape (H, W, 3) and a bool mask (H, W)"
        raise InvalidValueError.of("pictures", expected, got, "take them with one camera")
    if not bool(mask.any()):
        raise InvalidValueError.of("mask", "some pixels of the target", "none", "leave this camera out")
    seen, low, high = (part.detach().to(torch.float64)[mask] for part in (picture, benign, hidden))
    change = high - low
    if not bool(torch.isfinite(seen).all() & torch.isfinite(change).all()):
        raise InvalidValueError.of("pictures", "finite values", "nan or inf", "look at the renderer")
    if not differ(benign, hidden, mask):
        expected = f"appearances that differ by {LEAST_DIFFERENCE:.4f} or more on the mask"
        raise InvalidValueError.of("pictures", expected, "two that agree", "leave this camera out")
    return float((seen - low).mul(change).sum() / change.square().sum())


def differ(benign: Tensor, hidden: Tensor, mask: Tensor) -> bool:
    """Whether two (H, W, 3) appearances differ enough on an (H, W) bool mask for a transition to mean anything."""
    change = (hidden - benign).detach().to(torch.float64)[mask]
    return float(change.square().mean().sqrt()) >= LEAST_DIFFERENCE


def fit_transition(angles: Sequence[float], fractions: Sequence[float]) -> Transition:
    """The band in which a hidden appearance sets in."""
    if len(angles) != len(fractions) or len(set(angles)) < 2:
        got = f"{len(fractions)} at {len(set(angles))} of {len(angles)} angles"
        raise InvalidValueError.of("fractions", "one for each of two or more angles", got, "add cameras on the arc")
    if not all(map(math.isfinite, (*angles, *fractions))):
        raise InvalidValueError.of("fractions", "finite values", "nan or inf", "look at the pictures")
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
