"""What is left of an attack under other conditions: the same views in other renderers,
through other files, changed by a camera, or after a defence.

Rates count only views in which the clean object is detected under the same condition.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import polars as pl
from torch import Tensor

from attacks.detectors.base import Detector
from attacks.figures.frame import Figures
from attacks.gaussian_subset import Mask
from attacks.observe.conditions import OWN, Viewing, condition_of
from attacks.observe.observations import Observations, observe
from attacks.observe.rates import (
    Confidence,
    Measure,
    comparison_measures,
    count,
    reported,
    with_control,
)
from attacks.observe.rows import ATTACKED, CLEAN, Cell, frame_of
from attacks.observe.sector import HIDDEN, sector_figures
from attacks.observe.views import ViewDetections, as_saved, object_boxes
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
    new_cells: Callable[[], Callable[[ViewDetections], Mapping[str, Cell]]],
) -> Iterator[tuple[str, Observations]]:
    """Each condition, and what was seen under it of scenes as their files hold them.

    `render` shows where the object is. `new_cells` makes, for each condition, what
    gives the further cells of a row.
    """
    saved = {name: as_saved(scene) for name, scene in scenes.items()}

    def box_of(camera: Camera) -> Tensor | None:
        (box,) = object_boxes(scenes[CLEAN], mask, camera, render=render)
        return box

    for name in names:
        condition = condition_of(name, viewing)
        seen = observe(
            condition, saved, cameras, detectors, boxes=box_of, cells=new_cells()
        )
        yield name, seen


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


def together(plain: Observations, under: Sequence[Observations]) -> Observations:
    """What was seen without a condition and under several, as one table of rows and one
    of detections.
    """
    tables = {}
    for kind in ("rows", "detections"):
        own = getattr(plain, kind).with_columns(condition=pl.lit(OWN))
        others = [getattr(part, kind) for part in under]
        table = pl.concat([own, *others], how="diagonal")
        tables[kind] = frame_of(table.to_dicts())
    return Observations(**tables)
