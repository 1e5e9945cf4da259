"""`mi-splat train-detector`: make the pictures, train a small detector, write weights and curves."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from attacks.cli.options import Processes, Threads
from attacks.detectors.training.config import TrainConfig, TrainingSetConfig
from mi_splat.cli.console import follow, progress, show, warn
from mi_splat.cli.flags import Flag
from mi_splat.fields import Folder, at_least

if TYPE_CHECKING:
    from mi_splat.ledger import Event

EXAMPLES = ("train-detector --detectors fasterrcnn_small --out out/detector",)
SEE_ALSO = ("evaluate-detector",)

SmallDetector = Literal["fasterrcnn_small", "yolov8n_small"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainDetectorOptions:
    """Train a small detector from nothing, on path-traced pictures and splats that are made first.

    A training that was interrupted goes on where it stopped when the same command is given again.
    """

    detector: Annotated[SmallDetector, Flag(name="detectors")] = "fasterrcnn_small"
    """Which one; yolov8n_small needs the extra `yolo`."""
    data: Folder = Path("out/detector-data")
    """Folder of the pictures and of trainings; what is missing in it is made first."""
    out: Folder = Path("out/detector")
    """Folder for best.safetensors, the best weights, and curves.json; a new one."""
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
    force: bool = False
    """Replace a folder that an earlier call has written."""


def run(options: TrainDetectorOptions) -> int:
    """Make the pictures, and train or go on with an earlier training on them."""
    import torch

    from attacks.detectors.training.dataset import made, training_job, training_sets
    from attacks.detectors.training.train import CURVES, WEIGHTS
    from mi_splat.io.folders import check_new_folder, check_writable, new_folder
    from mi_splat.ledger import Ledger

    check_writable(options.data)
    check_new_folder(options.out, force=options.force, record=CURVES)
    torch.set_num_threads(options.threads)
    with progress("starting") as advance:
        tell = follow(advance)

        def told(event: Event) -> None:
            if event.state == "note":
                warn(event.text)
            elif event.state == "progress":
                tell(event.text, event.done, event.total)

        training, validation = training_sets(options.sets)
        sets = {"training": training, "validation": validation}
        pictures = made(options.data, sets, processes=options.processes, on_work=tell)
        if not options.only_data:
            job = training_job(
                options.detector, options.config, sets, start=options.start, validate_every=options.validate_every
            )
            done = Ledger(options.data, on_event=told).do(job)
            with new_folder(options.out, force=options.force, record=CURVES) as folder:
                for name in (WEIGHTS, CURVES):
                    shutil.copyfile(done.folder / name, folder / name)
    counts = (f"{len(pictures[name]):,}" for name in sets)
    show(f"{options.data}: {' training pictures, '.join(counts)} for validation")
    if not options.only_data:
        show(f"{options.out}: {WEIGHTS}, {CURVES}")
    return 0
