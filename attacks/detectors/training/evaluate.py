"""Mean average precision of a small detector on held-out objects, path traced and as splats."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import torch
import tyro
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from attacks.detectors import load_detector
from attacks.detectors.training.average_precision import Score, evaluate
from attacks.detectors.training.dataset import load, make
from attacks.detectors.training.pictures import PictureSetConfig, Sample
from attacks.detectors.training.splat_pictures import SplatConfig, splat_set

_LEAST = 0.001
"""Confidence of detections that count in an average precision; YOLO drops more unless told otherwise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """Score a small detector on objects, cameras, lights and places that it was not trained on.

    Attributes:
        detector: Its name.
        weights: Weights to score; None: the shipped ones.
        data: Folder of the pictures; what is missing in it is made first.
        out: JSON file for the figures.
        pictures: Number of path-traced pictures.
        samples: Samples per pixel in them.
        scenes: Number of scenes that are made into splats; 0 leaves them out.
        splat: How splats are made.
        processes: Processes that make pictures.
        threads: Threads of torch.
    """

    detector: Literal["fasterrcnn_small", "yolov8n_small"] = "fasterrcnn_small"
    weights: Path | None = None
    data: Path = Path("out/detector-data")
    out: Path = Path("out/detector/held-out.json")
    pictures: int = 240
    samples: int = 24
    scenes: int = 32
    splat: SplatConfig = field(default_factory=SplatConfig)
    processes: int = 2
    threads: int = 1


def main(run: Evaluation) -> None:
    """Make what is missing, score both sets, print a table and write the figures."""
    torch.set_num_threads(run.threads)
    console = Console(stderr=True)
    detector = load_detector(run.detector, weights=run.weights)
    if hasattr(detector, "least"):
        detector.least = _LEAST
    recipe = PictureSetConfig(split="held-out", count=run.pictures, samples=run.samples)
    sets = {"path traced": _photographs(recipe, run, console)}
    if run.scenes:
        sets["splat renders"] = _renders(recipe, run, console)
    scores = {name: evaluate(detector, samples) for name, samples in sets.items()}
    run.out.parent.mkdir(parents=True, exist_ok=True)
    figures = {
        name: {**asdict(result), "map": result.mean, "pictures": len(sets[name])} for name, result in scores.items()
    }
    run.out.write_text(json.dumps(figures, indent=1) + "\n")
    Console().print(_table(scores))


def _photographs(recipe: PictureSetConfig, run: Evaluation, console: Console) -> list[Sample]:
    folder = run.data / recipe.split
    with Progress(console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task("path-traced pictures", total=recipe.count)
        make(recipe, folder, processes=run.processes, on_step=lambda done, _: bars.update(bar, completed=done))
    return load(folder, limit=recipe.count)


def _renders(recipe: PictureSetConfig, run: Evaluation, console: Console) -> list[Sample]:
    numbers = range(10_000, 10_000 + run.scenes)  # none of the path-traced scenes
    with Progress(console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task("splats", total=run.scenes)
        return splat_set(
            recipe, numbers, run.data / "splats", run.splat, on_step=lambda done, _: bars.update(bar, completed=done)
        )


def _table(scores: dict[str, Score]) -> Table:
    table = Table("AP at IoU 0.5", *scores)
    for name in next(iter(scores.values())).ap:
        table.add_row(
            name, *(f"{s.ap[name]:.3f} of {s.counts[name]}" if name in s.ap else "-" for s in scores.values())
        )
    table.add_row("mean", *(f"{s.mean:.3f}" for s in scores.values()))
    return table


if __name__ == "__main__":
    main(tyro.cli(Evaluation))
