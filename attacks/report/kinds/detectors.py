"""What `mi-splat evaluate` and `mi-splat bench` leave behind: what detectors report on
splats.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

import polars as pl

from attacks.bench.row import HEADS, clean_named, robust, warnings
from attacks.figures.frame import Figures
from attacks.figures.rate import number
from attacks.figures.result import Result
from attacks.figures.tables import Column, Table
from attacks.observe import rates
from attacks.observe.comparison import classes_of, contradicted_views
from attacks.observe.rates import (
    DEFAULT_OF_YOLO,
    REPORTED,
    Confidence,
    comparison_measures,
    confidence_words,
)
from attacks.observe.rows import ATTACKED, CLEAN, ROWS
from attacks.observe.sector import ELSEWHERE, INSIDE, TEST, TRAIN
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
from mi_splat.errors import counted
from mi_splat.io.folders import file_in

# A clean and an attacked splat

_CONDITIONS = (
    "clean",
    "attacked",
    "clean_hash",
    "attacked_hash",
    "selection",
    "object_gaussians",
    "original",
    "inside",
    "up",
    "min_confidence",
    "background",
    "near",
)
_RATES = {
    "found_clean": "detected, clean",
    "found_attacked": "detected, attacked",
    "missed": "missed when attacked, of those detected clean",
    "target_clean": "target class detected, clean",
    "target_attacked": "target class detected, attacked",
}
_CURVES: dict[str, tuple[str, Role]] = {
    "missed": ("missed attacked", "attack"),
    "target_attacked": ("target class detected, attacked", "attack"),
    "target_clean": ("target class detected, clean", "control"),
}
"""Rates that are drawn over the confidence."""
_SIDES = "clean on the left, attacked on the right."


def read_evaluation(result: Result) -> Section:
    """The section of an evaluation."""
    record = result.record
    figures = result.figures
    rows = result.tables[ROWS]
    classes = classes_of(rows)
    headlines = [
        _headline(name, figures.where(detector=name), *of_detector)
        for name, of_detector in classes.items()
    ]
    targeted = next(iter(classes.values()))[1] is not None
    measured = partial(comparison_measures, targeted=targeted)
    charts, tables = threshold_charts(rows, measured, _CURVES)
    stated = {key: record[key] for key in _CONDITIONS if key in record}
    cameras = [camera["name"] for camera in record["cameras"]]
    sentences = [
        f"{attacked.label}: {attacked.counts}; {clean.label}: {clean.counts}."
        for attacked, clean in headlines
    ]
    headline, control = headlines[0]
    least = confidence_words(record["min_confidence"])
    sectors = list(_sectors(figures, list(classes)))
    if sectors:
        headline, control = _sector_headline(figures, classes)
        sentences = [_sector_sentence(figures, name) for name in classes]
    return Section(
        kind="a clean and an attacked splat, evaluated",
        title=f"{Path(record['attacked']).name} against {Path(record['clean']).name}",
        done=(
            f"{listed([*classes])} evaluated the clean splat {record['clean']} and at"
            f" the attacked one {record['attacked']} from"
            f" {counted(len(cameras), 'camera')}, in 8-bit images. A detection counts"
            f" from {least}. Views count in which the object shows"
            f" ({record['object_gaussians']:,} Gaussians)."
        ),
        conclusion=" ".join(
            [*sentences, "This says nothing of other cameras or detectors."]
        ),
        headline=headline,
        control=control,
        figures=(*_figures(figures), *_contradictions(figures)),
        warnings=record["warnings"],
        pictures=tuple(
            Picture(
                path=file_in(result.folder, f"{name}.png"),
                caption=f"{name}: {_SIDES}",
                wide=True,
            )
            for name in classes
        ),
        charts=charts,
        tables=(
            *sectors,
            *_survival(figures, bool(sectors)),
            *_contradicted(result, cameras),
            *tables,
        ),
        configuration=settings(
            {**stated, "cameras": cameras, "weights": record["fingerprints"]}
        ),
    )


_SPLITS = {TEST: "held out", TRAIN: "training", None: "all"}
"""Cameras of a sector that are counted together, and what they are called."""


def _sectors(figures: Figures, detectors: list[str]) -> Iterator[Table]:
    """How often the object is missed inside of a sector, and detected elsewhere."""
    lines = []
    for detector in detectors:
        for split, words in _SPLITS.items():
            of_split = figures.where(detector=detector, split=split)
            if not of_split.having("scope").by_key:
                continue
            lines.append(
                {
                    "detector": detector,
                    "cameras": words,
                    "missed": of_split.rate("missed", scope=INSIDE),
                    "nothing": of_split.rate("nothing", scope=INSIDE),
                    "detected": of_split.rate("detected", scope=ELSEWHERE),
                    "clean": of_split.rate("found_clean", scope=INSIDE),
                }
            )
    columns: dict[str, Column[Mapping[str, object]]] = {
        "detector": "detector",
        "cameras": "cameras",
        "missed inside": "missed",
        "no class on it inside": "nothing",
        "detected elsewhere": "detected",
        "clean detected inside": "clean",
    }
    if lines:
        caption = "Inside of the sector and elsewhere, where the clean one is detected"
        yield Table.of(caption, columns, lines)


def _survival(figures: Figures, has_sector: bool) -> Iterator[Table]:
    """What is left of the attack under each condition."""
    lines: list[Mapping[str, object]] = []
    for condition, detector in figures.having("condition").groups(
        "condition", "detector"
    ):
        of_one = figures.where(condition=condition, detector=detector)
        inside = of_one.where(split=None)
        line: dict[str, object] = {"condition": condition, "detector": detector}
        if has_sector:
            line["missed"] = inside.rate("missed", scope=INSIDE)
            line["detected"] = inside.rate("detected", scope=ELSEWHERE)
        else:
            line["missed"] = of_one.rate("missed")
            line["replaced"] = of_one.rate("replaced")
        lines.append(line)
    if not lines:
        return
    caption = "Under each condition, where the clean object is detected"
    columns: dict[str, Column[Mapping[str, object]]] = {
        "condition": "condition",
        "detector": "detector",
    }
    if has_sector:
        columns |= {"missed inside": "missed", "detected elsewhere": "detected"}
    else:
        columns |= {"missed": "missed", "target and not its own class": "replaced"}
    yield Table.of(caption, columns, lines)


def _sector_sentence(figures: Figures, detector: str) -> str:
    """What one detector makes of an object that is hidden from a sector."""
    missed = figures.rate("missed", detector=detector, scope=INSIDE)
    detected = figures.rate("detected", detector=detector, scope=ELSEWHERE)
    if not missed.total:
        return f"{detector} does not detect the clean object inside of the sector."
    return (
        f"{detector}: missed inside of the sector in {missed.counts}, detected"
        f" elsewhere in {detected.counts}."
    )


def _sector_headline(
    figures: Figures, classes: Mapping[str, tuple[str | None, str | None]]
) -> tuple[Figure, Figure]:
    """How often the object is missed inside of a sector by the detector that detects
    the clean one there most often.
    """
    totals = {
        name: figures.rate("missed", detector=name, scope=INSIDE).total
        for name in classes
    }
    detector = max(totals, key=lambda name: totals[name])
    inside = figures.where(detector=detector, scope=INSIDE, split=None)
    thing = classes[detector][0] or "object"
    what = f"{detector} misses the {thing} inside of the sector"
    note = "of the views in which it is detected in the clean splat"
    clean = inside.rate("found_clean").failures
    return (
        Figure(label=what, rate=inside.rate("missed"), note=note),
        Figure(label=f"{what}, in the clean splat", rate=clean),
    )


def _contradictions(figures: Figures) -> Iterator[Figure]:
    """How often checkers contradict the other detectors."""
    for (detector, checker), pair in figures.groups("detector", "checked_by").items():
        if checker is not None:
            for splat, note in ((ATTACKED, ""), (CLEAN, "false flags")):
                label = f"{checker} contradicts {detector}, {splat}"
                rate = pair.rate("contradicted", splat=splat)
                yield Figure(label=label, rate=rate, note=note)


def _contradicted(result: Result, cameras: list[str]) -> Iterator[Table]:
    """Each view in which a checker contradicts a detector."""
    record = result.record
    if not record.get("cross_checks"):
        return
    views = contradicted_views(
        result.tables[ROWS], record["cross_checks"], confidence=record["min_confidence"]
    )
    contradicted = views.filter("contradicted")
    for (detector, checker), pair in contradicted.group_by(
        "detector", "checked_by", maintain_order=True
    ):
        columns: dict[str, Column[Mapping[str, object]]] = {
            "camera": lambda line: cameras[int(str(line["view"]))],
            "splat": "splat",
            str(detector): "report",
            str(checker): "verdict",
        }
        caption = f"Views in which {checker} contradicts {detector}"
        yield Table.of(caption, columns, pair.iter_rows(named=True))


def _headline(
    detector: str, figures: Figures, original: str | None, target: str | None
) -> tuple[Figure, Figure]:
    """The figure of a detector that matters, and that of the clean splat."""
    if target:
        what = f"{detector} reports {target} on the"
        note = ""
        attacked = figures.rate("target_attacked")
        clean = figures.rate("target_clean")
    else:
        what = f"{detector} misses the {original or 'object'} on the"
        note = "of the views in which it is detected in the clean one"
        attacked = figures.rate("missed")
        clean = figures.rate("found_clean").failures
    return (
        Figure(label=f"{what} attacked splat", rate=attacked, note=note),
        Figure(label=f"{what} clean splat", rate=clean),
    )


def _figures(figures: Figures) -> Iterator[Figure]:
    """What each detector makes of both splats."""
    for (detector,), of_one in (
        figures.where(checked_by=None).groups("detector").items()
    ):
        for measure, words in _RATES.items():
            if of_one.find(measure) is not None:
                rate = of_one.rate(measure)
                yield Figure(label=f"{detector}: {words}", rate=rate)
        label = f"{detector}: images, attacked against clean"
        yield Figure(label=label, words=number(of_one.value("psnr"), unit="dB"))


# Rates over the confidence from which a detection counts, of any result whose folder
# holds rows

_CURVE = tuple(round(0.05 * step, 2) for step in range(1, 20))
_AT = (REPORTED, DEFAULT_OF_YOLO)
"""Confidences of the charts, and those of them that the table has."""


def threshold_charts(
    rows: pl.DataFrame | None,
    measures: Callable[[Confidence], rates.Measures],
    names: Mapping[str, tuple[str, Role]],
) -> tuple[list[Chart], list[Table]]:
    """A chart for each detector with some rates over the confidence, and a table of
    them at two confidences.
    """
    drawn = {name: names[name] for name in measures(REPORTED) if name in names}
    if rows is None or not drawn:
        return [], []
    paired = rates.with_control(rows)
    if paired.is_empty():
        return [], []
    clusters = None
    if set(rates.CLUSTERS) <= set(paired.columns):
        clusters = rates.CLUSTERS

    def wanted(confidence: Confidence) -> rates.Measures:
        every = measures(confidence)
        return {name: every[name] for name in every if name in drawn}

    confidences = {confidence: confidence for confidence in _CURVE}
    curve = rates.rates_at(
        paired, wanted, confidences, ("detector",), clusters=clusters
    )
    charts = []
    lines = []
    for detector in curve[REPORTED].labels("detector"):
        curves = []
        for name, (words, role) in drawn.items():
            at = {
                confidence: figures.rate(name, detector=detector)
                for confidence, figures in curve.items()
            }
            points = (Point.of(x, rate) for x, rate in at.items() if rate.total)
            curves.append(Line(name=words, role=role, points=tuple(points)))
            lines.append(
                (detector, words, *(at[confidence].words for confidence in _AT))
            )
        charts.append(
            Chart(
                title=f"{detector}, by the confidence that counts",
                caption=(
                    f"Figures of this page count from {REPORTED:g}. Bands are 95 %"
                    " intervals."
                ),
                x_label="confidence from which a detection counts",
                y_label="views",
                lines=tuple(curves),
            )
        )
    head = ("detector", "rate", *(f"from {confidence:g}" for confidence in _AT))
    caption = "By the confidence from which a detection counts"
    return charts, [Table(caption=caption, head=head, rows=tuple(lines))]


# A row of the scoreboard


def read_bench(result: Result) -> Section:
    """The section of a row, column by column."""
    record = result.record
    figures = result.figures
    name = record["detector"]["name"]
    score = figures.value("score")
    words = "no score: a column cannot be filled" if score is None else f"{score:.3f}"
    columns = []
    for column, head in HEADS.items():
        rate = robust(figures, column)
        if rate is not None:
            columns.append(Figure(label=f"still named, {head}", rate=rate))
    stated = ("suite", "detector", "defence", "missing", "cpu_seconds")
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
        control=Figure(label="clean object named", rate=clean_named(figures)),
        attacked=False,
        warnings=list(warnings(figures)),
        figures=columns,
        configuration=settings({key: record[key] for key in stated}),
    )
