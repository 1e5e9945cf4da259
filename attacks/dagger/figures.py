"""The figures of an attack, counted from its rows: for whoever checks a result."""

from collections.abc import Mapping, Sequence
from typing import Any

import polars as pl

from attacks.dagger.config import Config, DaggerConfig, EotConfig
from attacks.objectives import reached_by
from attacks.observe.measures import STRICT, aim_figures
from attacks.observe.rows import ATTACKED, CLEAN, NOISE, ROWS
from attacks.search import Verdict

FIXED, DRAWN = "dagger", "dagger-eot"
"""Kinds of results, by where views come from."""


def figures(record: Mapping[str, Any], tables: Mapping[str, pl.DataFrame]) -> dict[str, Any]:
    """Every figure of a result that follows from its rows."""
    settings, drawn = record["config"], record["story"] == DRAWN
    judged = settings["judged"]["cameras"]["elevations"] if drawn else None
    config: Config = (
        EotConfig(required_views=settings["required_views"])
        if drawn
        else DaggerConfig(**{name: settings[name] for name in ("required_views", "required_detectors")})
    )
    detectors = [str(judged["detector"]) for judged in record["detectors"]]
    return counted(tables[ROWS], detectors, record["target"], config, judged)


def counted(
    rows: pl.DataFrame,
    detectors: Sequence[str],
    target: str | None,
    config: Config,
    elevations: tuple[float, float] | None,
) -> dict[str, Any]:
    """Every figure that follows from the rows of an attack."""
    each = []
    for name in detectors:
        scores = rows.filter(splat=ATTACKED, detector=name)["target_score"].to_list()
        confidence = None if target is None else reached_by(scores, config.required_views)
        each.append({**_verdict(rows.filter(splat=ATTACKED), [name], config), "target_confidence": confidence})
    confidences = [judged["target_confidence"] for judged in each if target is not None]
    return {
        **verdict_figures(rows, detectors, config),
        "target_confidence": reached_by(confidences, config.required_detectors) if confidences else None,
        **aim_figures(rows, detectors, elevations),
        "detectors": each,
        "views": [_of_view(view) for _, view in rows.group_by("detector", "view", maintain_order=True)],
    }


def verdict_figures(rows: pl.DataFrame, detectors: Sequence[str], config: Config) -> dict[str, Any]:
    """Whether an attack succeeded, also with the own class gone, and the draws of noise that did."""
    attacked = rows.filter(splat=ATTACKED)
    noise = [
        _verdict(draw, detectors, config) for draw in rows.filter(splat=NOISE).partition_by("draw", maintain_order=True)
    ]
    return {
        **_verdict(attacked, detectors, config),
        "strict": _verdict(attacked.with_columns(success=STRICT), detectors, config)["success"],
        "noise": {
            "scores": [verdict["score"] for verdict in noise],
            "successes": sum(verdict["success"] for verdict in noise),
            "draws": len(noise),
        },
    }


def _verdict(rows: pl.DataFrame, detectors: Sequence[str], config: Config) -> dict[str, Any]:
    """The verdict of one splat, as JSON can hold it."""
    unambiguous = pl.col("unambiguous").fill_null(pl.col("success"))
    columns = rows.select("detector", "success", unambiguous, score="aim")
    each = [columns.filter(detector=name).drop("detector").to_dicts() for name in detectors]
    verdict = config.verdict([[Verdict(**cells) for cells in view] for view in zip(*each, strict=True)])
    return {"success": verdict.success, "unambiguous": verdict.unambiguous, "score": verdict.score}


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
