"""Labelled pictures that need no renderer, detections on them, and what is measured of these."""

import json
from collections.abc import Sequence
from typing import Any

import polars as pl
import torch
from torch import Tensor, nn

from attacks.detectors import torchvision
from attacks.detectors.base import Detections
from attacks.detectors.catalogue import COCO_CLASSES
from attacks.detectors.evaluation import figures, look_at, set_figures, with_right
from attacks.detectors.training.pictures import LabelledPicture, ViewingConditions
from attacks.observe.look import Looked
from attacks.observe.rows import DETECTIONS, ROWS
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
        told, self.rows = self.rows[: len(images)], self.rows[len(images) :]
        assert len(told) == len(images)
        return list(told)


def seen_by(results: Sequence[Detections], pictures: Sequence[LabelledPicture], *, name: str = "") -> Looked:
    """The rows of detections in the pictures of one set."""
    return look_at(TableDetector(*results), {name: pictures})


def measured(
    results: Sequence[Detections], pictures: Sequence[LabelledPicture], *, confidence: float = 0.5
) -> dict[str, Any]:
    """The figures of detections in the pictures of one set."""
    looked = seen_by(results, pictures)
    return set_figures(looked.rows, with_right(looked.rows, looked.detections), len(pictures), confidence)


def evaluated(*names: str, confidence: float = 0.5) -> tuple[dict[str, Any], Looked]:
    """Record and rows of `mi-splat evaluate-detector`: each finds 2 of 4 cars, and imagines a tv here and there."""
    car, screen = picture((HERE, 1)), (THERE, 0.9, "tv")
    hits = [reported((HERE, 0.9, "car"), screen), reported((HERE, 0.9, "car"), screen, (AWAY, 0.9, "kite"))]
    looks = [*hits, reported(screen, (HERE, 0.8, "truck")), reported()]
    sets = {
        "path traced": (looks, [car] * 4),
        "background: street": ([reported(screen)] * 2 + [reported()] * 6, [picture()] * 8),
        "background: park": ([reported()] * 8, [picture()] * 8),
        "scenes/x.xml": (looks, [car] * 4),
    }
    told = [result for results, _ in sets.values() for result in results]
    pictures = {name: members for name, (_, members) in sets.items()}
    rows, detections = [], []
    for name in names or ("one",):
        detector = TableDetector(*told)
        detector.name = name
        looked = look_at(detector, pictures)
        rows.append(looked.rows)
        detections.append(looked.detections)
    seen = Looked(rows=pl.concat(rows), detections=pl.concat(detections))
    known = {name: {"fingerprint": "0" * 16, "min_confidence": 0.05} for name in names or ("one",)}
    record: dict[str, Any] = {"story": "evaluate-detector", "confidence": confidence, "detectors": known}
    record["sets"] = {name: len(members) for name, members in pictures.items()}
    counted = figures(record, {ROWS: seen.rows, DETECTIONS: seen.detections})["detectors"]
    record["detectors"] = {name: {**known[name], **counted[name]} for name in known}
    return json.loads(json.dumps(record)), seen


def random_detector(name: str, *, seed: int = 0) -> torchvision.TorchvisionDetector:
    """A detector of random weights; it finds nothing, but its image gradients are not zero.

    Without the warm-up of the BatchNorm statistics, the signal of a random network dies on the way.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = torchvision._build(name)
        warm_up(model.eval())
    torchvision._freeze_norms(name, model)
    return torchvision.wrap(name, model, torchvision._labels(name))


def warm_up(model: nn.Module, *, batches: int = 8, side: int = 64) -> None:
    """Let every BatchNorm average the statistics of a few batches of noise; frozen ones stay."""
    norms = [m for m in model.modules() if isinstance(m, nn.BatchNorm2d)]
    if not norms:
        return
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # a cumulative average
        norm.train()
    transform: Any = model.transform
    holder = torchvision._threshold_holder(model)
    usual = transform.min_size, holder.score_thresh
    transform.min_size, holder.score_thresh = (side,), 1.0  # small, and nothing to suppress
    with torch.no_grad():
        for _ in range(batches):
            model(list(torch.rand(2, 3, side, side)))
    transform.min_size, holder.score_thresh = usual
