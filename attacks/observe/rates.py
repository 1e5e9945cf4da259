"""Rates are counted from rows: a figure is a measure, and a group of rows that it is counted over.

Rows are a table of Polars. A measure is two of its expressions: what has to hold in a row, and which rows count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import polars as pl

from attacks.rate import Rate

Group = tuple[Any, ...]
"""Values of the columns that a group of rows has in common."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measure:
    """What is counted.

    Attributes:
        holds: What has to hold in a row; one where it cannot be said (null) does not hold.
        given: Which rows count; None counts all.
    """

    holds: pl.Expr
    given: pl.Expr | None = None


def count(rows: pl.DataFrame, measures: Mapping[str, Measure], by: Sequence[str] = ()) -> dict[Group, dict[str, Rate]]:
    """Count measures over groups of rows.

    Args:
        rows: With the columns that the measures name.
        measures: By name.
        by: Columns whose values make the groups; none makes one group, (), of all rows.

    Returns:
        For each group that has rows, in the order of its first one, the rate of each measure.
    """
    if not measures:
        return {}
    sums = []
    for name, measure in measures.items():
        holds = measure.holds if measure.given is None else measure.holds & measure.given
        total = pl.len() if measure.given is None else measure.given.sum()
        sums += [holds.sum().alias(f"{name}/successes"), total.alias(f"{name}/total")]
    table = rows.group_by(by, maintain_order=True).agg(sums) if by else rows.select(sums)
    return {
        tuple(line[column] for column in by): {
            name: Rate(successes=int(line[f"{name}/successes"]), total=int(line[f"{name}/total"])) for name in measures
        }
        for line in table.iter_rows(named=True)
    }


def jointly(rows: pl.DataFrame, over: Sequence[str], truths: Sequence[str]) -> pl.DataFrame:
    """One line for each view, in which a truth holds if it holds in all of its rows: of every detector, for instance.

    Args:
        rows: Several for each view.
        over: Columns that say which view a row is of.
        truths: Columns of truths; all others are left out.

    Returns:
        The columns `over` and `truths`, views in the order of their first rows.
    """
    return rows.group_by(over, maintain_order=True).agg(pl.col(*truths).all())


def banded(
    rows: pl.DataFrame, angle: str, interval: tuple[float, float], parts: int, measure: Measure
) -> list[dict[str, Any]]:
    """A rate over an angle, in equal parts of an interval, as JSON can hold it; of an empty interval nothing.

    Args:
        rows: With a column for the angle.
        angle: Name of the column, degrees.
        interval: Degrees; what lies outside of it counts to its first or last part.
        parts: Number of parts.
        measure: What is counted.
    """
    low, width = interval[0], (interval[1] - interval[0]) / parts
    if not width:
        return []
    place = ((pl.col(angle) - low) / width).cast(pl.Int64).clip(0, parts - 1)
    found = count(rows.with_columns(place=place), {"rate": measure}, ("place",))
    none = {"rate": Rate(successes=0, total=0)}
    return [
        {"from": low + part * width, "to": low + (part + 1) * width, **found.get((part,), none)["rate"].as_dict()}
        for part in range(parts)
    ]


def paired(rows: pl.DataFrame, scenes: Sequence[str], *, scene: str, on: Sequence[str]) -> pl.DataFrame:
    """One line for each view, with what was seen there of every scene.

    Args:
        rows: One for each scene and view.
        scenes: Names of the scenes that are put beside each other, the control first.
        scene: Column that holds them.
        on: Columns that are the same in all scenes of one view.

    Returns:
        The columns `on`, and for each scene its other columns with its name and a point before theirs. Views in the
        order of the first scene's, those apart that a scene lacks.
    """
    sides = [
        rows.filter(pl.col(scene) == name)
        .drop(scene)
        .rename({column: f"{name}.{column}" for column in rows.columns if column not in (*on, scene)})
        for name in scenes
    ]
    table = sides[0]
    for side in sides[1:]:
        table = table.join(side, on=list(on), how="inner", maintain_order="left")
    return table
