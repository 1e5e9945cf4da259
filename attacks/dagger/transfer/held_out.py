"""Splats that were attacked over a distribution of views, judged by other detectors on the held-out views of it.

The splats are those that `mi-splat dagger-eot-study` keeps. Held-out views are a function of a seed, so every detector
looks at those that the study has judged by.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Generator

from attacks.budgets import Budget
from attacks.dagger.jobs import AttackScene
from attacks.dagger.study import JOBS, run_jobs
from attacks.dagger.transfer.scenes import AttackScenes
from attacks.dagger.views import View, ViewDistribution
from attacks.detectors.base import Detector
from attacks.gaussian_subset import GaussianSubset
from attacks.limits import NormName
from attacks.observe.look import report_cells
from attacks.observe.rows import Cell
from attacks.observe.views import detect_views
from attacks.transformations.config import CameraRegion, PictureChanges, Transformations
from attacks.transformations.draws import changing
from mi_splat.attributes import Attribute
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import load_splat
from mi_splat.io.parsing import read_json
from mi_splat.scene import GaussianScene

HELD_OUT = "held_out"
"""Folder of the ledger."""

_ANY = 1e9
"""A radius that binds nothing: noise has the size of the attack."""

RESULTS = "results"
"""Folder in a study over distributions of views that has its splats."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutJob:
    """One detector that looks at one splat.

    Attributes:
        attack: Name of the attack in its study.
        sources: Detectors attacked.
        weights: Fingerprints of the weights that they had.
        scene: Name of the scene file without its suffix.
        object: Id of the object; with spaces for its underscores it is the object's class.
        target: Class wanted.
        attributes: What the attack could change.
        norm: Norm of its balls.
        sh_degree: Highest degree of the SH coefficients that it could change; None is the splat's.
        transformations: The views.
        seed: Of the held-out views.
        views: Their number.
        splat: SHA-256 of the attacked splat's file.
        detector: The one that looks.
    """

    attack: str
    sources: tuple[str, ...]
    weights: tuple[str, ...]
    scene: str
    object: str
    target: str
    attributes: tuple[Attribute, ...]
    norm: NormName
    sh_degree: int | None
    transformations: Transformations
    seed: int
    views: int
    splat: str
    detector: str

    @property
    def name(self) -> str:
        """File name, unique within a study."""
        return f"{self.attack}-by-{self.detector}"


def held_out_jobs(study: Path, detectors: Sequence[str], *, views: int) -> list[HeldOutJob]:
    """Every detector on every splat of a study's pairs.

    Args:
        study: Folder of `mi-splat dagger-eot-study`.
        detectors: Names.
        views: Held-out views that each looks at, at most as many as the study's.

    Raises:
        InvalidValueError: There is no splat of pairs in the folder.
    """
    found = []
    for path in sorted((study / JOBS).glob("pairs-*.json")):
        splat, record = study / RESULTS / path.stem / "attacked.ply", read_json(path)
        try:
            found += _jobs_of(record, path.stem, splat, detectors, views)
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            do = "run mi-splat dagger-eot-study again"
            raise InvalidValueError(message(str(path), "the record of an attack", repr(error)[:120], do)) from error
    if not found:
        do = "run mi-splat dagger-eot-study --groups pairs first"
        raise InvalidValueError(message(str(study), f"attacks in {JOBS}/ with splats in {RESULTS}/", "none", do))
    return found


def _jobs_of(
    record: Mapping[str, Any], name: str, splat: Path, detectors: Sequence[str], views: int
) -> list[HeldOutJob]:
    """Every detector on the splat of one record; none if it has no target or no splat."""
    job = record["job"]
    marks = {entry["detector"]: entry["detector_fingerprint"] for entry in record["result"]["detectors"]}
    if job["target"] is None or not splat.is_file():
        return []
    config, where = job["config"], job["transformations"]
    return [
        HeldOutJob(
            attack=name,
            sources=tuple(job["detectors"]),
            weights=tuple(marks[one] for one in job["detectors"]),
            scene=job["scene"],
            object=job["object"],
            target=job["target"],
            attributes=tuple(config["attributes"]),
            norm=config["norm"],
            sh_degree=config["sh_degree"],
            transformations=Transformations(
                cameras=CameraRegion(**where["cameras"]), pictures=PictureChanges(**where["pictures"])
            ),
            seed=config["judge_seed"],
            views=min(views, config["held_out"]),
            splat=hashlib.sha256(splat.read_bytes()).hexdigest(),
            detector=detector,
        )
        for detector in detectors
    ]


