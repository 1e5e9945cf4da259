"""An object that is hidden from a sector of directions: how often detectors miss it
inside of the sector, and still detect it elsewhere.

Rates are conditioned on the clean splat: only views count in which the same detector
detects the clean object. Cameras of training images are counted apart from others,
because a splat is fitted to them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import polars as pl
import torch

from attacks.figures.frame import Figures
from attacks.figures.rate import FEW
from attacks.observe.observations import seen_from
from attacks.observe.rates import (
    Confidence,
    Measure,
    comparison_measures,
    count,
    of,
    reported,
    with_control,
)
from attacks.observe.rows import ATTACKED, DEPTH
from attacks.observe.views import ViewDetections
from mi_splat.cameras.camera import Camera
from mi_splat.cameras.directions import UP, Point, upright

INSIDE = "inside"
ELSEWHERE = "elsewhere"
"""What the figures of a sector are counted over: labels of the name `scope`."""
TRAIN = "train"
TEST = "test"
"""Whether a camera took one of the training images: labels of the name `split`."""
HIDDEN = f"{DEPTH}hidden"
"""Column with the depth of a camera inside the sector, degrees."""


def sector_cells(
    depth_of: Callable[[Camera], float],
    *,
    centre: Point,
    up: Point = UP,
    training: Iterable[Camera] = (),
) -> Callable[[ViewDetections], dict[str, Any]]:
    """Cells of a row: where its camera stands, how deep inside the sector, and whether
    it took a training image.

    Args:
        depth_of: Degrees from a camera to the sector's edge, inside > 0, in a world
            whose up is z; as `Trigger.angle_to_edge`.
        centre: (3,) middle of the object, world units.
        up: (3,) direction that is up in the world of the cameras.
        training: The cameras of the training images.
    """
    poses = [camera.to_world for camera in training]
    angles_of = seen_from(centre, up)

    def cells(seen: ViewDetections) -> dict[str, Any]:
        pose = seen.camera.to_world
        depth = depth_of(upright(seen.camera, centre, up))
        is_trained = any(torch.allclose(pose, other) for other in poses)
        return {
            **angles_of(seen),
            "split": TRAIN if is_trained else TEST,
            HIDDEN: max(-180.0, min(depth, 180.0)),  # where there is no edge
        }

    return cells


def sector_figures(rows: pl.DataFrame, confidence: Confidence) -> Figures:
    """Rates inside of the sector and elsewhere, of each split and of both together.

    `found_clean` and `found_attacked` are of all views in which the object shows.
    `detected`: the object's class is still detected on it, `missed`: it is not, and
    `nothing`: no class at all is, of the views in which the clean object is detected.
    """
    scope = pl.when(pl.col(HIDDEN) >= 0)
    paired = with_control(rows).with_columns(
        scope=scope.then(pl.lit(INSIDE)).otherwise(pl.lit(ELSEWHERE))
    )
    measures = dict(comparison_measures(confidence, targeted=False))
    missed = measures["missed"]
    measures["detected"] = Measure(holds=~missed.holds, given=missed.given)
    measures["nothing"] = Measure(
        holds=of(ATTACKED) & ~reported("score", confidence), given=missed.given
    )
    parts = [("detector", "scope"), ("detector", "scope", "split")]
    return Figures.together(
        count(paired, measures, by, clusters=("block",)) for by in parts
    )


def sector_doubts(figures: Figures, detectors: Sequence[str]) -> Iterator[str]:
    """Reasons to doubt the rates of a sector."""
    for detector in detectors:
        for split in (TRAIN, TEST):
            labels = {"detector": detector, "scope": INSIDE, "split": split}
            total = figures.rate("missed", **labels).total
            if total < FEW:
                which = "held-out" if split == TEST else "training"
                shown = f"{total} {which} views inside the sector: few"
                yield f"{detector} detects the clean object in {shown}"
