"""Labelled pictures that need no renderer, detections on them, and what is measured of these."""

from __future__ import annotations

import json
from typing import Any

import torch
from torch import Tensor

from attacks.detectors.base import Detections
from attacks.detectors.catalogue import COCO_CLASSES, SMALL_CLASSES
from attacks.detectors.evaluation.held_out import total_false_positives
from attacks.detectors.evaluation.measure import measure
from attacks.detectors.training.pictures import LabelledPicture, ViewingConditions
from tests.fakes import ColourDetector

HERE, THERE, AWAY = [10.0, 10.0, 50.0, 50.0], [60.0, 60.0, 90.0, 90.0], [0.0, 60.0, 30.0, 90.0]
SEEN = ViewingConditions(elevation=50.0, distance=6.0, extent=4.0, sun_elevation=20.0, sun_strength=0.2)


def drawn(box: tuple[int, int, int, int], *, size: int = 96, label: int = 1) -> LabelledPicture:
    """A grey picture with one bright rectangle."""
    image = torch.full((size, size, 3), 60, dtype=torch.uint8)
    x0, y0, x1, y1 = box
    image[y0:y1, x0:x1] = torch.tensor([250, 40 * label, 30], dtype=torch.uint8)
    return LabelledPicture(image, torch.tensor([box], dtype=torch.float32), torch.tensor([label]))


def picture(*objects: tuple[list[float], int], seen: ViewingConditions | None = SEEN) -> LabelledPicture:
    """A dark picture with objects: their boxes and labels."""
    boxes = torch.tensor([box for box, _ in objects]).reshape(-1, 4)
    labels = torch.tensor([label for _, label in objects], dtype=torch.int64)
    image = torch.full((100, 100, 3), 51, dtype=torch.uint8)
    return LabelledPicture(image, boxes, labels, () if seen is None else (seen,) * len(objects))


def reported(*rows: tuple[list[float], float, str]) -> Detections:
    """Detections from their boxes, scores and labels."""
    boxes = torch.tensor([box for box, _, _ in rows]).reshape(-1, 4)
    return Detections(boxes, torch.tensor([score for _, score, _ in rows]), tuple(label for _, _, label in rows))


class TableDetector(ColourDetector):
    """Reports what it was told, picture by picture; knows the classes of COCO."""

    classes = COCO_CLASSES

    def __init__(self, *rows: Detections) -> None:
        self.rows = rows

    def detect(self, images: Tensor) -> list[Detections]:
        assert len(images) == len(self.rows)
        return list(self.rows)


def document(name: str = "one", *, confidence: float = 0.5) -> dict[str, Any]:
    """What `mi-splat evaluate-detector` writes: 2 of 4 cars are found, with false positives beside them and without."""
    car, screen = picture((HERE, 1)), (THERE, 0.9, "tv")
    hits = [reported((HERE, 0.9, "car"), screen), reported((HERE, 0.9, "car"), screen, (AWAY, 0.9, "kite"))]
    misses = [reported(screen, (HERE, 0.8, "truck")), reported()]
    empty = [picture()] * 8
    measured = {
        "path traced": measure([*hits, *misses], [car] * 4, SMALL_CLASSES, confidence=confidence),
        "background: street": measure([reported(screen)] * 2 + [reported()] * 6, empty, SMALL_CLASSES),
        "background: park": measure([reported()] * 8, empty, SMALL_CLASSES),
        "scenes/x.xml": measure([*hits, *misses], [car] * 4, SMALL_CLASSES, confidence=confidence),
    }
    figures: dict[str, Any] = {
        "detector": name,
        "fingerprint": "0" * 16,
        "min_confidence": 0.05,
        "confidence": confidence,
        "false_positives": total_false_positives(measured),
        "sets": {key: measurement.as_dict() for key, measurement in measured.items()},
    }
    return json.loads(json.dumps(figures))  # type: ignore[no-any-return]
