"""Runs detectors over splats and views, and writes a row for each report.

A row is put together from its parts: what it is of (`ids`), where the camera is
(`camera_cells`), what is reported on the object (`report_cells`), and whether that
reaches an aim (`verdict_cells`).
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import polars as pl
import torch
from torch import Tensor

from attacks.detectors.base import Detections, Detector
from attacks.objectives.base import confidence, overlap
from attacks.observe.conditions import Condition
from attacks.observe.rows import (
    BOX,
    DETECTION_BOX,
    DETECTIONS,
    ROWS,
    SUFFIX,
    Cell,
    Row,
    frame_of,
    write_rows,
)
from attacks.observe.views import ViewDetections, detect_views
from attacks.search.loop import Verdict
from mi_splat.cameras.camera import Camera
from mi_splat.cameras.directions import UP, Direction, Point, direction_of
from mi_splat.scene import GaussianScene

ON_OBJECT = 0.5
NEAR_OBJECT = 0.1
"""IoU with the object's box from which a detection is on the object, and from which it
is at all near it.
"""


def camera_cells(
    camera: Camera, box: Tensor | None, direction: Direction | None = None
) -> dict[str, Cell]:
    """Where a camera is, and where the object is in its image."""
    if direction is None:
        angles = {}
    else:
        angles = {"azimuth": direction.azimuth, "elevation": direction.elevation}
    corners: Sequence[float | None] = (None,) * 4 if box is None else box.tolist()
    return {
        **angles,
        **dict(zip("xyz", camera.position.tolist(), strict=True)),
        **dict(zip(BOX, corners, strict=True)),
    }


def report_cells(
    detections: Detections,
    box: Tensor | None,
    *,
    original: str | Sequence[str] | None,
    target: str | None = None,
) -> dict[str, Cell]:
    """What is reported on the object: the best detection of any class, and the scores
    of its own class, or classes, and of the target.
    """
    own = [original] if isinstance(original, str) else original

    def score(labels: Sequence[str] | None, iou: float = ON_OBJECT) -> float:
        if box is None:
            return 0.0
        return confidence(detections, box, labels=labels, iou=iou)

    return {
        "original": None if own is None else " or ".join(own),
        "target": target,
        **_best(detections, box),
        "original_score": score(own),
        "target_score": None if target is None else score([target]),
        "any_overlap": score(own, NEAR_OBJECT),
    }


def _best(detections: Detections, box: Tensor | None) -> dict[str, Cell]:
    """The most confident detection on the object."""
    none: dict[str, Cell] = {
        "label": None,
        "score": 0.0,
        **dict.fromkeys((*DETECTION_BOX, "iou")),
    }
    if box is None or not len(detections):
        return none
    shared = overlap(detections.boxes, box)
    scores = torch.where(shared >= ON_OBJECT, detections.scores, -1.0)
    best = int(scores.argmax())
    if float(scores[best]) <= 0:
        return none
    return detection_cells(detections, best, float(shared[best]))


def detection_cells(
    detections: Detections, number: int, iou: float | None
) -> dict[str, Cell]:
    """One detection, and its IoU with the object's box."""
    corners = dict(zip(DETECTION_BOX, detections.boxes[number].tolist(), strict=True))
    return {
        "label": detections.labels[number],
        "score": float(detections.scores[number]),
        **corners,
        "iou": iou,
    }


def verdict_cells(verdict: Verdict) -> dict[str, Cell]:
    """Whether an aim is reached, and how near it is."""
    return {
        "success": verdict.success,
        "unambiguous": verdict.unambiguous,
        "aim": verdict.score,
    }


def detection_rows(
    ids: Mapping[str, Cell], detections: Detections, box: Tensor | None
) -> list[Row]:
    """Every detection of an image."""
    if box is None or not len(detections):
        shared = [None] * len(detections)
    else:
        shared = overlap(detections.boxes, box).tolist()
    return [
        {**ids, **detection_cells(detections, number, iou)}
        for number, iou in enumerate(shared)
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Observations:
    """What detectors reported, as two tables."""

    rows: pl.DataFrame  # a row for each splat, view and detector
    detections: pl.DataFrame  # a row for each detection

    def write(self, folder: Path) -> list[Path]:
        """Write rows.csv.xz and detections.csv.xz."""
        tables = {ROWS: self.rows, DETECTIONS: self.detections}
        return [
            write_rows(table, folder / f"{name}{SUFFIX}")
            for name, table in tables.items()
        ]


def observe(
    condition: Condition,
    splats: Mapping[str, GaussianScene],
    cameras: Sequence[Camera],
    detectors: Sequence[Detector],
    *,
    boxes: Callable[[Camera], Tensor | None],
    cells: Callable[[ViewDetections], Mapping[str, Cell]],
) -> Observations:
    """Run every detector on every splat from every camera under a condition."""
    numbers = [view for view, camera in enumerate(cameras) if condition.holds(camera)]
    moved = [condition.move(cameras[view]) for view in numbers]
    where = [boxes(camera) for camera in moved]

    def views() -> Iterator[tuple[dict[str, Cell], ViewDetections]]:
        for name, splat in splats.items():
            shown, render = condition.show(splat)
            for seen in detect_views(
                shown, moved, detectors, render=render, boxes=where
            ):
                yield (
                    {"condition": condition.name, "splat": name},
                    replace(seen, view=numbers[seen.view]),
                )

    return observations_of(views(), cells)


def observations_of(
    views: Iterable[tuple[Mapping[str, Cell], ViewDetections]],
    cells: Callable[[ViewDetections], Mapping[str, Cell]],
) -> Observations:
    """A row for each view, with what it is of and with further cells, and one for each
    of its detections.
    """
    rows = list[Row]()
    detections = list[Row]()
    for of, seen in views:
        ids = {**of, "detector": seen.detector, "view": seen.view}
        rows.append({**ids, **camera_cells(seen.camera, seen.box), **cells(seen)})
        detections += detection_rows(ids, seen.detections, seen.box)
    return Observations(rows=frame_of(rows), detections=frame_of(detections))


def seen_from(
    centre: Point, up: Point = UP
) -> Callable[[ViewDetections], dict[str, Any]]:
    """Angles and distance of a view's camera from a centre (3,), world units: a part of
    the `cells` of `observe`; `up` (3,) is up in their world.
    """

    def cells(seen: ViewDetections) -> dict[str, Any]:
        direction = direction_of(seen.camera, centre, up)
        distance = float(
            torch.linalg.vector_norm(
                seen.camera.position - torch.tensor(centre).to(seen.camera.position)
            )
        )
        return {
            "azimuth": direction.azimuth,
            "elevation": direction.elevation,
            "distance": distance,
        }

    return cells
