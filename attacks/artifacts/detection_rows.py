"""Single detections as cells of rows, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from attacks.artifacts.rows import Cell, Column, Row
from attacks.detectors.base import Detections
from attacks.objectives import overlap

OBJECT = ("x0", "y0", "x1", "y1")
_BOX = ("box_x0", "box_y0", "box_x1", "box_y1")

DETECTION = (
    Column(name="class", kind="text", meaning="of the detection; empty where nothing is reported", optional=True),
    Column(name="score", kind="number", meaning="its confidence", optional=True),
    *(Column(name=name, kind="number", unit="pixels", meaning="of its box", optional=True) for name in _BOX),
    Column(name="iou", kind="number", meaning="of its box with the object's; empty without one", optional=True),
)
"""The columns of a detection, which are all empty in the row of a view without any."""


def detection_cells(found: Mapping[str, Any] | None, box: Sequence[float] | None) -> dict[str, Cell]:
    """The cells of one detection.

    Args:
        found: As `attacks.observe.drawing.listed` gives it; None where nothing is reported.
        box: (4,) of the object; None where it does not show.
    """
    if found is None:
        return dict.fromkeys(column.name for column in DETECTION)
    own = [float(value) for value in found["box"]]
    shared = None if box is None else round(float(overlap(torch.tensor(own), torch.tensor(box))), 4)
    return {"class": found["label"], "score": float(found["score"]), **dict(zip(_BOX, own, strict=True)), "iou": shared}


def detections_of(rows: Sequence[Row]) -> Detections:
    """The detections of the rows of one view."""
    there: list[Any] = [row for row in rows if row["class"] is not None]
    boxes = torch.tensor([[row[name] for name in _BOX] for row in there], dtype=torch.float32).reshape(-1, 4)
    scores = torch.tensor([row["score"] for row in there], dtype=torch.float32)
    return Detections(boxes, scores, tuple(row["class"] for row in there))


def object_box(row: Row) -> Tensor | None:
    """(4,) box of the object in pixels; None where it does not show."""
    corners: list[Any] = [row[name] for name in OBJECT]
    return None if None in corners else torch.tensor(corners, dtype=torch.float32)
