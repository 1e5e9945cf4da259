"""A fraction with its numerator, denominator and interval."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

_Z = 1.959963984540054
"""Quantile of the normal distribution that leaves 2.5 % on each side."""


def wilson(fraction: float, total: float) -> tuple[float, float]:
    """95 % Wilson score interval of a fraction of `total` independent draws (Wilson 1927); (0, 1) of none."""
    if not total:
        return 0.0, 1.0
    z, n, p = _Z, total, fraction
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(0.0, centre - half), min(1.0, centre + half)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """A fraction of views, or of objects; `fraction` is 0 when there are none.

    Attributes:
        successes: Of how many it holds.
        total: How many were counted.
        resampled: 95 % interval where those counted are not independent; None where they are.
    """

    successes: int
    total: int
    resampled: tuple[float, float] | None = None

    @property
    def fraction(self) -> float:
        """Successes over total."""
        return self.successes / self.total if self.total else 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval: the resampled one, or Wilson's; (0, 1) when nothing was counted."""
        return wilson(self.fraction, self.total) if self.resampled is None else self.resampled

    def as_dict(self) -> dict[str, Any]:
        """Rate (None when nothing was counted), successes, total and interval, as JSON can hold them."""
        return {
            "rate": self.fraction if self.total else None,
            "successes": self.successes,
            "total": self.total,
            "interval": list(self.interval),
        }
