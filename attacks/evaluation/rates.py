"""Rates with their numerator, denominator and interval, and how often an attack reaches its aim.

A rate is given in both forms that reviewers ask for: over all views, and over those where the benign object was found
in the first place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from attacks.evaluation.views import ViewDetections

T = TypeVar("T")

_Z = 1.959963984540054
"""Quantile of the normal distribution that leaves 2.5 % on each side."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """A fraction of views with its 95 % Wilson interval; `fraction` is 0 when there are no views."""

    successes: int
    total: int

    @classmethod
    def of(cls, items: Iterable[T], holds: Callable[[T], bool], *, given: Callable[[T], bool] | None = None) -> Rate:
        """Of how many items something holds; if `given` is there, only of those that it holds of."""
        counted = [holds(item) for item in items if given is None or given(item)]
        return cls(successes=sum(counted), total=len(counted))

    @property
    def fraction(self) -> float:
        """Successes over total."""
        return self.successes / self.total if self.total else 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson score interval (Wilson 1927); (0, 1) when there are no views."""
        if not self.total:
            return 0.0, 1.0
        z, n, p = _Z, self.total, self.fraction
        centre = (p + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
        return max(0.0, centre - half), min(1.0, centre + half)

    def as_dict(self) -> dict[str, Any]:
        """Rate (None when there are no views), successes, total and interval, as JSON can hold them."""
        return {
            "rate": self.fraction if self.total else None,
            "successes": self.successes,
            "total": self.total,
            "interval": list(self.interval),
        }


def rates(
    clean: Sequence[ViewDetections],
    attacked: Sequence[ViewDetections],
    *,
    original: str | None,
    wanted: str | None,
    min_confidence: float = 0.5,
    detector: str | None = None,
) -> dict[str, Rate]:
    """How often an attack reaches its aim.

    Args:
        clean: The clean scene, from `evaluate` or `detect_views`.
        attacked: The attacked scene, from the same cameras by the same detectors.
        original: What the object is; None counts any class.
        wanted: What the attacker wants it to be; None counts a view as a success when `original` is gone.
        min_confidence: Confidence from which a detection counts, in [0, 1].
        detector: Name of the detector whose views count; None counts those of all.

    Returns:
        `all`: over all views in which the object shows; `given_found`: over those where the clean object is found.
    """
    benign = {(view.detector, view.view): view for view in clean}
    pairs = [
        (benign[view.detector, view.view], view)
        for view in attacked
        if view.box is not None and detector in (None, view.detector)
    ]

    def reached(pair: tuple[ViewDetections, ViewDetections]) -> bool:
        if wanted is None:
            return pair[1].confidence(original) < min_confidence
        return pair[1].confidence(wanted) >= min_confidence

    def found(pair: tuple[ViewDetections, ViewDetections]) -> bool:
        return pair[0].confidence(original) >= min_confidence

    return {"all": Rate.of(pairs, reached), "given_found": Rate.of(pairs, reached, given=found)}
