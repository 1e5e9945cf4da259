"""A fraction with its numerator, denominator and interval."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

_Z = 1.959963984540054
"""Quantile of the normal distribution that leaves 2.5 % on each side."""
FIXED = "\u00a0"
"""A space at which no line is broken."""


def wilson(fraction: float, total: float) -> tuple[float, float]:
    """95 % Wilson score interval of a fraction of `total` independent draws (Wilson 1927); (0, 1) of none."""
    if not total:
        return 0.0, 1.0
    z, n, p = _Z, total, fraction
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(0.0, centre - half), min(1.0, centre + half)


def percent(fraction: float) -> str:
    """A fraction for people."""
    return f"{100 * fraction:.1f}".removesuffix(".0") + f"{FIXED}%"


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

    @classmethod
    def of(cls, value: Mapping[str, Any]) -> Rate:
        """A rate as `as_dict` makes it, with the interval that it has there."""
        rate = cls(successes=int(value["successes"]), total=int(value["total"]))
        low, high = map(float, value.get("interval") or rate.interval)
        if not (0 <= rate.successes <= rate.total and 0 <= low <= high <= 1):
            raise ValueError(f"a rate of {rate.successes} of {rate.total}, {low} to {high}")
        is_wilson = abs(low - rate.interval[0]) + abs(high - rate.interval[1]) < 1e-9
        return rate if is_wilson else replace(rate, resampled=(low, high))

    @property
    def fraction(self) -> float:
        """Successes over total."""
        return self.successes / self.total if self.total else 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval: the resampled one, or Wilson's; (0, 1) when nothing was counted."""
        return wilson(self.fraction, self.total) if self.resampled is None else self.resampled

    @property
    def failures(self) -> Rate:
        """The rate of those of which it does not hold."""
        return Rate(successes=self.total - self.successes, total=self.total)

    @property
    def counts(self) -> str:
        """Successes and total in a sentence."""
        return f"{self.successes:,} of {self.total:,}"

    @property
    def ends(self) -> str:
        """The 95 % interval for people."""
        low, high = map(percent, self.interval)
        return f"{low.removesuffix(f'{FIXED}%')} to {high}"

    @property
    def words(self) -> str:
        """Counts, fraction and interval for people; a dash if nothing was counted."""
        return f"{self.counts} = {percent(self.fraction)} ({self.ends})" if self.total else "-"

    def as_dict(self) -> dict[str, Any]:
        """Rate (None when nothing was counted), successes, total and interval, as JSON can hold them."""
        return {
            "rate": self.fraction if self.total else None,
            "successes": self.successes,
            "total": self.total,
            "interval": list(self.interval),
        }
