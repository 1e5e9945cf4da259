"""A whole study: what is checked before it starts, what it will take, and what it leaves behind."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from attacks.cloak.poisoning import assign
from attacks.cloak.study import setup
from attacks.cloak.study.config import StudyConfig
from attacks.cloak.study.dependencies import fit_config
from attacks.cloak.study.figure_files import need_matplotlib
from attacks.cloak.study.observations import observe
from attacks.cloak.study.pipeline import OnStep, StudyPipeline
from attacks.cloak.study.report import STUDY, begin_report, write_report
from attacks.cloak.study.snapshots import differences
from attacks.cloak.study.value_checks import one_of
from attacks.detectors.base import Detector
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.atomic import is_temporary
from mi_splat.io.folders import check_writable
from mi_splat.io.locks import check_unlocked, locked_folder

# Measured on two cores with little else to do; only for the forecast.
_PATH, _STEP, _PIXEL, _GAUSSIAN = 0.6e-6, 8e-3, 2.5e-7, 4e-7  # seconds
_PNG, _ROW = 2.5, 1200  # bytes a pixel, and a Gaussian in a splat and its checkpoint


@dataclass(frozen=True, slots=True, kw_only=True)
class Forecast:
    """What a study will take where none of its stages is there yet.

    Attributes:
        pictures: To be path traced.
        trainings: Number of splats.
        minutes: On two cores.
        megabytes: On the disk.
    """

    pictures: int
    trainings: int
    minutes: float
    megabytes: float

    def __str__(self) -> str:
        return (
            f"{self.pictures} pictures to render and {self.trainings} splats to train: about {self.minutes:.0f} "
            f"minutes on two cores and {self.megabytes:.0f} MB of disk, less what is there already"
        )


def forecast(study: StudyConfig) -> Forecast:
    """What a study will take."""
    cameras, training, evaluation = study.cameras, study.training, study.evaluation
    target = setup.target_of(study.scene)
    taken = setup.training_cameras(study, target)
    centre = setup.centre_of(study)
    poisoned = sum(
        int(setup.poisoned_cameras(study, attack, 0).holds(taken, centre=centre).sum()) for attack in study.attack
    )
    sets = len(study.seeds) if any(attack.poison_fraction < 1 for attack in study.attack) else 1
    arcs = sum(map(len, setup.arcs(study, target)))
    pictures = cameras.train + sets * poisoned + evaluation.reference_views + 2 * arcs
    trainings = 2 * len(study.seeds)
    step = _STEP + cameras.size**2 * _PIXEL + training.max_gaussians * _GAUSSIAN
    steps, surrogate = trainings * training.iterations, study.surrogate
    if surrogate is not None:
        trainings, steps = trainings + surrogate.rounds, steps + surrogate.rounds * surrogate.iterations
    seconds = pictures * cameras.size**2 * cameras.samples * _PATH + steps * step
    size = (pictures + sets * cameras.train) * cameras.size**2 * _PNG + trainings * training.max_gaussians * _ROW
    return Forecast(pictures=pictures, trainings=trainings, minutes=1 + seconds / 60, megabytes=size / 1e6)


def check(study: StudyConfig, detectors: Sequence[Detector], folder: Path, stages: Path) -> None:
    """Refuse what cannot be done, before anything is written.

    Args:
        study: The study.
        detectors: Those that it names.
        folder: For the results.
        stages: For the stages.

    Raises:
        InvalidValueError: A trigger has no training camera or two have one in common, a detector does not know a
            class, the trainer's settings are out of range, layers have a margin of poison, matplotlib is not
            installed, the folder is in use, or the disk is too small.
    """
    mesh_scene = setup.mesh_scene_of(study)
    cameras = setup.training_cameras(study, mesh_scene.target)
    for seed in study.seeds:
        assign(cameras, setup.poisonings(study, mesh_scene, seed=seed), centre=setup.centre_of(study))
    setup.held_out_cameras(study, mesh_scene.target)
    fit_config(study.training)
    _check_count(study)
    _check_margins(study)
    need_matplotlib()
    wanted = [
        study.scene.class_name,
        *(attack.target_class for attack in study.attack if attack.target_class is not None),
    ]
    for label, detector in itertools.product(wanted, detectors):
        one_of(f"class for {detector.name}", label, detector.classes)
    check_folder(study, folder)
    check_disk(forecast(study).megabytes, stages)


def _check_count(study: StudyConfig) -> None:
    """Raise if trainings would begin with more Gaussians than they may have."""
    points, most = study.cameras.points + study.training.outliers, study.training.max_gaussians
    if fit_config(study.training).strategy.adds_gaussians and points > most:
        expected = f"at least {points:,}, for cameras.points and training.outliers"
        raise InvalidValueError(message("training.max_gaussians", expected, f"{most:,}", "raise it, or ask for fewer"))


def _check_margins(study: StudyConfig) -> None:
    """Raise if a study of layers has a margin of poison, from whose cameras its file is to show the benign look."""
    wide = [attack for attack in study.attack if attack.poison_margin > 0]
    if wide and study.layers is not None:
        expected, do = "0 in a study of layers", "move the edge by `shift` under [layers] making"
        raise InvalidValueError(message(f"attack {wide[0].name!r}, poison_margin", expected, wide[0].poison_margin, do))


def check_folder(study: StudyConfig, folder: Path) -> None:
    """Raise unless a folder is new, empty, or this study's.

    Raises:
        InvalidValueError: It is not.
        SplatFileError: It is a file, cannot be written, or another process has it.
    """
    check_writable(folder)
    check_unlocked(folder)
    if folder.is_dir() and not all(is_temporary(path.name) for path in folder.iterdir()):
        known = folder / STUDY
        if not known.is_file():
            raise InvalidValueError(message(str(folder), "an empty folder", "other files", "choose another")).hinted(
                "--out"
            )
        differs = differences(known, study)
        if differs:
            do = "choose another folder; stages that both need are not done again with the same folder of stages"
            expected = f"results of a study with {', '.join(differs)}"
            raise InvalidValueError(message(str(folder), expected, "another", do)).hinted("--out, --stages")


def check_disk(megabytes: float, stages: Path) -> None:
    """Raise unless the disk has room.

    Raises:
        InvalidValueError: It has not.
    """
    there = next(path for path in (stages.absolute(), *stages.absolute().parents) if path.is_dir())
    free = shutil.disk_usage(there).free / 1e6
    if free < megabytes:
        raise InvalidValueError(message(f"disk of {there}", f"{megabytes:.0f} MB", f"{free:.0f} MB free", "make room"))


def run_study(
    study: StudyConfig,
    detectors: Sequence[Detector],
    folder: Path,
    *,
    stages: Path | None = None,
    on_step: OnStep = lambda text, done, total: None,
) -> dict[str, Any]:
    """Do a study, or what is missing of it, and write its results; returns the summary.

    Args:
        study: What to do.
        detectors: Those that it names, in its order.
        folder: For the results; see `attacks.cloak.study.report.write_report`.
        stages: For the stages, which other studies may share; None is a folder in `folder`.
        on_step: Told of the progress.

    Raises:
        MiSplatError: As `check`, or a stage cannot be done.
    """
    stages = folder / "stages" if stages is None else stages
    check(study, detectors, folder, stages)
    with locked_folder(folder):
        begin_report(study, folder)
        pipeline = StudyPipeline(study=study, folder=stages, on_step=on_step)

        clean = pipeline.capture()
        poisoned = pipeline.poison(clean)
        splats = pipeline.train(clean, poisoned)
        observed = observe(pipeline, splats, detectors)
        return write_report(pipeline, poisoned, observed, detectors, folder)
