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
