"""What is left of an attack under other conditions: the same views in other renderers,
through other files, changed by a camera, or after a defence.

Rates count only views in which the clean object is detected under the same condition.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import polars as pl

from attacks.detectors.base import Detector
from attacks.figures.frame import Figures
from attacks.gaussian_subset import Mask
from attacks.observe.conditions import OWN, Condition, Viewing, condition_of
from attacks.observe.observations import Observations
from attacks.observe.rates import (
    Confidence,
    Measure,
    comparison_measures,
    count,
    reported,
    with_control,
)
from attacks.observe.rows import ATTACKED, frame_of
from attacks.observe.sector import HIDDEN, sector_figures
from attacks.observe.views import ViewDetections, evaluate
from mi_splat.cameras.camera import Camera, RenderFn
from mi_splat.scene import GaussianScene

VOTE = "majority of 3 views"
"""What scores are called that are the medians of those from the camera itself and from
5 degrees to either side: at any threshold the vote of the three. No images are made for
it, and it has no rows.
"""
_ASIDE = ("5 degrees", "-5 degrees")
STANDARD = (
    "JPEG 90",
    "JPEG 75",
    "JPEG 50",
    "blur 1",
    "5 bits",
    "0.5 x size",
    "2 x size",
    *_ASIDE,
    "10 degrees",
    "20 degrees",
    "0.9 x distance",
    "1.1 x distance",
    ".spz",
    ".sog",
    ".splat",
    "SH of degree 0",
    "tile-antialiased",
    "ray",
    "median of 8 neighbours",
    VOTE,
)
"""The conditions that `standard` stands for."""

Look = Callable[[Mapping[str, Sequence[ViewDetections]]], Observations]
"""What was seen of a clean and an attacked splat, as rows."""


def named_conditions(names: Sequence[str]) -> tuple[str, ...]:
    """The conditions that a user's names stand for, each once; of a vote those that it
    needs.
    """
    every = [
        one for name in names for one in (STANDARD if name == "standard" else (name,))
    ]
    if VOTE in every:
        every = [*_ASIDE, *every]
    return tuple(name for name in dict.fromkeys(every) if name != VOTE)


def survived(
    scenes: Mapping[str, GaussianScene],
    mask: Mask,
    cameras: Sequence[Camera],
    detectors: Sequence[Detector],
    names: Sequence[str],
    *,
    viewing: Viewing,
    render: RenderFn,
    look: Look,
) -> Iterator[tuple[str, Observations]]:
    """Each condition, and what was seen under it.

    `render` shows where the object is, and `look` makes rows of what was seen.
    """
    for name in names:
        condition = condition_of(name, viewing)
        moved = [condition.move(camera) for camera in cameras]
        seen = evaluate(
            scenes,
            mask,
            moved,
            detectors,
            render=_unmoved(condition),
            shown_by=render,
        )
        yield name, look(seen)


def voted(rows: pl.DataFrame) -> pl.DataFrame:
    """The rows of a vote: scores are the medians over three views."""
    of_vote = rows.filter(pl.col("condition").is_in([OWN, *_ASIDE]))
    scores = [
        name
        for name in ("score", "original_score", "target_score", "any_overlap")
        if name in rows.columns
    ]
    keys = ("splat", "detector", "view")
    medians = of_vote.group_by(keys, maintain_order=True).agg(
        pl.col(name).median() for name in scores
    )
    own = rows.filter(condition=OWN).drop(scores)
    joined = own.join(medians, on=keys, maintain_order="left")
    return joined.select(rows.columns).with_columns(condition=pl.lit(VOTE))


def survival_figures(rows: pl.DataFrame, confidence: Confidence) -> Figures:
    """How often, under each condition, the object is missed, or replaced by the target,
    of the views in which the clean one is detected; where there is a sector, also
    inside of it and elsewhere.
    """
    if set(_ASIDE) <= set(rows["condition"]):
        rows = pl.concat([rows, voted(rows)])
    parts = []
    for seen in rows.partition_by("detector", maintain_order=True):
        targets = seen.filter(splat=ATTACKED)["target"]
        targeted = targets.null_count() < len(targets)
        measures = dict(comparison_measures(confidence, targeted=targeted))
        missed = measures["missed"]
        if targeted:
            wanted = reported("target_score", confidence)
            measures["replaced"] = Measure(
                holds=missed.holds & wanted, given=missed.given
            )
        parts.append(count(with_control(seen), measures, ("detector", "condition")))
    for (name,), of_one in rows.group_by("condition", maintain_order=True):
        if HIDDEN in rows.columns:
            sector = sector_figures(of_one, confidence)
            parts.append(sector.labelled(condition=str(name)))
    return Figures.together(parts)


def _unmoved(condition: Condition) -> RenderFn:
    """The condition of cameras that have been moved."""
    return replace(condition, move=lambda camera: camera)


def together(parts: Mapping[str, Observations]) -> Observations:
    """What was seen under several conditions, as one table of rows and one of
    detections.
    """
    tables = {
        kind: pl.concat(
            [
                getattr(part, kind).with_columns(condition=pl.lit(name))
                for name, part in parts.items()
            ],
            how="diagonal",
        )
        for kind in ("rows", "detections")
    }
    return Observations(
        **{kind: frame_of(table.to_dicts()) for kind, table in tables.items()}
    )
