"""`mi-splat detectors`: the detectors, their classes, and whether their weights are on this machine."""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from attacks.cli.options import DetectorsOptions
from attacks.detectors import DETECTORS
from attacks.detectors.weights import SMALL_YOLO
from mi_splat.cli.console import show, show_json

SHOWN = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One detector of the list.

    Attributes:
        name: Key in `attacks.detectors.DETECTORS`.
        classes: What it can see.
        weights: Where its weights are, or would be.
        available: Whether they are there.
        advice: How to get them; empty where they are there.
    """

    name: str
    classes: tuple[str, ...]
    weights: str
    available: bool
    advice: str


def run(options: DetectorsOptions) -> int:
    """List the detectors."""
    kinds = {"fasterrcnn_small": _shipped, **{name: _yolo for name in DETECTORS if name.startswith("yolo")}}
    entries = [kinds.get(name, _published)(name) for name in DETECTORS]
    if options.json:
        show_json({"detectors": [dataclasses.asdict(entry) for entry in entries]})
        return 0
    for entry in entries:
        names = ", ".join(entry.classes[:SHOWN]) + (", ..." if len(entry.classes) > SHOWN else "")
        show(entry.name)
        show(f"  weights: {'there' if entry.available else entry.advice}")
        show(f"  {len(entry.classes)} classes: {names}")
    return 0


def _shipped(name: str) -> Entry:
    """The detector whose weights come with this package."""
    from attacks.detectors.small import CLASSES
    from attacks.detectors.torchvision import SHIPPED

    return _entry(name, CLASSES, SHIPPED, "missing; they are part of the package, so install it again")


def _yolo(name: str) -> Entry:
    """One of ultralytics', which the user installs; its hub looks in the working folder first."""
    from attacks.detectors.small import CLASSES

    small = name == "yolov8n_small"
    weights = SMALL_YOLO if small else Path(f"{name}.pt")
    if importlib.util.find_spec("ultralytics") is None:
        entry = _entry(name, CLASSES if small else _coco(), weights, "")
        advice = "needs the package ultralytics (AGPL-3.0): pip install 'mi-splat[yolo]'"
        return dataclasses.replace(entry, available=False, advice=advice)
    if small:
        return _entry(name, CLASSES, weights, "not here; a checkout has them in scenes/detectors")
    return _entry(name, _coco(), weights, "not here; downloaded when first used, or name a file with --weights")


def _coco() -> list[str]:
    """COCO's 80 classes."""
    from torchvision.models.detection import FasterRCNN_ResNet50_FPN_Weights

    names = FasterRCNN_ResNet50_FPN_Weights.COCO_V1.meta["categories"]
    return [name for name in names if name not in ("__background__", "N/A")]


def _published(name: str) -> Entry:
    """One of torchvision's, whose hub keeps what it has downloaded in torch's cache folder."""
    import torch
    from torchvision.models import get_model_weights

    weights = get_model_weights(name)["DEFAULT"]
    classes = [label for label in weights.meta["categories"] if label not in ("__background__", "N/A")]
    cached = Path(torch.hub.get_dir(), "checkpoints", Path(weights.url).name)
    return _entry(name, classes, cached, "not here; downloaded when first used, or name a file with --weights")


def _entry(name: str, classes: Iterable[str], weights: Path, advice: str) -> Entry:
    """A row of the list, with a look at the disk."""
    there = weights.is_file()
    return Entry(
        name=name, classes=tuple(classes), weights=str(weights), available=there, advice="" if there else advice
    )
