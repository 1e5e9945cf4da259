"""Rates over the confidence from which a detection counts, as charts of any story whose folder holds rows."""

from collections.abc import Callable, Mapping
from pathlib import Path

import polars as pl

from attacks.observe.rates import (
    CLUSTERS,
    DEFAULT_OF_YOLO,
    REPORTED,
    Confidence,
    Measures,
    rates_at,
    threshold_curve,
    with_control,
)
from attacks.observe.rows import ROWS, SUFFIX, read_rows
from attacks.report.section import Chart, Line, Point, Role
from attacks.tables import Table, cell

AT = {f"{confidence:g}": confidence for confidence in (REPORTED, DEFAULT_OF_YOLO)}
"""Confidences of the table."""


def threshold_charts(
    folder: Path,
    measures: Callable[[Confidence], Measures],
    names: Mapping[str, tuple[str, Role]],
    *,
    part: Callable[[pl.DataFrame], pl.DataFrame] = lambda rows: rows,
    what: str = "",
) -> tuple[tuple[Chart, ...], tuple[Table, ...]]:
    """A chart for each detector with some rates over the confidence, and a table of them at two confidences."""
    path = folder / f"{ROWS}{SUFFIX}"
    drawn = {name: names[name] for name in measures(REPORTED) if name in names}
    if not path.is_file() or not drawn:
        return (), ()
    rows = with_control(part(read_rows(path)))
    if rows.is_empty():
        return (), ()
    clusters = CLUSTERS if set(CLUSTERS) <= set(rows.columns) else None
    curves = {name: threshold_curve(rows, measures, name, by=("detector",), clusters=clusters) for name in drawn}
    detectors = list(dict.fromkeys(detector for (detector,) in next(iter(curves.values()))))
    charts = tuple(
        Chart(
            title=f"{detector}{what}, by the confidence that counts",
            caption=f"Figures of this page count from {REPORTED:g}. Bands are 95 % intervals.",
            x_label="confidence from which a detection counts",
            y_label="views",
            lines=tuple(
                Line(
                    name=words,
                    role=role,
                    points=tuple(Point.of(at, rate) for at, rate in curves[name][detector,] if rate.total),
                )
                for name, (words, role) in drawn.items()
            ),
        )
        for detector in detectors
    )
    at = rates_at(rows, measures, AT, ("detector",), clusters=clusters)
    lines = tuple(
        (detector, words, *(cell(at[confidence][detector,][name]) for confidence in AT))
        for detector in detectors
        for name, (words, _) in drawn.items()
    )
    head = ("detector", "rate", *(f"from {confidence}" for confidence in AT))
    caption = f"By the confidence from which a detection counts{what}"
    return charts, (Table(caption=caption, head=head, rows=lines),)
