"""Studies of DAGGER: what their settings mean, and the jobs that they are made of.

`study = "dagger"` attacks an object from some of its scene's cameras, `study = "dagger-eot"` from all cameras of a
region. Seed 0 looks from the scene's own cameras and starts at the clean splat; another one turns the cameras about the
object by up to 6 degrees, moves them by up to 5 %, and starts at a random point of the ball. In a region the seed
draws the views.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from attacks.dagger.config import DaggerConfig, EotConfig
from attacks.detectors.registry import detector_spec, load_detector
from attacks.objectives import Hide, Relabel, Untargeted
from attacks.observe.conditions import SunTable
from attacks.studies.attack import SPLAT, WHOLE_SPLAT, DrawnAttack, FixedAttack
from attacks.studies.look import DrawnLook, FixedLook
from attacks.studies.scenes import check_scene, scene_files, street_of
from attacks.studies.study_file import Settings, with_none
from attacks.transformations.config import CameraRegion, PictureChanges, Transformations
from mi_splat.errors import InvalidValueError, message, nearest
from mi_splat.fields import decode, several
from mi_splat.ledger import Job, Part

ATTACK, LOOK = "attacks.studies.attack", "attacks.studies.look"
AS_ATTACKED = "as attacked"
"""The condition that is the renderer of the attack."""
_AIMS = {"relabel": Relabel, "hide": Hide, "untargeted": Untargeted}
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Common:
    """Settings of both kinds of studies.

    Attributes:
        scene: Scene XML, relative to the working folder.
        object: Id of the object in it; with spaces for its underscores it is the object's class.
        aim: "relabel", "hide" or "untargeted".
        target: Class wanted, of the first aim.
        detectors: Names of those that are attacked at once.
        objective: Settings of the objective (see `attacks.objectives`), by name.
        seed: Of everything random.
    """

    scene: str
    object: str
    aim: Literal["relabel", "hide", "untargeted"] = "relabel"
    target: str | None = None
    detectors: tuple[str, ...] = ("fasterrcnn_small",)
    objective: dict[str, Any] = field(default_factory=dict)
    seed: int = 0

    def __post_init__(self) -> None:
        if (self.aim == "relabel") is (self.target is None):
            do = "name the class wanted, for instance person" if self.target is None else "leave it out"
            raise InvalidValueError(message("target", f"what the aim {self.aim} has", self.target or "none", do))
        for name in self.detectors if self.target is not None else ():
            classes = detector_spec(name).classes
            if self.target not in classes:
                expected = f"a class of {name}: {', '.join(classes)}"
                do = nearest(str(self.target), classes, "choose a class that it knows")
                raise InvalidValueError(message("target", expected, self.target, do))

    def of_attack(self) -> dict[str, Any]:
        """What both kinds of attacks have in common."""
        label = {} if self.target is None else {"label": self.target}
        return {
            "object": self.object,
            "objective": decode(_AIMS[self.aim], {**label, **self.objective}, "objective"),
            "detectors": self.detectors,
            "fingerprints": fingerprints(self.detectors),
        }

    def inputs(self) -> dict[str, Path]:
        """The files of the scene, and of the detectors' weights."""
        return {**scene_files(Path(self.scene)), **weights(self.detectors)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Fixed(Common):
    """Settings of `study = "dagger"`.

    Attributes:
        attack: How to attack, without the seed.
        camera: See `attacks.studies.attack.FixedAttack`, as all that follow.
        views: See there.
        renderer: See there.
        gradient: See there.
    """

    attack: DaggerConfig = field(default_factory=DaggerConfig)
    camera: int = 0
    views: int = 1
    renderer: str = ""
    gradient: str = ""

    def job(self) -> Job:
        """The attack."""
        renderers = (self.renderer, self.gradient)
        check_scene(Path(self.scene), self.object, camera=self.camera, renderers=renderers)
        start = self.attack.random_start or self.seed > 0
        config = FixedAttack(
            **self.of_attack(),
            attack=dataclasses.replace(self.attack, seed=self.seed, random_start=start),
            **{name: getattr(self, name) for name in ("camera", "views", "renderer", "gradient")},
        )
        return Job(kind=ATTACK, config=config, inputs=self.inputs())


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawn(Common):
    """Settings of `study = "dagger-eot"`.

    Attributes:
        attack: How to attack, without the seed.
        cameras: Where the object is looked at from.
        pictures: What happens to the pictures.
        judged_pictures: What happens to the pictures that judge; None is the same.
    """

    attack: EotConfig = field(default_factory=EotConfig)
    cameras: CameraRegion = field(default_factory=CameraRegion)
    pictures: PictureChanges = field(default_factory=PictureChanges)
    judged_pictures: PictureChanges | None = None

    @property
    def judged(self) -> Transformations | None:
        """The views that judge, where these are others."""
        if self.judged_pictures is None:
            return None
        return Transformations(cameras=self.cameras, pictures=self.judged_pictures)

    def job(self) -> Job:
        """The attack."""
        check_scene(Path(self.scene), self.object)
        config = DrawnAttack(
            **self.of_attack(),
            attack=dataclasses.replace(self.attack, seed=self.seed),
            transformations=Transformations(cameras=self.cameras, pictures=self.pictures),
            judged=self.judged,
        )
        return Job(kind=ATTACK, config=config, inputs=self.inputs())


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedJudge:
    """Who looks at an attacked splat through the cameras that were attacked.

    Attributes:
        detector: Name of the one that looks; None is each of those attacked.
        condition: How the splat is looked at, see `attacks.observe.conditions`; "as attacked" is the attacker's own
            renderer.
        sun: A street of meshes for conditions that are hours.
    """

    detector: str | None = None
    condition: str = AS_ATTACKED
    sun: SunTable | None = None

    def jobs(self, settings: Fixed, attacked: Job) -> list[Job]:
        """The looks at the splat of an attack.

        Args:
            settings: Of the attack.
            attacked: The attack.
        """
        condition = settings.renderer if self.condition == AS_ATTACKED else self.condition
        sun, street = street_of(condition, self.sun)
        attack = attacked.config.attack

        def look(shared: Mapping[str, Any]) -> FixedLook:
            how = {"eps": attack.eps, "camera": settings.camera, "views": settings.views}
            return FixedLook(**shared, **how, seed=attack.seed, condition=condition, sun=sun)

        return _looks(settings, attacked, self.detector, look, {"attacked": attacked.part(SPLAT), **street})


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnJudge:
    """Who looks at an attacked splat from the held-out views of its region.

    Attributes:
        detector: Name of the one that looks; None is each of those attacked.
        views: Number of the views, at most as many as have judged the attack.
    """

    detector: str | None = None
    views: int = 24

    def jobs(self, settings: Drawn, attacked: Job) -> list[Job]:
        """The looks at the splat of an attack; see `FixedJudge.jobs`."""
        attack = attacked.config.attack

        def look(shared: Mapping[str, Any]) -> DrawnLook:
            how = {"sh_degree": attack.sh_degree, "transformations": attacked.config.transformations}
            views = min(self.views, attack.held_out)
            return DrawnLook(**shared, **how, seed=attack.judge_seed, views=views)

        return _looks(settings, attacked, self.detector, look, {"attacked": attacked.part(WHOLE_SPLAT)})


def _looks(
    settings: Fixed | Drawn,
    attacked: Job,
    judge: str | None,
    look: Callable[[Mapping[str, Any]], FixedLook | DrawnLook],
    inputs: Mapping[str, Job | Part | Path],
) -> list[Job]:
    """A look at the splat of an attack by each detector.

    Args:
        settings: Of the attack.
        attacked: The attack.
        judge: Name of the detector that looks; None is each of those attacked.
        look: Makes the configuration of a look from what all looks have.
        inputs: Of each look, besides the scene and the weights.
    """
    attack = attacked.config.attack
    shared = {
        "object": settings.object,
        "target": settings.target,
        "attributes": attack.attributes,
        "norm": attack.norm,
    }
    return [
        Job(
            kind=LOOK,
            config=look({**shared, "detector": name, "fingerprints": fingerprints((name,))}),
            inputs={**inputs, **scene_files(Path(settings.scene)), **weights((name,))},
        )
        for name in (settings.detectors if judge is None else (judge,))
    ]


KINDS: Mapping[str, tuple[type[Fixed | Drawn], type[FixedJudge | DrawnJudge]]] = {
    "dagger": (Fixed, FixedJudge),
    "dagger-eot": (Drawn, DrawnJudge),
}
"""Settings of each kind of study, and of its judges."""


def settings_of(kind: type[_T], settings: Settings, where: str) -> _T:
    """Settings from tables of a file; "none" stands for None, and one value for a list of one.

    Args:
        kind: What they are.
        settings: The tables.
        where: The file, for errors.

    Raises:
        InvalidValueError: A key is unknown or missing, or a value cannot be.
    """
    attack = settings.get("attack", {})
    if isinstance(attack, Mapping) and "seed" in attack:
        raise InvalidValueError(message(f"attack in {where}", "no seed", attack["seed"], "write seed above the tables"))
    values: dict[str, Any] = with_none(settings)
    for table, name in (
        (values, "detectors"),
        (values.get("attack", {}), "eps"),
        (values.get("attack", {}), "attributes"),
    ):
        if name in table:
            table[name] = list(several(table[name]))
    return decode(kind, values, where)


def weights(detectors: tuple[str, ...]) -> dict[str, Path]:
    """The files with the weights of detectors, as inputs of a job.

    Raises:
        DetectorError: There is no such detector, or something that it needs is missing.
    """
    files = {}
    for name in detectors:
        spec = detector_spec(name)
        if missing := spec.missing():
            raise InvalidValueError(message(f"detector {name}", "one that can be loaded", "one that cannot", missing))
        if spec.weights is not None:
            files[f"weights {name}"] = spec.weights()
    return files


def fingerprints(detectors: tuple[str, ...]) -> tuple[str, ...]:
    """Fingerprints of those detectors whose weights are in no file."""
    return tuple(load_detector(name).fingerprint for name in detectors if detector_spec(name).weights is None)
