"""One attack of a study of distributions of views as a value, and what runs it."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from attacks.dagger.attack import attack_views
from attacks.dagger.checkpoint import Checkpoint
from attacks.dagger.config import EotConfig
from attacks.dagger.jobs import AttackScene
from attacks.dagger.pairs import SEARCHES
from attacks.dagger.report import summary, write_files
from attacks.dagger.result import Result
from attacks.dagger.views import ViewDistribution
from attacks.detectors.base import Detector
from attacks.limits import SearchName
from attacks.objectives import Objective, hide, relabel
from attacks.pgd import Step
from attacks.transformations.config import Transformations
from mi_splat.errors import InvalidValueError, message


@dataclass(frozen=True, slots=True, kw_only=True)
class EotJob:
    """One attack of a study.

    Attributes:
        group: Table that it belongs to.
        scene: Name of the scene file without its suffix.
        object: Id of the object.
        target: Class wanted; None hides the object.
        detectors: Names of the detectors that are attacked at once.
        confidence: What counts as success; None is the objective's own.
        config: How to attack.
        transformations: Views that it is made for.
        judged: Views that judge it, where these are others.
        search: Key of `attacks.dagger.pairs.SEARCHES`, for the objective: what a relabelling pushes.
    """

    group: str
    scene: str
    object: str
    target: str | None
    detectors: tuple[str, ...]
    confidence: float | None = None
    config: EotConfig = field(default_factory=EotConfig)
    transformations: Transformations = field(default_factory=Transformations)
    judged: Transformations | None = None
    search: SearchName = "paper"

    @property
    def name(self) -> str:
        """File name, unique within a study: what is said of the attack, and a hash of all of it."""
        config = self.config
        words = (
            *(self.group, self.object, self.target or "hide", *self.detectors, *config.attributes, config.norm),
            *(f"{eps:.4g}" for eps in config.eps),
            f"seed{config.seed}",
            hashlib.sha256(repr(self).encode()).hexdigest()[:8],
        )
        return "-".join(word.replace(" ", "_") for word in words)


class EotJobRunner:
    """Runs jobs on scenes and detectors that are found by name, each read once; views are shared among the jobs.

    Args:
        read: Reads a scene.
        load: Loads a detector.
        keep: Folder for the pictures and splats of every job, and for the search while it runs; None keeps none.
        on_step: Called with every line of every trace as it happens.
    """

    def __init__(
        self,
        read: Callable[[str], AttackScene],
        load: Callable[[str], Detector],
        *,
        keep: Path | None = None,
        on_step: Callable[[Step], None] | None = None,
    ) -> None:
        self._read, self._load, self._keep, self._on_step = read, load, keep, on_step
        self._scenes: dict[str, AttackScene] = {}
        self._detectors: dict[str, Detector] = {}
        self._views: dict[tuple[str, str, Transformations], ViewDistribution] = {}

    def fingerprint(self, job: EotJob) -> str:
        """Hash of what a result depends on besides the job: the scene, see `AttackScene.digest`, and the detectors."""
        words = [self._scene(job).digest()]
        words += [f"{detector.name} {detector.fingerprint}" for detector in self._of(job)]
        return hashlib.sha256("\n".join(words).encode()).hexdigest()

    def run(self, job: EotJob) -> dict[str, Any]:
        """Attack, and return the summary."""
        limit = {} if job.confidence is None else {"confidence": job.confidence}
        objective: Objective = hide(**limit)
        if job.target is not None:
            objective = dataclasses.replace(relabel(job.target, **limit), **SEARCHES[job.search].objective)
        views = self._distribution(job, job.transformations)
        judged = None if job.judged is None else self._distribution(job, job.judged)
        checkpoint = None
        if self._keep is not None:
            self._keep.mkdir(parents=True, exist_ok=True)
            checkpoint = Checkpoint(path=self._keep / f"{job.name}.checkpoint")
        result = attack_views(
            views,
            self._of(job),
            objective,
            config=job.config,
            judged=judged,
            checkpoint=checkpoint,
            on_step=self._on_step,
        )
        if self._keep is not None:
            self._write(result, self._keep / job.name)
        return summary(result)

    def _write(self, result: Result, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        write_files(result, folder)

    def _of(self, job: EotJob) -> tuple[Detector, ...]:
        for name in job.detectors:
            if name not in self._detectors:
                self._detectors[name] = self._load(name)
        return tuple(self._detectors[name] for name in job.detectors)

    def _distribution(self, job: EotJob, transformations: Transformations) -> ViewDistribution:
        key = (job.scene, job.object, transformations)
        if key not in self._views:
            place = self._scene(job)
            self._views[key] = ViewDistribution(
                place.scene, _rows(place.objects, job), place.cameras[0], transformations, render=place.render
            )
        return self._views[key]

    def _scene(self, job: EotJob) -> AttackScene:
        if job.scene not in self._scenes:
            self._scenes[job.scene] = self._read(job.scene)
        return self._scenes[job.scene]


def _rows(objects: Mapping[str, slice], job: EotJob) -> slice:
    if job.object not in objects:
        expected = f"one of {', '.join(objects)}"
        raise InvalidValueError(message(f"object of {job.scene}", expected, job.object, "fix the scene file"))
    return objects[job.object]
