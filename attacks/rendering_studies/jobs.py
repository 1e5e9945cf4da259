"""The attacks and the looks of a rendering study, and the runner of both."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import Generator, Tensor

from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.jobs import AttackScene
from attacks.dagger.pairs import SEARCHES
from attacks.dagger.report import summary
from attacks.dagger.transfer.jobs import ATTACKED, clean_and_attacked
from attacks.dagger.transfer.scenes import AttackScenes
from attacks.detectors.base import Detector
from attacks.evaluation.views import detect_views, object_boxes
from attacks.limits import SearchName
from attacks.objectives import Objective, relabel
from attacks.rendering_studies.conditions import Condition, condition_names, conditions_of
from attacks.rendering_studies.config import OWN, AttackTable, Pair, RenderingStudy
from attacks.rendering_studies.gradient_source import with_gradient_of
from mi_splat.cameras import Camera, RenderFn
from mi_splat.comparison.methods import load_method
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import load_splat, save_splat
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyAttack:
    """One attack.

    Attributes:
        pair: What is attacked, and the class wanted.
        detector: Name of the detector.
        renderer: Whose pictures the attacker looks at.
        gradient: Whose gradient the attacker follows; "own" is that of the pictures.
        search: Key of `attacks.dagger.pairs.SEARCHES`.
        config: The rest. Its seed also moves the camera, see `attacks.dagger.jobs.jittered`.
    """

    pair: Pair
    detector: str
    renderer: str
    gradient: str
    search: SearchName
    config: DaggerConfig

    @property
    def name(self) -> str:
        """File name, unique within a study."""
        config = self.config
        words = [self.renderer, self.gradient, self.detector, self.pair.object, self.pair.target, *config.attributes]
        words += [config.norm, f"{config.eps[0]:g}", f"degree{config.sh_degree}", f"{config.steps}", self.search]
        words += [f"camera{self.pair.camera}", str(config.seed)]
        return "-".join(word.replace(" ", "_") for word in words)


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyLook:
    """One look at one attacked splat.

    Attributes:
        attack: The attack.
        condition: Name of the condition.
    """

    attack: StudyAttack
    condition: str

    @property
    def name(self) -> str:
        """File name, unique within a study."""
        return f"{self.attack.name}-under-{self.condition}".replace(" ", "_").replace(":", "")


def attacks_of(study: RenderingStudy) -> list[StudyAttack]:
    """Every attack of a study, all of a seed before the next."""
    return [
        StudyAttack(
            pair=pair,
            detector=detector,
            renderer=renderer,
            gradient=OWN if gradient == renderer else gradient,
            search=table.search,
            config=_config(table, eps, seed),
        )
        for seed in range(study.seeds)
        for table in study.attacks
        for detector, pair, eps in itertools.product(study.detectors, study.pairs, table.eps)
        for renderer, gradient in itertools.product(table.renderers, table.gradients)
    ]


def _config(table: AttackTable, eps: float, seed: int) -> DaggerConfig:
    return DaggerConfig(
        attributes=(table.attribute,),
        eps=(eps,),
        norm=table.norm,
        steps=table.steps,
        sh_degree=table.sh_degree,
        seed=seed,
        random_start=seed > 0,
        early_stop=False,
        noise_draws=0,
        **SEARCHES[table.search].config,
    )


def looks_at(study: RenderingStudy, attack: StudyAttack) -> list[StudyLook]:
    """Every look at an attacked splat; its own renderer's where the study asks for no others."""
    names = condition_names(study.judge) or (attack.renderer,)
    return [StudyLook(attack=attack, condition=name) for name in names]


