"""`python -m attacks.detectors.training.train`: make the pictures, train a small detector, write weights and curves."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import torch
import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from attacks.detectors.small import CLASSES
from attacks.detectors.training.average_precision import Score, evaluate
from attacks.detectors.training.dataset import load, make
from attacks.detectors.training.faster_rcnn import RCNNTrainee
from attacks.detectors.training.loop import TrainConfig, Trainee, Training, export_weights
from attacks.detectors.training.pictures import PictureSetConfig, Sample
from attacks.detectors.training.splat_pictures import SplatConfig, splat_set


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """Train a small detector from nothing.

    Attributes:
        detector: Which one; yolov8n_small needs the extra `yolo`.
        data: Folder of the pictures; what is missing in it is made first.
        out: Folder of checkpoint, curves.json and the best weights so far.
        pictures: Number of training pictures.
        places: Number of further ones of the project's streets, parks and rooms, many of them without any object.
        overhead: Number of further ones from above, of cars and trains more than of others.
        splats: Number of further scenes that are made into splats, eight renders of each.
        validation: Number of pictures by which the best epoch is chosen.
        every: Epochs between two validations.
        processes: Processes that make pictures.
        threads: Threads that train.
        only_data: Stop when the pictures are made.
        start: Weights to begin from instead of pretraining.
        config: The training itself.
    """

    detector: Literal["fasterrcnn_small", "yolov8n_small"] = "fasterrcnn_small"
    data: Path = Path("out/detector-data")
    out: Path = Path("out/detector")
    pictures: int = 3600
    places: int = 720
    overhead: int = 720
    splats: int = 40
    validation: int = 120
    every: int = 2
    processes: int = 2
    threads: int = 2
    only_data: bool = False
    start: Path | None = None
    config: TrainConfig = field(default_factory=TrainConfig)


def main(run: Run) -> None:
    """Do the run, continuing an earlier one with the same folders."""
    torch.set_num_threads(run.threads)
    console = Console(stderr=True)
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total}"),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    ) as bars:
        validation = _pictures(PictureSetConfig(split="validation", count=run.validation), run, bars)
        train = _made(run, bars)
        if run.only_data:
            return
        training = Training.resume(run.out, run.config, _trainee(run.detector))
        while training.epoch < run.config.epochs:
            if not training.history and run.start is not None:
                training.begin_from(run.start)
            elif not training.history and run.config.pretraining:
                _pretrain(training, train, run, bars, console)
            _epoch(training, train, validation, run, bars, console)


def _trainee(name: str) -> Trainee:
    """What is trained."""
    if name == RCNNTrainee.name:
        return RCNNTrainee()
    from attacks.detectors.training.yolo import YOLOTrainee

    return YOLOTrainee()


def _made(run: Run, bars: Progress) -> list[Sample]:
    """All training pictures."""
    places = PictureSetConfig(split="train", seed=1, count=run.places, empty=0.4, street=1.0)
    above = PictureSetConfig(
        split="train", seed=3, count=run.overhead, elevation=(50, 90), focus=("car", "train", *CLASSES), street=0.7
    )
    bar = bars.add_task("splats", total=run.splats)
    config = SplatConfig(views=12, samples=6, objects=8000, surroundings=20_000, steps=80, pictures=8)
    return [
        *_pictures(PictureSetConfig(split="train", count=run.pictures), run, bars),
        *_pictures(places, run, bars, name="places"),
        *_pictures(above, run, bars, name="overhead"),
        *splat_set(
            PictureSetConfig(split="train", seed=2),
            range(run.splats),
            run.data / "train-splats",
            config,
            on_step=lambda done, _: bars.update(bar, completed=done),
        ),
    ]


def _pictures(recipe: PictureSetConfig, run: Run, bars: Progress, *, name: str = "") -> list[Sample]:
    name = name or recipe.split
    folder = run.data / name
    bar = bars.add_task(f"{name} pictures", total=recipe.count)
    make(recipe, folder, processes=run.processes, on_step=lambda done, _: bars.update(bar, completed=done))
    bars.update(bar, completed=recipe.count)
    return load(folder, limit=recipe.count)


def _pretrain(training: Training, train: list[Sample], run: Run, bars: Progress, console: Console) -> None:
    bar = bars.add_task("pretraining", total=run.config.pretraining)
    right = training.pretrain(train, on_step=lambda done, _, __: bars.update(bar, completed=done))
    training.save(run.out)
    if right is not None:
        console.print(f"pretraining: {right:.1%} of the cut-outs named right")


def _epoch(
    training: Training, train: list[Sample], validation: list[Sample], run: Run, bars: Progress, console: Console
) -> None:
    """One epoch, its validation, its checkpoint, and a line about it."""
    start = time.monotonic()
    bar = bars.add_task(f"epoch {training.epoch + 1} of {run.config.epochs}", total=len(train) // run.config.batch)
    losses = training.run_epoch(train, on_step=lambda done, _, __: bars.update(bar, completed=done))
    record: dict[str, object] = {
        "epoch": training.epoch,
        "pictures": len(train),
        "losses": losses,
        "seconds": time.monotonic() - start,
    }
    if training.epoch % run.every == 0 or training.epoch == run.config.epochs:
        result = evaluate(training.snapshot(), validation)
        record |= {"validation": asdict(result), "map": result.mean}
        if result.mean >= max((float(str(r["map"])) for r in training.history if "map" in r), default=0.0):
            notes = {"epoch": str(training.epoch), "seed": str(run.config.seed)}
            export_weights(training.averaged, run.out / "best.safetensors", notes=notes)
    training.history.append(record)
    training.save(run.out)
    curves = {"config": asdict(run.config), "history": training.history}
    (run.out / "curves.json").write_text(json.dumps(curves, indent=1))
    console.print(_line(record, result if "map" in record else None))


def _line(record: dict[str, object], result: Score | None) -> str:
    losses = record["losses"]
    total = sum(losses.values()) if isinstance(losses, dict) else 0.0
    line = f"epoch {record['epoch']}: loss {total:.3f}, {record['seconds']:.0f} s"
    if result is not None:
        each = " ".join(f"{name} {ap:.2f}" for name, ap in result.ap.items())
        line += f", mAP {result.mean:.3f} ({each})"
    return line


if __name__ == "__main__":
    main(tyro.cli(Run))
