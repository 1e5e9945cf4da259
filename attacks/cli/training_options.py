"""The options of the commands that train and score small detectors; see `attacks.cli.options`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from attacks.cli.options import OneDetector
from attacks.detectors.training.config import BackgroundConfig, SplatConfig, TrainConfig, TrainingSetConfig

SmallDetector = Literal["fasterrcnn_small", "yolov8n_small"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainDetectorOptions:
    """Train a small detector from nothing, on path-traced pictures and splats that are made first.

    A training that was interrupted goes on where it stopped when the same command is given again.
    """

    detector: Annotated[SmallDetector, arg(name="detectors")] = "fasterrcnn_small"
    """Which one; yolov8n_small needs the extra `yolo`."""
    data: Path = Path("out/detector-data")
    """Folder of the pictures; what is missing in it is made first."""
    out: Path = Path("out/detector")
    """Folder of checkpoint.safetensors, curves.json and best.safetensors, the best weights so far."""
    sets: TrainingSetConfig = field(default_factory=TrainingSetConfig)
    """How many pictures of each kind."""
    validate_every: int = 2
    """Epochs between two validations."""
    processes: int = 2
    """Processes that make pictures; 0 makes them in this one."""
    threads: int = 2
    """Threads that train."""
    only_data: bool = False
    """Stop when the pictures are made."""
    start: Path | None = None
    """Weights to begin from instead of pretraining."""
    config: TrainConfig = field(default_factory=TrainConfig)
    """The training itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateDetectorOptions:
    """Score a detector on objects, cameras, lights and surroundings that the project's own were not trained on.

    Average precision by class; recall by elevation, distance, size, brightness and sun; and false positives per
    picture: of pictures with objects, and of streets, parks, rooms, grounds and random surroundings without any. A
    detector of more classes, for instance one trained on COCO, is scored on the project's eight; what else it reports
    is listed.
    """

    detector: OneDetector = "fasterrcnn_small"
    """Name of a detector that knows the eight classes (see `mi-splat detectors`)."""
    weights: Path | None = None
    """Weights to score; None takes the usual ones."""
    data: Path = Path("out/detector-data")
    """Folder of the pictures; what is missing in it is made first."""
    out: Path = Path("out/detector/held-out.json")
    """JSON file for the figures; tables (.md) and a picture of recall (.png, extra `figures`) are written beside it."""
    pictures: int = 240
    """Path-traced pictures with objects."""
    samples: int = 24
    """Samples per pixel in them."""
    splats: int = 32
    """Scenes that are made into splats; 0 leaves them out."""
    splat: SplatConfig = field(default_factory=SplatConfig)
    """How splats are made."""
    backgrounds: BackgroundConfig = field(default_factory=BackgroundConfig)
    """Pictures without any object."""
    confidence: float = 0.5
    """Least confidence of an object that is found, and of a false positive."""
    scenes: tuple[Path, ...] = ()
    """Scene XMLs of splats to score as well, from all their cameras; shapes whose id is a class are their objects."""
    processes: int = 2
    """Processes that make pictures; 0 makes them in this one."""
    threads: int = 1
    """Threads of torch."""
    json: bool = False
    """Print the figures as one JSON document on stdout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CompareDetectorsOptions:
    """Put the figures of several detectors side by side: mAP, false positives, and recall by elevation."""

    figures: Positional[tuple[Path, ...]] = ()
    """Files that `mi-splat evaluate-detector` wrote; at least one."""
    out: Path = Path("out/detector/comparison.md")
    """File for the tables; recall as a picture (.png, extra `figures`) and figures (.compared.json) lie beside it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlotDetectorTrainingOptions:
    """Draw losses and validation mAP of a training by epoch; needs the extra `figures`."""

    curves: Positional[Path] = Path("out/detector/curves.json")
    """JSON file with the history of a training."""
    out: Path = Path("out/detector/curves.png")
    """Picture to write."""