class StudyRunner:
    """Attacks and looks; scenes are read, detectors loaded and conditions made once.

    Args:
        study: The study.
        read: Finds a scene by its name.
        load: Loads a detector by its name.
        out: Folder of the study.
    """

    def __init__(
        self,
        study: RenderingStudy,
        read: Callable[[str], AttackScene],
        load: Callable[[str], Detector],
        out: Path,
    ) -> None:
        self._study, self._scenes, self._load, self._out = study, AttackScenes(read), load, out
        self._detectors: dict[str, Detector] = {}
        self._renderers: dict[tuple[str, str], RenderFn] = {}
        self._conditions: dict[tuple[str, str], dict[str, Condition]] = {}
        self._boxes: dict[tuple[str, str, int, int], Tensor] = {}
        self._clean: dict[tuple[Pair, str, int, str, int], dict[str, float]] = {}

    def path(self, job: StudyAttack) -> Path:
        """File of the attacked object."""
        return self._out / ATTACKED / f"{job.name}.ply"

    def fingerprint(self, job: StudyAttack) -> str:
        """Hash of the scene, its cameras and the weights of the detector."""
        return self._scenes.fingerprint(job.pair.scene, job.pair.object, self._detector(job.detector))

    def look_fingerprint(self, look: StudyLook) -> str:
        """The same, with what a condition is made of."""
        words = (self.fingerprint(look.attack), repr(self._study.judge.sun))
        return hashlib.sha256("\n".join(words).encode()).hexdigest()

    def attack(self, job: StudyAttack) -> dict[str, Any]:
        """Attack, save the object's Gaussians, and return the summary without its views."""
        place = self._place(job)
        rows = place.objects[job.pair.object]
        objective: Objective = replace(
            relabel(job.pair.target), confidence=self._study.confidence, **SEARCHES[job.search].objective
        )
        found = attack(
            place.scene,
            rows,
            [self._view(job)],
            [self._detector(job.detector)],
            objective,
            render=self._attackers_renderer(job),
            config=job.config,
        )
        self.path(job).parent.mkdir(parents=True, exist_ok=True)
        save_splat(found.scene.select(rows), self.path(job))
        left_out = ("views", "zero_gradient_fraction", "trace", "noise")
        return {name: value for name, value in summary(found).items() if name not in left_out}

    def look(self, look: StudyLook) -> dict[str, Any]:
        """What the detector reports on the object: clean, attacked, and with random noise of the attack's size.

        Returns:
            For each of the three its confidence in the class that the object has (`original`) and in the `target`.
        """
        job, condition = look.attack, self._condition(look)
        place = self._place(job)
        clean, attacked = clean_and_attacked(
            place.scene, place.objects[job.pair.object], load_splat(self.path(job)), job.config.attributes
        )
        reference, moved = (subset.parameters(job.config.attributes) for subset in (clean, attacked))
        generator = Generator().manual_seed(job.config.seed + 1)
        noisy = clean.applied(job.config.budget.noise(moved, reference, generator))
        key = (job.pair, job.detector, job.config.seed, look.condition, clean.scene.degree)
        if key not in self._clean:
            self._clean[key] = self._seen(clean.scene, job, condition)
        return {
            "clean": self._clean[key],
            "attacked": self._seen(attacked.scene, job, condition),
            "noise": self._seen(noisy, job, condition),
        }

    def _seen(self, scene: GaussianScene, job: StudyAttack, condition: Condition) -> dict[str, float]:
        pair, place, camera = job.pair, self._place(job), self._view(job)
        key = (pair.scene, pair.object, pair.camera, job.config.seed)
        if key not in self._boxes:
            (box,) = object_boxes(place.scene, place.objects[pair.object], [camera], render=place.render)
            if box is None:
                do = "choose another seed"
                raise InvalidValueError(message(job.name, "a view that shows the object", "none of it", do))
            self._boxes[key] = box
        shown, boxes = condition.change(scene), [self._boxes[key]]
        (view,) = detect_views(shown, [camera], [self._detector(job.detector)], render=condition.render, boxes=boxes)
        return {
            "original": view.confidence(pair.object.replace("_", " ")),
            "target": view.confidence(pair.target),
        }

    def _view(self, job: StudyAttack) -> Camera:
        return self._scenes.view(job.pair.scene, job.pair.object, job.config.seed, job.pair.camera)

    def _condition(self, look: StudyLook) -> Condition:
        job = look.attack
        if self._study.judge.own_renderer:
            return Condition(name=look.condition, render=self._renderer(job, look.condition))
        key = (job.pair.scene, job.pair.object)
        if key not in self._conditions:
            place = self._place(job)
            self._conditions[key] = conditions_of(self._study.judge, place, job.pair.object, _settings(place))
        return self._conditions[key][look.condition]

    def _attackers_renderer(self, job: StudyAttack) -> RenderFn:
        picture = self._renderer(job, job.renderer)
        return picture if job.gradient == OWN else with_gradient_of(self._renderer(job, job.gradient), picture)

    def _renderer(self, job: StudyAttack, name: str) -> RenderFn:
        key = (job.pair.scene, name)
        if key not in self._renderers:
            self._renderers[key] = load_method(name, _settings(self._place(job))).render
        return self._renderers[key]

    def _place(self, job: StudyAttack) -> AttackScene:
        return self._scenes.of(job.pair.scene, job.pair.object)

    def _detector(self, name: str) -> Detector:
        if name not in self._detectors:
            self._detectors[name] = self._load(name)
        return self._detectors[name]


def _settings(place: AttackScene) -> RenderSettings:
    return place.render.settings if isinstance(place.render, Renderer) else RenderSettings()
