"""The figures of an attack, counted from its rows: for whoever checks a result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import polars as pl

from attacks.dagger.config import Config, DaggerConfig, EotConfig
from attacks.objectives import reached_by
from attacks.observe.measures import STRICT, aim_figures
from attacks.observe.rows import ATTACKED, CLEAN, NOISE, ROWS
from attacks.pgd import Verdict

FIXED, DRAWN = "dagger", "dagger-eot"
"""Kinds of results, by where views come from."""


def figures(record: Mapping[str, Any], tables: Mapping[str, pl.DataFrame]) -> dict[str, Any]:
    """Every figure of a result that follows from its rows.

    Args:
        record: Its result.json, of which the settings count.
        tables: Its rows.
    """
    settings = record["config"]
    judged = settings["judged"]["cameras"]["elevations"] if record["story"] == DRAWN else None
    config: Config = EotConfig(required_views=settings["required_views"])
    if record["story"] == FIXED:
        needed = {name: settings[name] for name in ("required_views", "required_detectors")}
        config = DaggerConfig(**needed)
    detectors = [str(one["detector"]) for one in record["detectors"]]
    return counted(tables[ROWS], detectors, record["target"], config, judged)


def counted(
    rows: pl.DataFrame,
    detectors: Sequence[str],
    target: str | None,
    config: Config,
    elevations: tuple[float, float] | None,
) -> dict[str, Any]:
    """Every figure that follows from the rows of an attack.

    Args:
        rows: Of what was seen.
        detectors: Names of those attacked.
        target: The wanted class; None if none is.
        config: Says in how many views, and with how many detectors, the aim has to be reached.
        elevations: Interval of the cameras that judge, degrees; None where they are not drawn.
    """
    attacked = rows.filter(splat=ATTACKED)
    verdict = config.verdict(_grid(attacked, detectors))
    by_draw = rows.filter(splat=NOISE).partition_by("draw", maintain_order=True)
    noise = [config.verdict(_grid(draw, detectors)) for draw in by_draw]
    each = [attacked.filter(detector=name) for name in detectors]
    confidences = [_confidence(own, target, config) for own in each]
    return {
        **_verdict_of(verdict),
        "strict": config.verdict(_grid(attacked.with_columns(success=STRICT), detectors)).success,
        "target_confidence": _least(confidences, config.required_detectors),
        **aim_figures(rows, detectors, elevations),
        "noise": {
            "scores": [one.score for one in noise],
            "successes": sum(one.success for one in noise),
            "draws": len(noise),
        },
        "detectors": [
            {**_verdict_of(config.verdict(_grid(own, [name]))), "target_confidence": confidence}
            for name, own, confidence in zip(detectors, each, confidences, strict=True)
        ],
        "views": [_of_view(view) for (_, _), view in rows.group_by("detector", "view", maintain_order=True)],
    }


def _grid(rows: pl.DataFrame, detectors: Sequence[str]) -> list[list[Verdict]]:
    """The verdicts of one splat: for each view those of all detectors."""
    found = [
        [
            Verdict(success=success, score=score, unambiguous=unambiguous)
            for success, score, unambiguous in own.select("success", "aim", "unambiguous").iter_rows()
        ]
        for own in (rows.filter(detector=name) for name in detectors)
    ]
    return [list(row) for row in zip(*found, strict=True)]


def _verdict_of(verdict: Verdict) -> dict[str, Any]:
    return {"success": verdict.success, "unambiguous": verdict.unambiguous, "score": verdict.score}


def _confidence(rows: pl.DataFrame, target: str | None, config: Config) -> float | None:
    """Confidence of a detector in the wanted class that enough views reach."""
    return None if target is None else reached_by(rows["target_score"].to_list(), config.required_views)


def _least(values: Sequence[float | None], required: float) -> float | None:
    known = [value for value in values if value is not None]
    return reached_by(known, required) if known else None


def _of_view(rows: pl.DataFrame) -> dict[str, Any]:
    """What one detector makes of one view."""
    clean, attacked = (rows.filter(splat=splat).row(0, named=True) for splat in (CLEAN, ATTACKED))
    noise = rows.filter(splat=NOISE)
    known = clean["original"] is not None
    return {
        "success": attacked["success"],
        "unambiguous": attacked["unambiguous"],
        "score": attacked["aim"],
        "clean_success": clean["success"],
        "clean_score": clean["aim"],
        "noise_successes": noise["success"].to_list(),
        "noise_scores": noise["aim"].to_list(),
        "original": clean["original"],
        "clean_confidence": clean["original_score"] if known else 0.0,
        "original_confidence": attacked["original_score"] if known else 0.0,
        "target_confidence": attacked["target_score"],
        "target_confidence_clean": clean["target_score"],
    }
