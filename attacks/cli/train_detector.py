"""`mi-splat train-detector`: make the pictures, train a small detector, write weights and curves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from attacks.cli.training_options import TrainDetectorOptions
from attacks.detectors.training.loop import Training
from attacks.detectors.training.train import train, trainer_of, training_pictures
from mi_splat.cli.console import progress, show, warn
from mi_splat.io.folders import check_writable, own_folder
from mi_splat.io.locks import locked_folder

RECORDS = ("checkpoint.safetensors", "curves.json", "best.safetensors")
"""What a training leaves in its folder."""


def run(options: TrainDetectorOptions) -> int:
    """Train, continuing an earlier training with the same folders."""
    check_writable(options.data)
    with own_folder(options.out, *RECORDS):
        return _train(options)


def _train(options: TrainDetectorOptions) -> int:
    """As `run`, in a folder that is this process's own."""
    import torch

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
