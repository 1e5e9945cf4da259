"""A fraction with its numerator, denominator and interval."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

_Z = 1.959963984540054
"""Quantile of the normal distribution that leaves 2.5 % on each side."""
FEW = 10
"""Views, or attacks, from which on an interval says something."""
FIXED = "\u00a0"
"""A space at which no line is broken."""


def wilson(fraction: float, total: float) -> tuple[float, float]:
    """95 % Wilson score interval of a fraction of `total` independent draws (Wilson
    1927); (0, 1) of none.
    """
    if not total:
        return 0.0, 1.0
    z = _Z
    n = total
    p = fraction
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
        resampled: 95 % interval where those counted are not independent; None where
            they are.
    """

    successes: int
    total: int
    resampled: tuple[float, float] | None = None

    @classmethod
    def with_interval(
        cls, successes: int, total: int, interval: tuple[float, float]
    ) -> Rate:
        """A rate from a file."""
        low, high = interval
        if not (0 <= successes <= total and 0 <= low <= high <= 1):
            raise ValueError(f"a rate of {successes} of {total}, {low} to {high}")
        rate = cls(successes=successes, total=total)
        is_wilson = abs(low - rate.interval[0]) + abs(high - rate.interval[1]) < 1e-8
        if is_wilson:
            return rate
        return replace(rate, resampled=interval)

    @classmethod
    def of(cls, value: Mapping[str, Any]) -> Rate:
        """A rate as `as_dict` makes it."""
        return cls.with_interval(
            value["successes"], value["total"], tuple(value["interval"])
        )

    @property
    def fraction(self) -> float:
        """Successes over total."""
        if self.total:
            return self.successes / self.total
        return 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval: the resampled one, or Wilson's; (0, 1) when nothing was
        counted.
        """
        if self.resampled is None:
            return wilson(self.fraction, self.total)
        return self.resampled

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
        if self.total:
            return f"{self.counts} = {percent(self.fraction)} ({self.ends})"
        return "-"

    def short(self, *, interval: bool = False) -> str:
        """The counts in a cell of a wide table, with the 95 % interval if so asked."""
        count, (low, high) = f"{self.successes}/{self.total}", self.interval
        if interval and self.total:
            return f"{count} ({low:.2f} to {high:.2f})"
        return count

    def as_dict(self) -> dict[str, Any]:
        """Rate (None when nothing was counted), successes, total and interval, as JSON
        can hold them.
        """
        return {
            "rate": self.fraction if self.total else None,
            "successes": self.successes,
            "total": self.total,
            "interval": list(self.interval),
        }


def pooled(rates: Iterable[Rate]) -> Rate:
    """All of them together."""
    known = list(rates)
    return Rate(
        successes=sum(rate.successes for rate in known),
        total=sum(rate.total for rate in known),
    )


def spread(rates: Iterable[Rate], *, intervals: bool = True) -> str:
    """Lowest to highest of some rates, each with its interval if so asked."""
    ordered = sorted(rates, key=lambda rate: rate.fraction)
    if not ordered:
        return "nothing counted"
    low, high = (
        (
            f"{percent(rate.fraction)} ({rate.ends})"
            if intervals
            else percent(rate.fraction)
        )
        for rate in (ordered[0], ordered[-1])
    )
    return f"{low} to {high}"


def number(value: float | None, form: str = ".1f", unit: str = "") -> str:
    """A number in a format, or a dash for none."""
    if value is None:
        return "-"
    return format(value, form) + (f"{FIXED}{unit}" if unit else "")
