"""The figures of an attack: its verdict, and how often it succeeds in views."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import polars as pl

from attacks.figures.frame import MEASURE, Figure, Figures, Labels
from attacks.figures.rate import Rate
from attacks.objectives.verdicts import overall_verdict, reached_by
from attacks.observe.rates import (
    AIMS,
    REPORTED_AS_ORIGINAL,
    STRICT,
    banded,
    count,
    detected_views,
    joint_views,
    with_thresholds,
)
from attacks.observe.rows import ATTACKED, CONTROLS, ROWS
from attacks.search.loop import Verdict

FIXED = "dagger"
DRAWN = "dagger-eot"
"""Kinds of results, by where views come from."""
DETECTED = "clean object detected"
"""Scope of rates over the views in which every detector reports the clean object."""
AZIMUTHS = 8
ELEVATIONS = 4
"""Parts of the angles by which success is counted."""

Entries = Iterator[tuple[Labels, Figure | float | None]]


def figures(record: Mapping[str, Any], tables: Mapping[str, pl.DataFrame]) -> Figures:
    """Every figure of a result that follows from its rows."""
    settings = record["config"]
    elevations = None
    if record["story"] == DRAWN:
        elevations = settings["evaluation"]["cameras"].get("elevations")
    return attack_figures(
        tables[ROWS],
        [str(one["detector"]) for one in record["detectors"]],
        record["target"],
        settings["required_views"],
        elevations,
        drawn=record["story"] == DRAWN,
    )


def attack_figures(
    rows: pl.DataFrame,
    detectors: Sequence[str],
    target: str | None,
    required: float,
    elevations: tuple[float, float] | None,
    *,
    drawn: bool,
) -> Figures:
    """Every figure of an attack, from its rows; `elevations` are those of a region,
    None around a chosen camera.
    """
    rows = with_thresholds(rows)
    attacked = rows.filter(splat=ATTACKED)
    verdict = verdict_figures(rows, detectors, required, drawn=drawn)
    detected = count(joint_views(detected_views(rows)), AIMS, ("splat",))
    succeeded = (
        verdict.rate("reached", splat=ATTACKED).successes
        and detected.rate("success", splat=ATTACKED).total
    )
    parts = [
        Figures.of([({MEASURE: "succeeded"}, _once(bool(succeeded)))]),
        verdict,
        Figures.of(_confidences(attacked, detectors, target, required)),
        count(joint_views(rows), AIMS, ("splat",)),
        detected.labelled(scope=DETECTED),
        count(rows, REPORTED_AS_ORIGINAL, ("detector",)),
    ]
    for name in detectors:
        alone = rows.filter(detector=name)
        parts += [
            verdict_figures(alone, [name], required, drawn=drawn).labelled(
                detector=name
            ),
            count(joint_views(alone), AIMS, ("splat",)).labelled(detector=name),
        ]
    if elevations is not None:
        success = {"success": AIMS["success"]}
        parts += [
            banded(attacked, "azimuth", (0.0, 360.0), AZIMUTHS, success),
            banded(attacked, "elevation", elevations, ELEVATIONS, success),
        ]
    return Figures.together(parts)


def _confidences(
    attacked: pl.DataFrame,
    detectors: Sequence[str],
    target: str | None,
    required: float,
) -> Entries:
    """Confidence in the target class that enough views reach, with each detector."""
    reached = []
    for name in detectors if target is not None else ():
        scores = attacked.filter(detector=name)["target_score"].to_list()
        reached.append(reached_by(scores, required))
        yield {MEASURE: "target_confidence", "detector": name}, reached[-1]
    yield {MEASURE: "target_confidence"}, min(reached, default=None)


def verdict_figures(
    rows: pl.DataFrame,
    detectors: Sequence[str],
    required: float,
    *,
    drawn: bool = False,
) -> Figures:
    """Whether an attack reaches its aim, and how many draws of its controls do."""
    attacked = rows.filter(splat=ATTACKED)
    verdict = _verdict(attacked, detectors, required, drawn)
    of: Labels = {"splat": ATTACKED}
    entries: list[tuple[Labels, Figure | float]] = [
        ({MEASURE: "reached_unambiguously", **of}, _once(verdict.unambiguous)),
        ({MEASURE: "score", **of}, verdict.score),
    ]
    for splat in CONTROLS:
        draws = rows.filter(splat=splat).partition_by("draw", maintain_order=True)
        verdicts = [_verdict(draw, detectors, required, drawn) for draw in draws]
        if verdicts:
            successes = sum(verdict.success for verdict in verdicts)
            held = Rate(successes=successes, total=len(verdicts))
            best = max(verdict.score for verdict in verdicts)
            entries.append(({MEASURE: "reached", "splat": splat}, held))
            entries.append(({MEASURE: "best_score", "splat": splat}, best))
    reached = reached_figures(attacked, detectors, required, drawn=drawn)
    return Figures.together([reached, Figures.of(entries)])


def reached_figures(
    attacked: pl.DataFrame,
    detectors: Sequence[str],
    required: float,
    *,
    drawn: bool = False,
) -> Figures:
    """Whether an attack reaches its aim, also with the object's own class gone."""
    strict = with_thresholds(attacked).with_columns(success=STRICT)
    verdicts = {
        "reached": _verdict(attacked, detectors, required, drawn),
        "reached_strictly": _verdict(strict, detectors, required, drawn),
    }
    return Figures.of(
        ({MEASURE: measure, "splat": ATTACKED}, _once(verdict.success))
        for measure, verdict in verdicts.items()
    )


def _once(holds: bool) -> Rate:
    return Rate(successes=int(holds), total=1)


def _verdict(
    rows: pl.DataFrame, detectors: Sequence[str], required: float, drawn: bool
) -> Verdict:
    """The verdict of one splat."""
    unambiguous = pl.col("unambiguous").fill_null(pl.col("success"))
    columns = rows.select("detector", "success", unambiguous, score="aim")
    each = [
        columns.filter(detector=name).drop("detector").to_dicts() for name in detectors
    ]
    views = [[Verdict(**cells) for cells in view] for view in zip(*each, strict=True)]
    return overall_verdict(views, required, drawn=drawn)