class HeldOutRunner:
    """Runs the jobs; scenes are read, detectors loaded and views drawn once.

    Args:
        read: Finds a scene by its name.
        load: Loads a detector by its name.
        study: Folder of the study.
    """

    def __init__(self, read: Callable[[str], AttackScene], load: Callable[[str], Detector], study: Path) -> None:
        self._scenes, self._load, self._study = AttackScenes(read), load, study
        self._detectors: dict[str, Detector] = {}
        self._views: dict[tuple[str, str, Transformations], ViewDistribution] = {}
        self._clean: dict[tuple[Any, ...], list[dict[str, Cell]]] = {}

    def fingerprint(self, job: HeldOutJob) -> str:
        """Hash of the scene, its cameras and the weights of the detector that looks."""
        return self._scenes.fingerprint(job.scene, job.object, self._detector(job.detector))

    def run(self, job: HeldOutJob) -> dict[str, Any]:
        """What the detector reports in each view, as `TransferRunner.judge` says it of one."""
        place = self._scenes.of(job.scene, job.object)
        key = (job.scene, job.object, job.transformations)
        if key not in self._views:
            self._views[key] = ViewDistribution(
                place.scene, place.objects[job.object], place.cameras[0], job.transformations, render=place.render
            )
        views = self._views[key].views(job.seed, job.views)
        attacked = load_splat(self._study / RESULTS / job.attack / "attacked.ply")
        shared = (*key, job.seed, job.views, job.detector, job.target)
        if shared not in self._clean:
            self._clean[shared] = self._seen(place.scene, views, job)
        seen = {
            "clean": self._clean[shared],
            "attacked": self._seen(attacked, views, job),
            "noise": self._seen(_noisy(place, attacked, job), views, job),
        }
        return {"views": [{kind: rows[place] for kind, rows in seen.items()} for place in range(len(views))]}

    def sources(self, job: HeldOutJob, judges: Collection[str]) -> list[str]:
        """Names of the detectors attacked; with the weights of then if it judges with others by now."""
        names = zip(job.sources, job.weights, strict=True)
        return [
            f"{name}, weights {mark[:6]}" if name in judges and self._detector(name).fingerprint != mark else name
            for name, mark in names
        ]

    def weights(self, names: Iterable[str]) -> dict[str, str]:
        """Fingerprint of the weights of each detector that looks."""
        return {name: self._detector(name).fingerprint for name in names}

    def _seen(self, scene: GaussianScene, views: Sequence[View], job: HeldOutJob) -> list[dict[str, Cell]]:
        render = self._scenes.of(job.scene, job.object).render
        found = detect_views(
            scene,
            [view.camera for view in views],
            [self._detector(job.detector)],
            render=changing(render, {view.camera: view.change for view in views}),
            boxes=[view.box for view in views],
        )
        original = job.object.replace("_", " ")
        return [report_cells(one.detections, one.box, original=original, target=job.target) for one in found]

    def _detector(self, name: str) -> Detector:
        if name not in self._detectors:
            self._detectors[name] = self._load(name)
        return self._detectors[name]


def _noisy(place: AttackScene, attacked: GaussianScene, job: HeldOutJob) -> GaussianScene:
    """The clean scene with random noise as large as the attack, on what the attack could change."""
    degree = max(attacked.degree, place.scene.degree)
    rows = place.objects[job.object]
    clean = GaussianSubset.of(place.scene.with_degree(degree), rows)
    reference, moved = clean.parameters(job.attributes), GaussianSubset.of(attacked, rows).parameters(job.attributes)
    budget = Budget(radius=dict.fromkeys(job.attributes, _ANY), norm=job.norm)
    some = slice(None if job.sh_degree is None else (job.sh_degree + 1) ** 2)
    after, before = ({name: _part(name, value, some) for name, value in one.items()} for one in (moved, reference))
    drawn = budget.noise(after, before, Generator().manual_seed(job.seed + 1))
    for name, value in reference.items():
        reference[name] = value.clone()
        _part(name, reference[name], some)[...] = drawn[name]
    return clean.applied(reference)


def _part(name: str, value: Any, some: slice) -> Any:
    return value[:, some] if name == "sh" else value


def run_held_out(
    jobs: Sequence[HeldOutJob], out: Path, runner: HeldOutRunner, *, on_job: Callable[[str], None] | None = None
) -> list[dict[str, Any]]:
    """Let every detector look at what it has not looked at yet.

    Args:
        jobs: All of them.
        out: Folder of the ledger's folder.
        runner: Runs them.
        on_job: Called with the name of every job that is done.

    Returns:
        A record for each view, as `cells` wants it: `job` with `sources`, and `judged` by the one detector.
    """
    heard: Callable[[HeldOutJob], None] | None = None if on_job is None else (lambda job: on_job(job.name))
    found = run_jobs(jobs, out, runner.run, fingerprint=runner.fingerprint, on_job=heard, ledger=HELD_OUT)
    judges = {job.detector for job in jobs}
    return [
        {"job": {"sources": runner.sources(job, judges)}, "judged": {job.detector: view}}
        for job, record in zip(jobs, found, strict=True)
        for view in record["result"]["views"]
    ]
