"""What `mi-splat evaluate` and `mi-splat bench` leave behind: what detectors report on
splats.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl

from attacks.bench.row import HEADS, row_of
from attacks.observe import rates
from attacks.observe.comparison import Comparison, compare, contradictions
from attacks.observe.rates import (
    DEFAULT_OF_YOLO,
    REPORTED,
    Confidence,
    comparison_measures,
)
from attacks.observe.rows import ATTACKED, CLEAN, ROWS
from attacks.rate import Rate, number, pooled
from attacks.report.checking import Tables, read_tables
from attacks.report.section import (
    Chart,
    Figure,
    Line,
    Picture,
    Point,
    Role,
    Section,
    listed,
    settings,
)
from attacks.tables import Column, Table, cell
from mi_splat.errors import counted
from mi_splat.io.folders import file_in

Record = Mapping[str, Any]

# A clean and an attacked splat

_CONDITIONS = (
    *(
        "clean",
        "attacked",
        "clean_hash",
        "attacked_hash",
        "selection",
        "object_gaussians",
        "original",
    ),
    *("min_confidence", "background", "near"),
)
_RATES = {
    "found_clean": "found, clean",
    "found_attacked": "found, attacked",
    "missed": "missed attacked, of those found clean",
    "target_clean": "taken for the target, clean",
    "target_attacked": "taken for the target, attacked",
}
_CURVES: dict[str, tuple[str, Role]] = {
    "missed": ("missed attacked", "attack"),
    "target_attacked": ("taken for the target, attacked", "attack"),
    "target_clean": ("taken for the target, clean", "control"),
}
"""Rates that are drawn over the confidence."""
_SIDES = "clean on the left, attacked on the right."


def read_evaluation(folder: Path, record: Record) -> Section:
    """The section of an evaluation."""
    judged = [
        Comparison.of(name, values) for name, values in record["detectors"].items()
    ]
    headline, control = _headline(judged[0])
    measured = partial(comparison_measures, targeted=judged[0].target is not None)
    charts, tables = threshold_charts(
        read_tables(folder, (ROWS,)).get(ROWS), measured, _CURVES
    )
    return Section(
        kind="a clean and an attacked splat, judged",
        title=f"{Path(record['attacked']).name} against {Path(record['clean']).name}",
        done=(
            f"{listed([one.detector for one in judged])} looked at the clean splat"
            f" {record['clean']} and at the attacked one {record['attacked']} from"
            f" {counted(len(record['cameras']), 'camera')}, in 8-bit pictures. A"
            f" detection counts from {record['min_confidence']:g}. Views count in which"
            f" the object shows ({record['object_gaussians']:,} Gaussians)."
        ),
        conclusion=" ".join(
            [
                *map(_conclusion, judged),
                "This says nothing of other cameras or detectors.",
            ]
        ),
        headline=headline,
        control=control,
        figures=tuple(
            [figure for one in judged for figure in _figures(one)]
            + list(_contradictions(record))
        ),
        warnings=record["warnings"],
        pictures=tuple(
            Picture(
                path=file_in(folder, f"{one.detector}.png"),
                caption=f"{one.detector}: {_SIDES}",
                wide=True,
            )
            for one in judged
        ),
        charts=charts,
        tables=(*_contradicted(record), *tables),
        configuration=settings(
            {
                **{key: record[key] for key in _CONDITIONS if key in record},
                "cameras": [camera["name"] for camera in record["cameras"]],
                "weights": record["fingerprints"],
            }
        ),
    )


def evaluation_figures(record: Record, tables: Tables) -> Record:
    """Every rate of an evaluation, of its rows."""
    rows = tables[ROWS]
    confidence = record["min_confidence"]
    figures = {
        "detectors": {
            judged.detector: judged.as_dict()
            for judged in compare(rows, confidence=confidence)
        }
    }
    if "judges" not in record:
        return figures
    cameras = [camera["name"] for camera in record["cameras"]]
    contradicted = contradictions(
        rows, record["judges"], cameras, confidence=confidence
    )
    return {**figures, "contradictions": contradicted}


def _contradictions(record: Record) -> Iterator[Figure]:
    """How often judges contradict the other detectors."""
    for pair in record.get("contradictions", ()):
        for splat, note in ((ATTACKED, ""), (CLEAN, "false flags")):
            label = f"{pair['judge']} contradicts {pair['detector']}, {splat}"
            yield Figure(label=label, rate=Rate.of(pair[splat]), note=note)


def _contradicted(record: Record) -> Iterator[Table]:
    """Each view in which a judge contradicts a detector."""
    for pair in record.get("contradictions", ()):
        detector = pair["detector"]
        judge = pair["judge"]
        columns: dict[str, Column[Record]] = {
            "camera": "camera",
            "splat": "splat",
            detector: "report",
            judge: "verdict",
        }
        yield Table.of(
            f"Views in which {judge} contradicts {detector}", columns, pair["views"]
        )


def _headline(judged: Comparison) -> tuple[Figure, Figure]:
    if judged.target:
        what = f"{judged.detector} reports {judged.target} on the"
        note = ""
        attacked = judged.rates["target_attacked"]
        clean = judged.rates["target_clean"]
    else:
        what = f"{judged.detector} misses the {judged.original or 'object'} on the"
        attacked = judged.rates["missed"]
        clean = judged.rates["found_clean"].failures
        note = "of the views in which it is found in the clean one"
    return (
        Figure(label=f"{what} attacked splat", rate=attacked, note=note),
        Figure(label=f"{what} clean splat", rate=clean),
    )


def _conclusion(judged: Comparison) -> str:
    attacked, clean = _headline(judged)
    return f"{attacked.label}: {attacked.counts}; {clean.label}: {clean.counts}."


def _figures(judged: Comparison) -> Iterator[Figure]:
    """What one detector makes of both splats."""
    for key, rate in judged.rates.items():
        yield Figure(label=f"{judged.detector}: {_RATES[key]}", rate=rate)
    label = f"{judged.detector}: pictures, attacked against clean"
    yield Figure(label=label, words=number(judged.psnr, unit="dB"))


# Rates over the confidence from which a detection counts, of any result whose folder
# holds rows

_CURVE = tuple(round(0.05 * step, 2) for step in range(1, 20))
_AT = (REPORTED, DEFAULT_OF_YOLO)
"""Confidences of the charts, and those of them that the table has."""


def threshold_charts(
    rows: pl.DataFrame | None,
    measures: Callable[[Confidence], rates.Measures],
    names: Mapping[str, tuple[str, Role]],
) -> tuple[tuple[Chart, ...], tuple[Table, ...]]:
    """A chart for each detector with some rates over the confidence, and a table of
    them at two confidences.
    """
    drawn = {name: names[name] for name in measures(REPORTED) if name in names}
    paired = rates.with_control(rows) if rows is not None and drawn else pl.DataFrame()
    if paired.is_empty():
        return (), ()
    clusters = rates.CLUSTERS if set(rates.CLUSTERS) <= set(paired.columns) else None

    def wanted(confidence: Confidence) -> rates.Measures:
        return {
            name: measure
            for name, measure in measures(confidence).items()
            if name in drawn
        }

    curve = rates.rates_at(
        paired,
        wanted,
        dict(zip(_CURVE, _CURVE, strict=True)),
        ("detector",),
        clusters=clusters,
    )
    detectors = [detector for (detector,) in curve[REPORTED]]

    def line(name: str, detector: str) -> Line:
        words, role = drawn[name]
        points = (
            Point.of(at, counts[detector,][name])
            for at, counts in curve.items()
            if counts[detector,][name].total
        )
        return Line(name=words, role=role, points=tuple(points))

    charts = tuple(
        Chart(
            title=f"{detector}, by the confidence that counts",
            caption=(
                f"Figures of this page count from {REPORTED:g}. Bands are 95 %"
                " intervals."
            ),
            x_label="confidence from which a detection counts",
            y_label="views",
            lines=tuple(line(name, detector) for name in drawn),
        )
        for detector in detectors
    )
    lines = tuple(
        (
            detector,
            words,
            *(cell(curve[confidence][detector,][name]) for confidence in _AT),
        )
        for detector in detectors
        for name, (words, _) in drawn.items()
    )
    head = ("detector", "rate", *(f"from {confidence:g}" for confidence in _AT))
    caption = "By the confidence from which a detection counts"
    return charts, (Table(caption=caption, head=head, rows=lines),)


# A row of the scoreboard


def read_bench(folder: Path, record: Record) -> Section:
    """The section of a row, column by column."""
    columns = record["columns"]
    score = record["score"]
    name = record["detector"]["name"]
    filled = {
        head: columns[column]
        for column, head in HEADS.items()
        if columns[column]["robust"] is not None
    }
    if score is None:
        words = "no score: a column cannot be filled"
    else:
        words = f"{score['mean']:.3f}"
    return Section(
        kind="Scoreboard",
        title=f"{name}, suite {record['suite']['name']}",
        done=(
            f"The attacks of the suite were made for {name}. Rates are of views in"
            " which it names the clean object."
        ),
        conclusion=(
            f"Score: {words}. Higher is more robust. It holds for the attacks and"
            " scenes of this suite."
        ),
        headline=Figure(label="score", words=words),
        control=Figure(
            label="clean object named",
            rate=pooled(column["named_clean"] for column in columns.values()),
        ),
        attacked=False,
        warnings=record["warnings"],
        figures=[
            Figure(label=f"still named, {head}", rate=Rate.of(column["robust"]))
            for head, column in filled.items()
        ],
        configuration=tuple(
            (key, str(value))
            for key, value in row_of(record).items()
            if key not in ("columns", "score")
        ),
    )
