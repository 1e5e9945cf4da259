"""Attacks whose splats other detectors judge: what is attacked, what is judged, and the runner of both.

An attack leaves the object's Gaussians as a PLY, so that a detector that comes later judges what is there already.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from attacks.dagger.config import DaggerConfig
from attacks.dagger.jobs import AttackScene
from attacks.dagger.study import PAIRS
from attacks.dagger.transfer.attacked_objects import AttackedObjects
from attacks.detectors.base import Detector
from attacks.objectives import relabel

SUCCESS = 0.5
"""Confidence from which a class counts as reported, for every detector alike."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceJob:
    """One attack.

    Attributes:
        sources: Detectors attacked, all at once.
        scene: Name of the scene file without its suffix.
        object: Id of the object; with spaces for its underscores it is the object's class.
        target: Class wanted.
        config: How to attack. Its seed also moves the camera, see `jittered`.
    """

    sources: tuple[str, ...]
    scene: str
    object: str
    target: str
    config: DaggerConfig = field(default_factory=DaggerConfig)

    @property
    def name(self) -> str:
        """File name, unique within a study."""
        eps = "-".join(f"{eps:g}" for eps in self.config.eps)
        words = ("+".join(self.sources), self.object, self.target, self.config.norm, eps, str(self.config.seed))
        return "-".join(word.replace(" ", "_") for word in words)

    @property
    def original(self) -> str:
        """The object's class."""
        return self.object.replace("_", " ")

    @property
    def camera(self) -> int:
        """Position of the camera in the order of the scene file."""
        return 0


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgeJob:
    """One detector that looks at one attacked splat.

    Attributes:
        source: The attack.
        detector: The one that looks.
    """

    source: SourceJob
    detector: str

    @property
    def name(self) -> str:
        """File name, unique within a study."""
        return f"{self.source.name}-by-{self.detector}"


def transfer_jobs(
    detectors: Sequence[str], *, seeds: int, eps: float, steps: int, ensembles: bool = True
) -> list[SourceJob]:
    """The paper's six pairs by every detector, and by all detectors but one; all of a seed before the next.

    No attack stops early: what is over of the budget may help with a detector that it does not know.

    Args:
        detectors: Names.
        seeds: Number of seeds; each but 0 moves the camera and starts at a random point of the ball.
        eps: Radius of the l2 ball over the object's SH coefficients.
        steps: Number of steps.
        ensembles: Whether all but one are attacked at once, too; of two detectors they would be single ones.
    """
    single = [(name,) for name in detectors]
    others = [tuple(other for other in detectors if other != name) for name in detectors]
    sources = single + (others if ensembles and len(detectors) > 2 else [])
    return [
        SourceJob(
            sources=names,
            scene=scene,
            object=object_name,
            target=target,
            config=DaggerConfig(
                eps=(eps,), steps=steps, seed=seed, random_start=seed > 0, early_stop=False, noise_draws=0
            ),
        )
        for seed in range(seeds)
        for names in sources
        for scene, object_name, target in PAIRS
    ]


class TransferRunner:
    """Attacks and judges; scenes are read and detectors loaded once.

    Args:
        read: Finds a scene by its name.
        load: Loads a detector by its name.
        out: Folder of the study.
    """

    def __init__(self, read: Callable[[str], AttackScene], load: Callable[[str], Detector], out: Path) -> None:
        self._objects = AttackedObjects(read, load, out)

    def path(self, job: SourceJob) -> Path:
        """File of the attacked object."""
        return self._objects.path(job)

    def attack_fingerprint(self, job: SourceJob) -> str:
        """Hash of the scene, its cameras and the weights of the detectors attacked."""
        return self._objects.fingerprint(job, job.sources)

    def attack(self, job: SourceJob) -> dict[str, Any]:
        """Attack, save the object's Gaussians, and return the summary without its views."""
        objective = relabel(job.target, confidence=SUCCESS)
        return self._objects.attack(job, job.sources, objective, render=self._objects.place(job).render)

    def judge_fingerprint(self, job: JudgeJob) -> str:
        """Hash of the scene, of the attacked object, and of the weights of all detectors that play a part."""
        return self._objects.look_fingerprint(job.source, (*job.source.sources, job.detector))

    def judge(self, job: JudgeJob) -> dict[str, Any]:
        """What the detector reports on the object, as `AttackedObjects.seen` returns it."""
        return self._objects.seen(job.source, job.detector, render=self._objects.place(job.source).render)
