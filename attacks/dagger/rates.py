"""The rates of an attack, counted from its rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import polars as pl

from attacks.observe.rates import Measure, banded, count, jointly
from attacks.rate import Rate

FOUND = 0.5
"""Confidence from which the object counts as found."""
AZIMUTHS, ELEVATIONS = 8, 4
"""Parts of the angles that success is told by."""
AIMS = ("success", "clean_success", "unambiguous")
"""Columns that say whether the aim is reached: attacked, without an attack, and with nothing that speaks against it."""
NOISE = "noise_successes"
"""Column with a list: whether the aim is reached with each draw of random noise."""
_FOUND = {
    name: Measure(holds=pl.col("original").is_not_null() & (pl.col(column) >= FOUND))
    for name, column in (("found_clean", "clean_confidence"), ("found_attacked", "original_confidence"))
}


def aim_rates(rows: pl.DataFrame) -> dict[str, Rate]:
    """How often the aim is reached in views, with all detectors of the rows at once.

    Args:
        rows: One for each view (`index`) and detector, with the columns `AIMS` and `NOISE`.

    Returns:
        A rate for each of `AIMS`, and for `NOISE`, where a view counts once for each draw.
    """
    views = jointly(rows, ("index",), AIMS)
    draws = (
        rows.select("index", NOISE, draw=pl.int_ranges(pl.col(NOISE).list.len())).explode(NOISE, "draw").drop_nulls()
    )
    noise = count(jointly(draws, ("index", "draw"), (NOISE,)), {NOISE: Measure(holds=pl.col(NOISE))})
    return {**count(views, {name: Measure(holds=pl.col(name)) for name in AIMS})[()], **noise[()]}


def found_rates(rows: pl.DataFrame) -> dict[str, Rate]:
    """In how many rows the object is reported as what the clean one is called, clean and attacked."""
    return count(rows, _FOUND)[()]


def rate_figures(
    rows: pl.DataFrame, detectors: Sequence[str], elevations: tuple[float, float] | None = None
) -> dict[str, Any]:
    """Every rate of an attack, as JSON can hold it.

    Args:
        rows: As in `aim_rates`, with the columns detector, original, azimuth, elevation, and confidences.
        detectors: Names of those attacked.
        elevations: Interval of the cameras that judge it, degrees; None where they are not drawn, so that nothing is
            told by angles.
    """
    together, success = aim_rates(rows), Measure(holds=pl.col("success"))
    told = {
        "rate": together["success"].as_dict(),
        "rates": {name: _of_detector(rows.filter(detector=name)) for name in detectors},
        "clean_rate": together["clean_success"].as_dict(),
        "noise_rate": together[NOISE].as_dict(),
        "unambiguous_rate": together["unambiguous"].as_dict(),
    }
    if elevations is None:
        return told
    return {
        **told,
        "by_azimuth": banded(rows, "azimuth", (0.0, 360.0), AZIMUTHS, success),
        "by_elevation": banded(rows, "elevation", elevations, ELEVATIONS, success),
    }


def _of_detector(rows: pl.DataFrame) -> dict[str, Any]:
    """What one detector reports."""
    aims, found = aim_rates(rows), found_rates(rows)
    return {
        "original": None if rows.is_empty() else rows["original"][0],
        "success": aims["success"].as_dict(),
        "noise": aims[NOISE].as_dict(),
        "clean": aims["clean_success"].as_dict(),
        **{name: rate.as_dict() for name, rate in found.items()},
    }
