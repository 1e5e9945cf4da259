"""Attacks whose splats other detectors judge: what is attacked, what is judged, and the runner of both.

An attack leaves the object's Gaussians as a PLY, so that a detector that comes later judges what is there already.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Generator, Tensor

from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.jobs import AttackScene
from attacks.dagger.report import summary
from attacks.dagger.study import PAIRS
from attacks.dagger.transfer.scenes import AttackScenes
from attacks.detectors.base import Detector
from attacks.evaluation.views import detect_views, object_boxes
from attacks.gaussian_subset import GaussianSubset
from attacks.objectives import relabel
from mi_splat.attributes import ATTRIBUTES
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import load_splat, save_splat
from mi_splat.scene import GaussianScene

ATTACKED = "attacked"
"""Folder of the attacked objects."""

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


def clean_and_attacked(
    scene: GaussianScene, rows: slice, saved: GaussianScene, attributes: Sequence[str]
) -> tuple[GaussianSubset, GaussianSubset]:
    """An object in the clean scene, with as many coefficients as the attacked one has, and in the attacked scene.

    Args:
        scene: The clean scene.
        rows: The object.
        saved: Its Gaussians after the attack, as they were loaded from their file.
        attributes: What of them was attacked; all else is taken from the clean scene.
    """
    clean = GaussianSubset.of(scene.with_degree(max(saved.degree, scene.degree)), rows)
    values = {
        name: whole.clone().index_put((clean.rows,), part)
        for name, whole, part in zip(ATTRIBUTES, clean.scene.tensors(), saved.tensors(), strict=True)
        if name in attributes
    }
    return clean, GaussianSubset.of(clean.scene.replace(**values), rows)


class TransferRunner:
    """Attacks and judges; scenes are read and detectors loaded once.

    Args:
        read: Finds a scene by its name.
        load: Loads a detector by its name.
        out: Folder of the study.
    """

    def __init__(self, read: Callable[[str], AttackScene], load: Callable[[str], Detector], out: Path) -> None:
        self._scenes, self._load, self._out = AttackScenes(read), load, out
        self._detectors: dict[str, Detector] = {}
        self._boxes: dict[tuple[str, str, int], Tensor] = {}
        self._clean: dict[tuple[str, str, int, str, str], dict[str, float]] = {}

    def path(self, job: SourceJob) -> Path:
        """File of the attacked object."""
        return self._out / ATTACKED / f"{job.name}.ply"

    def attack_fingerprint(self, job: SourceJob) -> str:
        """Hash of the scene, its cameras and the weights of the detectors attacked."""
        return self._scenes.fingerprint(job.scene, job.object, *map(self._detector, job.sources))

    def attack(self, job: SourceJob) -> dict[str, Any]:
        """Attack, save the object's Gaussians, and return the summary without its views."""
        place = self._scenes.of(job.scene, job.object)
        rows = place.objects[job.object]
        found = attack(
            place.scene,
            rows,
            [self._scenes.view(job.scene, job.object, job.config.seed)],
            [self._detector(name) for name in job.sources],
            relabel(job.target, confidence=SUCCESS),
            render=place.render,
            config=job.config,
        )
        self.path(job).parent.mkdir(parents=True, exist_ok=True)
        save_splat(found.scene.select(rows), self.path(job))
        left_out = ("views", "zero_gradient_fraction", "trace", "noise")
        return {name: value for name, value in summary(found).items() if name not in left_out}

    def judge_fingerprint(self, job: JudgeJob) -> str:
        """Hash of the scene, its cameras, and the weights of all detectors that play a part."""
        names = (*job.source.sources, job.detector)
        return self._scenes.fingerprint(job.source.scene, job.source.object, *map(self._detector, names))

    def judge(self, job: JudgeJob) -> dict[str, Any]:
        """What the detector reports on the object: clean, attacked, and with random noise of the attack's size.

        Returns:
            For each of the three its confidence in the class that the object has (`original`) and in the `target`.
        """
        source, config = job.source, job.source.config
        place = self._scenes.of(source.scene, source.object)
        clean, attacked = self._subsets(source, place)
        reference, moved = (subset.parameters(config.attributes) for subset in (clean, attacked))
        noisy = clean.applied(config.budget.noise(moved, reference, Generator().manual_seed(config.seed + 1)))
        key = (source.scene, source.object, config.seed, job.detector, source.target)
        if key not in self._clean:
            self._clean[key] = self._seen(place.scene, job)
        return {
            "clean": self._clean[key],
            "attacked": self._seen(attacked.scene, job),
            "noise": self._seen(noisy, job),
        }

    def _subsets(self, job: SourceJob, place: AttackScene) -> tuple[GaussianSubset, GaussianSubset]:
        """The object in the clean scene and in the attacked one."""
        return clean_and_attacked(
            place.scene, place.objects[job.object], load_splat(self.path(job)), job.config.attributes
        )

    def _seen(self, scene: GaussianScene, job: JudgeJob) -> dict[str, float]:
        source = job.source
        place = self._scenes.of(source.scene, source.object)
        camera = self._scenes.view(source.scene, source.object, source.config.seed)
        key = (source.scene, source.object, source.config.seed)
        if key not in self._boxes:
            (box,) = object_boxes(place.scene, place.objects[source.object], [camera], render=place.render)
            if box is None:
                do = "choose another seed"
                raise InvalidValueError(message(source.name, "a view that shows the object", "none of it", do))
            self._boxes[key] = box
        (view,) = detect_views(
            scene, [camera], [self._detector(job.detector)], render=place.render, boxes=[self._boxes[key]]
        )
        return {"original": view.confidence(source.original), "target": view.confidence(source.target)}

    def _detector(self, name: str) -> Detector:
        if name not in self._detectors:
            self._detectors[name] = self._load(name)
        return self._detectors[name]
