"""What the small detectors are trained on, and their training from the first picture to the exported weights."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Protocol

from attacks.detectors.classes import SMALL_CLASSES
from attacks.detectors.training.average_precision import evaluate
from attacks.detectors.training.config import PictureSetConfig, SplatConfig, TrainingSetConfig
from attacks.detectors.training.dataset import load, make
from attacks.detectors.training.loop import DetectorTrainer, Training, export_weights
from attacks.detectors.training.pictures import LabelledPicture
from attacks.detectors.training.splat_pictures import splat_set

OnWork = Callable[[str, int, int], None]
"""Called with what is going on, the units of it that are done, and the number wanted."""

TRAINING_SPLATS = SplatConfig(views=12, samples=6, objects=8000, surroundings=20_000, steps=80, pictures=8)
"""Splats of the training set, coarser than those of the evaluation."""


def trainer_of(name: str) -> DetectorTrainer:
    """The trainer of a small detector.

    Raises:
        DetectorError: It needs a package that is not there.
    """
    from attacks.detectors.training.faster_rcnn import FasterRCNNTrainer

    if name == FasterRCNNTrainer.name:
        return FasterRCNNTrainer()
    from attacks.detectors.training.yolo import YOLOTrainer

    return YOLOTrainer()


def training_pictures(
    folder: Path, sets: TrainingSetConfig, *, processes: int, on_work: OnWork
) -> tuple[list[LabelledPicture], list[LabelledPicture]]:
    """Pictures for training and for validation; what `folder` does not hold yet is made.

    Args:
        folder: Where the pictures are kept.
        sets: How many of each kind.
        processes: How many processes make pictures; 0 makes them in this one.
        on_work: Hears of the progress.

    Raises:
        InvalidValueError: The folder holds pictures that were made otherwise.
    """
    overhead_focus = ("car", "train", *SMALL_CLASSES)
    wanted = {
        "validation": PictureSetConfig(split="validation", count=sets.validation),
        "train": PictureSetConfig(split="train", count=sets.pictures),
        "surroundings": PictureSetConfig(split="train", seed=1, count=sets.surroundings, empty=0.4, street=1.0),
        "overhead": PictureSetConfig(
            split="train", seed=3, count=sets.overhead, elevation=(50, 90), focus=overhead_focus, street=0.7
        ),
    }
    found: dict[str, list[LabelledPicture]] = {}
    for name, config in wanted.items():
        if not config.count:
            found[name] = []
            continue
        make(config, folder / name, processes=processes, on_step=_named(f"{name} pictures", on_work))
        found[name] = load(folder / name, limit=config.count)
    splats = splat_set(
        PictureSetConfig(split="train", seed=2),
        range(sets.splats),
        folder / "train-splats",
        TRAINING_SPLATS,
        on_step=_named("splats", on_work),
    )
    validation = found.pop("validation")
    return [*(picture for some in found.values() for picture in some), *splats], validation


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
        DetectorError: The weights to start from are missing or do not fit.
    """
    config = training.config
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
            record |= _validated(training, validation, folder)
        training.history.append(record)
        training.save(folder)
        curves = {"config": asdict(config), "history": training.history}
        (folder / "curves.json").write_text(json.dumps(curves, indent=1))
        on_epoch(record)


def _validated(training: Training, validation: Sequence[LabelledPicture], folder: Path) -> dict[str, object]:
    """Score the averaged weights, and export them if none were better."""
    result = evaluate(training.snapshot(), validation)
    if result.mean >= max((float(str(r["map"])) for r in training.history if "map" in r), default=0.0):
        notes = {"epoch": str(training.epoch), "seed": str(training.config.seed)}
        folder.mkdir(parents=True, exist_ok=True)
        export_weights(training.averaged, folder / "best.safetensors", notes=notes)
    return {"validation": asdict(result), "map": result.mean}


class _OnStep(Protocol):
    def __call__(self, done: int, total: int, figures: object = None, /) -> None: ...


def _named(text: str, on_work: OnWork) -> _OnStep:
    """Tells `on_work` of the steps of what `text` names."""
    return lambda done, total, figures=None, /: on_work(text, done, total)
