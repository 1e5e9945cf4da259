"""What the small detectors are trained on, and their training from the first picture to the exported weights."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from importlib import import_module
from pathlib import Path
from typing import Protocol

from attacks.detectors.catalogue import SMALL_CLASSES
from attacks.detectors.evaluation import false_positives, look_at, set_figures, with_right
from attacks.detectors.training.config import (
    BACKGROUNDS,
    BackgroundConfig,
    PictureSetConfig,
    SplatConfig,
    TrainingSetConfig,
)
from attacks.detectors.training.dataset import OnWork, background_sets, load, make, splat_set
from attacks.detectors.training.loop import DetectorTrainer, Training, export_weights
from attacks.detectors.training.pictures import LabelledPicture
from attacks.detectors.weights import fingerprint, read_weights

_TRAINERS = {
    "fasterrcnn_small": ("faster_rcnn", "FasterRCNNTrainer"),
    "yolov8n_small": ("yolo", "YOLOTrainer"),
}

TRAINING_SPLATS = SplatConfig(views=12, samples=6, objects=8000, surroundings=20_000, steps=80, pictures=8)
"""Splats of the training set, coarser than those of the evaluation."""

IN_STREETS = PictureSetConfig(split="train", seed=4, around="street", farthest=9.0)
"""Objects in streets; from farther away most cameras would look at the houses."""

CONFIDENCE = 0.5
"""From which a detection counts in a validation."""


def trainer_of(name: str) -> DetectorTrainer:
    """The trainer of a small detector.

    Raises:
        DetectorError: It needs a package that is not there.
    """
    module, trainer = _TRAINERS[name]
    made: DetectorTrainer = getattr(import_module(f"attacks.detectors.training.{module}"), trainer)()
    return made


def training_pictures(
    folder: Path, counts: TrainingSetConfig, *, processes: int, on_work: OnWork
) -> tuple[list[LabelledPicture], list[LabelledPicture]]:
    """Pictures for training and for validation; what `folder` does not hold yet is made.

    Args:
        folder: Where the pictures are kept.
        counts: How many of each kind.
        processes: How many processes make pictures; 0 makes them in this one.
        on_work: Hears of the progress.

    Raises:
        InvalidValueError: The folder holds pictures that were made otherwise.
    """
    overhead_focus = ("car", "train", *SMALL_CLASSES)
    configs = {
        "validation": PictureSetConfig(split="validation", count=counts.validation),
        "train": PictureSetConfig(split="train", count=counts.pictures),
        "surroundings": PictureSetConfig(split="train", seed=1, count=counts.surroundings, empty=0.4, street=1.0),
        "overhead": PictureSetConfig(
            split="train", seed=3, count=counts.overhead, elevation=(50, 90), focus=overhead_focus, street=0.7
        ),
        "streets": replace(IN_STREETS, count=counts.streets),
    }
    sets: dict[str, list[LabelledPicture]] = {}
    for name, config in configs.items():
        if config.count:
            make(config, folder / name, processes=processes, on_step=_named(f"{name} pictures", on_work))
            sets[name] = load(folder / name, limit=config.count)
    validation = sets.pop("validation", []) + _backgrounds(
        BackgroundConfig(split="validation", scenes=counts.validation_backgrounds, samples=6), folder, on_work
    )
    parts = _splats(PictureSetConfig(split="train", seed=2), counts.splats, folder / "train-splats", on_work)
    parts += _splats(replace(IN_STREETS, seed=5), counts.street_splats, folder / "street-splats", on_work)
    empty = BackgroundConfig(split="train", scenes=counts.backgrounds, samples=6, shots=6)
    parts += _backgrounds(empty, folder, on_work)
    for more in (replace(empty, scenes=2 * counts.backgrounds, seed=1), replace(empty, samples=16, shots=3, seed=2)):
        parts += _backgrounds(more, folder, on_work, kinds=("street",))
    return [*(picture for pictures in sets.values() for picture in pictures), *parts], validation


def _splats(scenes: PictureSetConfig, count: int, folder: Path, on_work: OnWork) -> list[LabelledPicture]:
    return splat_set(scenes, range(count), folder, TRAINING_SPLATS, on_step=_named(folder.name, on_work))


def _backgrounds(
    config: BackgroundConfig, folder: Path, on_work: OnWork, *, kinds: Sequence[str] = BACKGROUNDS
) -> list[LabelledPicture]:
    name = f"{config.split}-backgrounds-{config.seed}"
    sets = background_sets(folder / name, config, kinds=kinds, on_step=_named(name, on_work))
    return [picture for pictures in sets.values() for picture in pictures]


def train(
    training: Training,
    pictures: Sequence[LabelledPicture],
    validation: Sequence[LabelledPicture],
    folder: Path,
    *,
    validate_every: int = 2,
    start: Path | None = None,
    on_work: OnWork,
    on_epoch: Callable[[Mapping[str, object]], None],
) -> None:
    """Do what is left of a training; write checkpoint, curves.json and the best weights so far after each epoch.

    Args:
        training: A new one, or one that was resumed.
        pictures: To train on.
        validation: To choose the best epoch by.
        folder: Where the files go.
        validate_every: Epochs between two validations.
        start: Weights that a new training begins from instead of pretraining.
        on_work: Hears of the progress.
        on_epoch: Called with the figures of each finished epoch, and of the pretraining as epoch 0.

    Raises:
        DetectorError: The weights to start from are missing or do not fit, or the training was resumed and began with
            others, or with other pictures.
    """
    config = training.config
    training.go_on_with(_digest(start, pictures, validation), folder)
    while training.epoch < config.epochs:
        if not training.history and start is not None:
            training.begin_from(start)
        elif not training.history and config.pretraining:
            training.pretrain(pictures, on_step=_named("pretraining", on_work))
            training.save(folder)
            on_epoch(training.history[-1])
        begun = time.monotonic()
        losses = training.run_epoch(pictures, on_step=_named(f"epoch {training.epoch + 1} of {config.epochs}", on_work))
        record: dict[str, object] = {
            "epoch": training.epoch,
            "pictures": len(pictures),
            "losses": losses,
            "seconds": time.monotonic() - begun,
        }
        if training.epoch % validate_every == 0 or training.epoch == config.epochs:
            record |= validated(training, validation, folder)
        training.history.append(record)
        training.save(folder)
        curves = {"config": asdict(config), "history": training.history}
        (folder / "curves.json").write_text(json.dumps(curves, indent=1))
        on_epoch(record)


def _digest(start: Path | None, *sets: Sequence[LabelledPicture]) -> str:
    """SHA-256 of the weights to begin from, and of the pictures and labels of some sets."""
    total = hashlib.sha256(b"" if start is None else fingerprint(read_weights(start)).encode())
    for pictures in sets:
        total.update(f"{len(pictures)} pictures".encode())
        for picture in pictures:
            for values in (picture.image, picture.boxes, picture.labels):
                total.update(repr(tuple(values.shape)).encode())
                total.update(values.numpy().tobytes())
    return total.hexdigest()


def validated(training: Training, validation: Sequence[LabelledPicture], folder: Path) -> dict[str, object]:
    """Score the averaged weights, and export them if none were better.

    What counts is the mAP less the number of false positives per picture without objects.

    Args:
        training: What to score.
        validation: Pictures with objects and without.
        folder: Where the weights go.

    Returns:
        The score, the mAP and the false positives per picture without objects.
    """
    detector = training.snapshot()
    seen, empty = look_at(detector, {"": validation}), [one for one in validation if not len(one.labels)]
    figures = set_figures(seen.rows, with_right(seen.rows, seen.detections), len(validation), CONFIDENCE)
    imagined = look_at(detector, {"": empty})
    judged = with_right(imagined.rows, imagined.detections)
    rate = false_positives(judged, len(empty), CONFIDENCE)["per_picture"] if empty else 0.0
    measured = {name: figures.get(name, {}) for name in ("ap", "found")}
    record: dict[str, object] = {"validation": measured, "map": figures.get("map", 0.0), "false_positives": rate}
    if _merit(record) >= max((_merit(r) for r in training.history if "map" in r), default=-math.inf):
        notes = {"epoch": str(training.epoch), "seed": str(training.config.seed)}
        folder.mkdir(parents=True, exist_ok=True)
        export_weights(training.averaged, folder / "best.safetensors", notes=notes)
    return record


def _merit(record: Mapping[str, object]) -> float:
    return float(str(record["map"])) - float(str(record.get("false_positives", 0.0)))


class _OnStep(Protocol):
    def __call__(self, done: int, total: int, figures: object = None, /) -> None: ...


def _named(text: str, on_work: OnWork) -> _OnStep:
    """Tells `on_work` of the steps of what `text` names."""
    return lambda done, total, figures=None, /: on_work(text, done, total)
