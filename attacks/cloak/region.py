"""The region of a detector: the elevations at which it detects the clean object. Elsewhere a miss is no evidence."""

from itertools import pairwise

import polars as pl

from attacks.observe.rates import of, reported
from attacks.observe.rows import CLEAN

BAND = 10.0
"""Degrees of elevation of a band of cameras, the first from the horizon."""
LEAST = 0.8
"""Share of a band's cameras from which a detector finds the control where the band belongs to its region."""
RULE = f"bands of {BAND:g} degrees of elevation in which it finds the control from {LEAST:.0%} of the cameras or more"
"""The rule, for people."""
_LOW = (pl.col("elevation") / BAND).floor() * BAND


def regions(rows: pl.DataFrame, confidence: float) -> dict[str, list[float]]:
    """The lower edges of the bands in each detector's region, degrees, rising; of all seeds and azimuths together."""
    reported_clean = reported("original_score", confidence)
    share = rows.filter(of(CLEAN), pl.col("elevation") >= 0).group_by("detector", low=_LOW).agg(reported_clean.mean())
    bands = share.filter(pl.col("original_score") >= LEAST).sort("low")
    names = rows["detector"].unique(maintain_order=True)
    return {name: bands.filter(detector=name)["low"].to_list() for name in names}


def in_region(rows: pl.DataFrame, regions: dict[str, list[float]]) -> pl.DataFrame:
    """The rows of each detector from cameras in its region."""
    held = [(pl.col("detector") == name) & _LOW.is_in(lows) for name, lows in regions.items()]
    return rows.filter(pl.any_horizontal(held)) if held else rows.clear()


def in_words(lows: list[float]) -> str:
    """The region in a few words, for instance "0 to 30, 50 to 60 degrees"; a dash for none."""
    if not lows:
        return "-"
    starts = [lows[0], *(after for before, after in pairwise(lows) if after - before > BAND)]
    ends = [*(before + BAND for before, after in pairwise(lows) if after - before > BAND), lows[-1] + BAND]
    parts = (f"{low:g} to {high:g}" for low, high in zip(starts, ends, strict=True))
    return f"{', '.join(parts)} degrees"
