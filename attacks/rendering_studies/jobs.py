"""The attacks and the looks of a rendering study, and the runner of both."""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from attacks.dagger.config import DaggerConfig
from attacks.dagger.jobs import AttackScene
from attacks.dagger.pairs import SEARCHES
from attacks.dagger.transfer.attacked_objects import AttackedObjects
from attacks.detectors.base import Detector
from attacks.limits import SearchName
from attacks.objectives import Objective, relabel
from attacks.rendering_studies.conditions import condition_names, conditions_of, settings_of
from attacks.rendering_studies.config import OWN, AttackTable, Pair, RenderingStudy
from attacks.rendering_studies.gradient_source import with_gradient_of
from mi_splat.cameras import RenderFn
from mi_splat.comparison.methods import load_method
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import check_choice
from mi_splat.mixed_scenes import contents_hash


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
    def scene(self) -> str:
        """Name of the scene file without its suffix."""
        return self.pair.scene

    @property
    def object(self) -> str:
        """Id of the object."""
        return self.pair.object

    @property
    def target(self) -> str:
        """Class wanted."""
        return self.pair.target

    @property
    def camera(self) -> int:
        """Position of the camera in the order of the scene file."""
        return self.pair.camera

    @property
    def name(self) -> str:
        """File name, unique within a study."""
        config = self.config
        words = [self.renderer, self.gradient, self.detector, self.object, self.target, *config.attributes]
        words += [config.norm, f"{config.eps[0]:g}", f"degree{config.sh_degree}", f"{config.steps}", self.search]
        words += [f"camera{self.camera}", str(config.seed)]
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
    """Every attack of a study, each once, all of a seed before the next.

    Raises:
        InvalidValueError: Two of them would be kept under one name.
    """
    every = (
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
    )
    attacks = list(dict.fromkeys(every))
    kept: dict[str, StudyAttack] = {}
    for one in attacks:
        other = kept.setdefault(one.name, one)
        if other != one:
            got = f'"{one.object}" in {other.scene} and in {one.scene}, for the same target'
            raise InvalidValueError(message("pairs", "different objects", got, "make two studies of them"))
    return attacks


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
        self._study, self._objects = study, AttackedObjects(read, load, out)
        self._renderers: dict[tuple[str, str], RenderFn] = {}
        self._conditions: dict[tuple[str, str], Mapping[str, RenderFn]] = {}

    def check(self, jobs: Iterable[StudyAttack]) -> None:
        """Make all that the attacks and the looks at them need, so that what cannot be is found before the first one.

        Raises:
            InvalidValueError: A detector does not know a wanted class; or there is no such object, camera or renderer.
            MiSplatError: A scene cannot be read, a renderer cannot run here, or a detector cannot be loaded.
        """
        for job in jobs:
            check_choice(f"target for {job.detector}", job.target, self._objects.detector(job.detector).classes)
            self._objects.view(job)
            self._attackers_renderer(job)
            for look in looks_at(self._study, job):
                self._condition(look)

    def path(self, job: StudyAttack) -> Path:
        """File of the attacked object."""
        return self._objects.path(job)

    def fingerprint(self, job: StudyAttack) -> str:
        """Hash of the scene, its cameras and settings, the detector's weights, and the settings of the objective."""
        place = self._objects.place(job)
        words = (
            self._objects.fingerprint(job, [job.detector]),
            str(place.objects[job.object]),
            str(settings_of(place)),
            str(self._study.confidence),
            json.dumps(asdict(SEARCHES[job.search]), sort_keys=True),
        )
        return _hash_of(words)

    def look_fingerprint(self, look: StudyLook) -> str:
        """The same, with the attacked object, and what a condition is made of."""
        seen = self._objects.look_fingerprint(look.attack, [look.attack.detector])
        return _hash_of((self.fingerprint(look.attack), seen, self._street))

    @functools.cached_property
    def _street(self) -> str:
        """The street under the sun, and what its files hold."""
        sun = self._study.judge.sun
        return "" if sun is None else f"{sun} {contents_hash(Path(sun.scene))}"

    def attack(self, job: StudyAttack) -> dict[str, Any]:
        """Attack, save the object's Gaussians, and return the summary without its views."""
        settings = SEARCHES[job.search].objective
        objective: Objective = replace(relabel(job.target), confidence=self._study.confidence, **settings)
        return self._objects.attack(job, [job.detector], objective, render=self._attackers_renderer(job))

    def look(self, look: StudyLook) -> dict[str, Any]:
        """What the detector reports on the object, as `AttackedObjects.seen` returns it."""
        job, render = look.attack, self._condition(look)
        return self._objects.seen(job, job.detector, render=render, condition=look.condition)

    def _condition(self, look: StudyLook) -> RenderFn:
        job = look.attack
        if self._study.judge.own_renderer:
            return self._renderer(job, look.condition)
        key = (job.scene, job.object)
        if key not in self._conditions:
            self._conditions[key] = conditions_of(self._study.judge, self._objects.place(job), job.object)
        return self._conditions[key][look.condition]

    def _attackers_renderer(self, job: StudyAttack) -> RenderFn:
        picture = self._renderer(job, job.renderer)
        return picture if job.gradient == OWN else with_gradient_of(self._renderer(job, job.gradient), picture)

    def _renderer(self, job: StudyAttack, name: str) -> RenderFn:
        key = (job.scene, name)
        if key not in self._renderers:
            self._renderers[key] = load_method(name, settings_of(self._objects.place(job))).render
        return self._renderers[key]


def _hash_of(words: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(words).encode()).hexdigest()
