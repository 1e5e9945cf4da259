"""Sets of labelled pictures, and a training on them, as jobs of the ledger: each is done once, and found again."""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from attacks.detectors.catalogue import SMALL_CLASSES, DetectorError
from attacks.detectors.training.config import (
    BACKGROUNDS,
    EMPTY,
    PATH_TRACED,
    SPLAT_RENDERS,
    BackgroundConfig,
    PictureSetConfig,
    SplatConfig,
    TrainConfig,
    TrainingSetConfig,
)
from attacks.detectors.training.pictures import LabelledPicture
from attacks.detectors.training.scenes import SceneConfig, load
from attacks.detectors.training.train import PICTURES, START, VALIDATION, DetectorTraining, OnWork
from mi_splat.ledger import Event, Job, Part
from mi_splat.ledger.engines import InProcess, Processes
from mi_splat.ledger.plans import Driver, grid

TRAINING_SPLATS = SplatConfig(views=12, samples=6, objects=8000, surroundings=20_000, steps=80, pictures=8)
"""Splats of the training set, coarser than those of the evaluation."""
IN_STREETS = PictureSetConfig(split="train", seed=4, around="street", farthest=9.0)
"""Objects in streets; from farther away most cameras would look at the houses."""
_FIRST_SPLAT = 10_000
"""Number of the first scene that is made into a splat to be held out: none of the path-traced scenes."""


def with_objects(scenes: PictureSetConfig) -> list[Job]:
    """Path-traced pictures: as many as are asked for, and those that are left of the last scene."""
    return _jobs(SceneConfig(scenes=replace(scenes, count=1), number=0), range(math.ceil(scenes.count / scenes.shots)))


def of_splats(scenes: PictureSetConfig, numbers: Iterable[int], splat: SplatConfig) -> list[Job]:
    """Renders of splats of some scenes."""
    return _jobs(SceneConfig(scenes=replace(scenes, count=1), number=0, splat=splat), numbers)


def without_objects(config: BackgroundConfig, kind: str) -> list[Job]:
    """Pictures of one kind of background."""
    return _jobs(SceneConfig(scenes=replace(config, scenes=1), number=0, kind=kind), range(config.scenes))


def _jobs(scene: SceneConfig, numbers: Iterable[int]) -> list[Job]:
    kind = "attacks.detectors.training.scenes"
    return [Job(kind=kind, config=replace(scene, number=number)) for number in numbers]


def training_sets(counts: TrainingSetConfig) -> tuple[list[Job], list[Job]]:
    """Pictures to train on, in their order, and those by which the best epoch is chosen."""
    train, empty = PictureSetConfig(split="train"), BackgroundConfig(split="train", samples=6, shots=6)
    overhead_focus = ("car", "train", *SMALL_CLASSES)
    overhead = replace(train, seed=3, elevation=(50, 90), focus=overhead_focus, street=0.7)
    more, finer = replace(empty, scenes=2 * counts.backgrounds, seed=1), replace(empty, samples=16, shots=3, seed=2)
    pictures = [
        *with_objects(replace(train, count=counts.pictures)),
        *with_objects(replace(train, seed=1, count=counts.surroundings, empty=0.4, street=1.0)),
        *with_objects(replace(overhead, count=counts.overhead)),
        *with_objects(replace(IN_STREETS, count=counts.streets)),
        *of_splats(replace(train, seed=2), range(counts.splats), TRAINING_SPLATS),
        *of_splats(replace(IN_STREETS, seed=5), range(counts.street_splats), TRAINING_SPLATS),
        *_all_kinds(replace(empty, scenes=counts.backgrounds)),
        *without_objects(more, "street"),
        *without_objects(replace(finer, scenes=counts.backgrounds), "street"),
    ]
    validation = with_objects(PictureSetConfig(split="validation", count=counts.validation))
    without = BackgroundConfig(split="validation", scenes=counts.validation_backgrounds, samples=6)
    return pictures, [*validation, *_all_kinds(without)]


def _all_kinds(config: BackgroundConfig) -> list[Job]:
    return [job for kind in BACKGROUNDS for job in without_objects(config, kind)]


def held_out_sets(
    scenes: PictureSetConfig, *, splats: int, splat: SplatConfig, backgrounds: BackgroundConfig
) -> dict[str, list[Job]]:
    """Held-out pictures by set, empty ones left out: path traced, renders of splats, and each kind of background."""
    sets = {
        PATH_TRACED: with_objects(scenes),
        SPLAT_RENDERS: of_splats(scenes, range(_FIRST_SPLAT, _FIRST_SPLAT + splats), splat),
        **{f"{EMPTY}{kind}": without_objects(backgrounds, kind) for kind in BACKGROUNDS},
    }
    return {name: jobs for name, jobs in sets.items() if jobs}


def made(
    folder: Path, sets: Mapping[str, Sequence[Job]], *, processes: int, on_work: OnWork
) -> dict[str, list[LabelledPicture]]:
    """The pictures of some sets; what is missing of them is made."""
    jobs = {f"{name} {number}": job for name, part in sets.items() for number, job in enumerate(part)}
    ended = itertools.count(1)

    def told(event: Event) -> None:
        if event.state in ("done", "kept"):
            on_work("scenes", next(ended), len(jobs))

    engine = Processes(folder, workers=processes, on_event=told) if processes else InProcess(folder, on_event=told)
    results = Driver(folder, engine, on_event=told).run([grid(jobs)])
    pictures: dict[str, list[LabelledPicture]] = {name: [] for name in sets}
    for name, part in sets.items():
        for number in range(len(part)):
            done = results[f"{name} {number}"]
            if isinstance(done, str):
                reason = done.strip().splitlines()[-1]
                raise DetectorError.of(f"scene {number} of {name}", "its pictures", reason, "try again")
            pictures[name] += load(done.folder)
    return pictures


def training_job(
    detector: str,
    config: TrainConfig,
    sets: Mapping[str, Sequence[Job]],
    *,
    start: Path | None = None,
    validate_every: int = 2,
) -> Job:
    """The training of a small detector."""
    inputs: dict[str, Job | Part | Path] = {} if start is None else {START: start}
    for prefix, name in ((PICTURES, "training"), (VALIDATION, "validation")):
        inputs |= {f"{prefix} {number:06d}": job for number, job in enumerate(sets[name])}
    training = DetectorTraining(detector=detector, config=config, validate_every=validate_every)
    return Job(kind="attacks.detectors.training.train", config=training, inputs=inputs)
