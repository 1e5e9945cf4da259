"""Rates are counted from rows: a figure is a measure, and a group of rows that it is counted over.

Rows are a table of Polars. A measure is two of its expressions: what has to hold in a row, and which rows count.

Rows of neighbouring cameras agree, and so do those of splats that share their pictures. An interval that takes them for
independent is two to three times too narrow. So a rate over many views is resampled in blocks of neighbouring cameras
and in seeds, each drawn anew with replacement (the pigeonhole bootstrap: Owen 2007, "The pigeonhole bootstrap"). What
holds of one object need not hold of the next: a rate over several has them drawn anew, too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from attacks.rate import Rate, wilson

DRAWS, FEWEST_BLOCKS, BLOCK = 2000, 6, 20.0
"""Draws of a resampled interval, blocks from which on there is one, and degrees of a block of cameras."""

Group = tuple[Any, ...]
"""Values of the columns that a group of rows has in common."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measure:
    """What is counted."""

    holds: pl.Expr  # what has to hold in a row; one where it cannot be said (null) does not hold
    given: pl.Expr | None = None  # which rows count; None counts all


def count(
    rows: pl.DataFrame,
    measures: Mapping[str, Measure],
    by: Sequence[str] = (),
    *,
    clusters: Sequence[str] | None = None,
) -> dict[Group, dict[str, Rate]]:
    """Count measures over groups of rows."""
    if not measures:
        return {}
    sums = []
    for name, measure in measures.items():
        holds = measure.holds if measure.given is None else measure.holds & measure.given
        total = pl.len() if measure.given is None else measure.given.sum()
        sums += [holds.sum().alias(f"{name}/successes"), total.alias(f"{name}/total")]
    columns = list(dict.fromkeys((*by, *(clusters or ()))))
    table = rows.group_by(columns, maintain_order=True).agg(sums) if columns else rows.select(sums)
    groups = table.partition_by(by, maintain_order=True) if by else [table]
    return {
        tuple(group[column][0] for column in by): {name: _rate(group, name, clusters) for name in measures}
        for group in groups
    }


def _rate(group: pl.DataFrame, name: str, clusters: Sequence[str] | None) -> Rate:
    """The rate of a measure over a group, of which each line has the sums of a part."""
    successes, total = (int(group[f"{name}/{what}"].sum()) for what in ("successes", "total"))
    if clusters is None or not total:
        return Rate(successes=successes, total=total)
    numbers = [np.unique(group[column].to_numpy(), return_inverse=True)[1] for column in clusters]
    shape = tuple(int(column.max()) + 1 for column in numbers)
    sums = np.zeros((2, *shape))
    for number, what in enumerate(("successes", "total")):
        np.add.at(sums[number], tuple(numbers), group[f"{name}/{what}"].to_numpy())
    return Rate(successes=successes, total=total, resampled=_resampled(sums))


def _resampled(sums: NDArray[np.float64]) -> tuple[float, float]:
    """95 % interval of a rate whose blocks and seeds, and objects if there are several, are drawn anew.

    Where few blocks were counted, or all are of one kind, drawing them anew says nothing; Wilson's interval with each
    block for one draw stands in. The same of objects that are all of one kind; of few that are not, it is that of as
    many draws as their spread is worth (Korn and Graubard 1998, "Confidence intervals for proportions"). `sums` are
    (2, blocks, seeds) or (2, objects, blocks, seeds) successes and totals.
    """
    axes = range(1, sums.ndim)
    sums = sums[:, sums[1].sum(tuple(axis - 1 for axis in axes if axis > 1)) > 0]
    first, total = sums.shape[1], float(sums[1].sum())
    fraction, few = float(sums[0].sum()) / total, first < FEWEST_BLOCKS
    if fraction in (0.0, 1.0) or (few and (sums.ndim == 3 or first == 1)):
        return wilson(fraction, first)
    generator, drawn = np.random.default_rng(0), sums[:, None]
    for number in axes:
        n = sums.shape[number]
        weights = generator.multinomial(n, np.full(n, 1 / n), size=DRAWS).astype(np.float64)
        drawn = np.einsum("kdn...,dn->kd...", np.broadcast_to(drawn, (2, DRAWS, *drawn.shape[2:])), weights)
    fractions = (drawn[0] / np.maximum(drawn[1], 1.0))[drawn[1] > 0]
    if few:
        quantiles = float(ndtri(0.975)) / float(stdtrit(first - 1, 0.975))
        worth = fraction * (1 - fraction) / max(float(fractions.var()), 1e-12) * quantiles**2
        return wilson(fraction, min(max(worth, first), total))
    low, high = np.quantile(fractions, (0.025, 0.975))
    return float(low), float(high)


def blocks_of(azimuth: str, elevation: str) -> pl.Expr:
    """The block of directions that a camera stands in, as a number: about `BLOCK` degrees wide and high."""
    band = ((pl.col(elevation) + 90) / BLOCK).floor()
    middle = ((band + 0.5) * BLOCK - 90).clip(-89, 89)
    around = (360 * middle.radians().cos() / BLOCK).round().clip(1)
    return (band * 1000 + (pl.col(azimuth) / 360 * around).floor()).cast(pl.Int64)


def banded(
    rows: pl.DataFrame, angle: str, interval: tuple[float, float], parts: int, measure: Measure
) -> list[dict[str, Any]]:
    """A rate over an angle, in equal parts of an interval, as JSON can hold it; of an empty interval nothing."""
    low, width = interval[0], (interval[1] - interval[0]) / parts
    if not width:
        return []
    part_of = ((pl.col(angle) - low) / width).cast(pl.Int64).clip(0, parts - 1)
    counted = count(rows.with_columns(part=part_of), {"rate": measure}, ("part",))
    none = {"rate": Rate(successes=0, total=0)}
    return [
        {"from": low + part * width, "to": low + (part + 1) * width, **counted.get((part,), none)["rate"].as_dict()}
        for part in range(parts)
    ]
