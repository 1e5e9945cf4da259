"""The training of a small detector, a job of the ledger: from the first step to the exported weights."""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from attacks.detectors.evaluation import false_positives, look_at, set_figures, with_right
from attacks.detectors.training.config import TrainConfig
from attacks.detectors.training.loop import DetectorTrainer, Training, export_weights
from attacks.detectors.training.pictures import LabelledPicture
from attacks.detectors.training.scenes import load

if TYPE_CHECKING:
    from mi_splat.ledger import Out

VARIES = ("curves.json",)
TRAINERS = {
    "fasterrcnn_small": ("attacks.detectors.training.faster_rcnn", "FasterRCNNTrainer"),
    "yolov8n_small": ("attacks.detectors.training.yolo", "YOLOTrainer"),
}
"""Name of a detector to the module and the name of its trainer."""
WEIGHTS, CURVES = "best.safetensors", "curves.json"
"""What a training leaves."""
PICTURES, VALIDATION, START = "pictures", "validation", "start"
"""How the names of its inputs begin: pictures to train on, those to choose the best epoch by, weights to begin from."""
CONFIDENCE = 0.5
"""From which a detection counts in a validation."""

OnWork = Callable[[str, int, int], None]
"""Called with what is going on, the units of it that are done, and the number wanted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorTraining:
    """What is trained, and how.

    Attributes:
        detector: Key of `TRAINERS`.
        config: The training.
        validate_every: Epochs between two validations.
    """

    detector: str
    config: TrainConfig
    validate_every: int = 2


def run(config: DetectorTraining, inputs: Mapping[str, Path], out: Out) -> None:
    """Train, or go on with what an interrupted training left."""
    sets = {
        which: [picture for name in sorted(inputs) if name.startswith(which) for picture in load(inputs[name])]
        for which in (PICTURES, VALIDATION)
    }
    training = Training.resume(out.partial, config.config, trainer_of(config.detector))
    train(
        training,
        sets[PICTURES],
        sets[VALIDATION],
        out.partial,
        validate_every=config.validate_every,
        start=inputs.get(START),
        on_work=out.progress,
        on_epoch=lambda record: out.note(line_of(record)),
    )
    for name in (WEIGHTS, CURVES):
        shutil.copyfile(out.partial / name, out / name)


def trainer_of(name: str) -> DetectorTrainer:
    """The trainer of a small detector."""
    module, trainer = TRAINERS[name]
    made: DetectorTrainer = getattr(import_module(module), trainer)()
    return made


def train(
    training: Training,
    pictures: Sequence[LabelledPicture],
    validation: Sequence[LabelledPicture],
    folder: Path,
    *,
    validate_every: int = 2,
    start: Path | None = None,
    on_work: OnWork,
    on_epoch: Callable[[Mapping[str, Any]], None] = lambda record: None,
) -> None:
    """Do what is left of a training; write checkpoint, curves.json and the best weights so far after each epoch."""
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
            record |= validated(training, validation, folder)
        training.history.append(record)
        training.save(folder)
        curves = {"config": asdict(config), "history": training.history}
        (folder / CURVES).write_text(json.dumps(curves, indent=1))
        on_epoch(record)


def line_of(record: Mapping[str, Any]) -> str:
    """The figures of one epoch in a line."""
    if record["epoch"] == 0:
        named = record.get("named")
        return "begun" if named is None else f"pretraining: {named:.1%} of the cut-outs classified right"
    line = f"epoch {record['epoch']}: loss {sum(record['losses'].values()):.3f}, {record['seconds']:.0f} s"
    if "validation" in record:
        each = " ".join(f"{name} {ap:.2f}" for name, ap in record["validation"]["ap"].items())
        line += f", mAP {record['map']:.3f} ({each})"
        line += f", {record['false_positives']:.2f} false positives per empty picture"
    return line


def validated(training: Training, validation: Sequence[LabelledPicture], folder: Path) -> dict[str, object]:
    """Score the averaged weights, and export them if none were better.

    What counts is the mAP less the number of false positives per picture without objects.
    """
    detector = training.snapshot()
    seen, empty = look_at(detector, {"": validation}), [picture for picture in validation if not len(picture.labels)]
    figures = set_figures(seen.rows, with_right(seen.rows, seen.detections), len(validation), CONFIDENCE)
    imagined = look_at(detector, {"": empty})
    judged = with_right(imagined.rows, imagined.detections)
    rate = false_positives(judged, len(empty), CONFIDENCE)["per_picture"] if empty else 0.0
    measured = {name: figures.get(name, {}) for name in ("ap", "found")}
    record: dict[str, object] = {"validation": measured, "map": figures.get("map", 0.0), "false_positives": rate}
    if _merit(record) >= max((_merit(r) for r in training.history if "map" in r), default=-math.inf):
        notes = {"epoch": str(training.epoch), "seed": str(training.config.seed)}
        export_weights(training.averaged, folder / WEIGHTS, notes=notes)
    return record


def _merit(record: Mapping[str, object]) -> float:
    return float(str(record["map"])) - float(str(record.get("false_positives", 0.0)))


class _OnStep(Protocol):
    def __call__(self, done: int, total: int, figures: object = None, /) -> None: ...


def _named(text: str, on_work: OnWork) -> _OnStep:
    """Tells `on_work` of the steps of what `text` names."""
    return lambda done, total, figures=None, /: on_work(text, done, total)
