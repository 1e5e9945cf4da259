"""`mi-splat train-detector`: make the pictures, train a small detector, write weights and curves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from attacks.cli.options import Processes, Threads
from attacks.detectors.training.config import TrainConfig, TrainingSetConfig
from mi_splat.cli.console import progress, show, warn
from mi_splat.cli.flags import Flag
from mi_splat.fields import Folder, at_least
from mi_splat.io.locks import locked_folder

EXAMPLES = ("train-detector --detectors fasterrcnn_small --out out/detector",)
SEE_ALSO = ("evaluate-detector",)


RECORDS = ("checkpoint.safetensors", "curves.json", "best.safetensors")
"""What a training leaves in its folder."""
SmallDetector = Literal["fasterrcnn_small", "yolov8n_small"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainDetectorOptions:
    """Train a small detector from nothing, on path-traced pictures and splats that are made first.

    A training that was interrupted goes on where it stopped when the same command is given again.
    """

    detector: Annotated[SmallDetector, Flag(name="detectors")] = "fasterrcnn_small"
    """Which one; yolov8n_small needs the extra `yolo`."""
    data: Folder = Path("out/detector-data")
    """Folder of the pictures; what is missing in it is made first."""
    out: Folder = Path("out/detector")
    """Folder of checkpoint.safetensors, curves.json and best.safetensors, the best weights so far."""
    sets: TrainingSetConfig = field(default_factory=TrainingSetConfig)
    """How many pictures of each kind."""
    validate_every: Annotated[int, at_least(1, "epochs")] = 2
    """Epochs between two validations."""
    processes: Processes = 2
    """Processes that make pictures; 0 makes them in this one."""
    threads: Threads = 2
    """Threads that train."""
    only_data: bool = False
    """Stop when the pictures are made."""
    start: Path | None = None
    """Weights to begin from instead of pretraining."""
    config: TrainConfig = field(default_factory=TrainConfig)
    """The training itself."""


def run(options: TrainDetectorOptions) -> int:
    """Train, continuing an earlier training with the same folders."""
    from mi_splat.io.folders import check_writable, own_folder

    check_writable(options.data)
    with own_folder(options.out, *RECORDS):
        return _train(options)


def _train(options: TrainDetectorOptions) -> int:
    """As `run`, in a folder that is this process's own."""
    import torch

    from attacks.detectors.training.loop import Training
    from attacks.detectors.training.train import train, trainer_of, training_pictures

    torch.set_num_threads(options.threads)
    with progress("starting") as advance:

        def follow(text: str, done: int, total: int) -> None:
            advance(f"{text}, {done:,} of {total:,}")

        trainer = trainer_of(options.detector)
        with locked_folder(options.data):
            pictures, validation = training_pictures(
                options.data, options.sets, processes=options.processes, on_work=follow
            )
        if not options.only_data:
            train(
                Training.resume(options.out, options.config, trainer),
                pictures,
                validation,
                options.out,
                validate_every=options.validate_every,
                start=options.start,
                on_work=follow,
                on_epoch=lambda record: warn(line_of(record)),
            )
    show(f"{options.data}: {len(pictures):,} training pictures, {len(validation):,} for validation")
    if not options.only_data:
        show(f"{options.out}: best.safetensors, curves.json, checkpoint.safetensors")
    return 0


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
