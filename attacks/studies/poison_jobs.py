"""A point of a study of poisoned pictures as jobs: victims are trained and measured, and others look at them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from attacks.classifiers.base import Classifier
from attacks.classifiers.registry import load_classifier
from attacks.cloak.config import SceneConfig, StudyConfig, TrainingConfig
from attacks.cloak.kinds.parts import SET, Pose
from attacks.cloak.kinds.seen import NO_ATTACK, loaded
from attacks.cloak.steps import Look, StudySteps
from attacks.observe.rows import ATTACKED, CLEAN
from attacks.poisons.changed import ChangedConfig
from attacks.poisons.classified import ClassifiedConfig
from attacks.poisons.config import MIFGSMConfig
from attacks.poisons.filtered import FilteredConfig
from attacks.poisons.measured import MeasuredConfig
from attacks.poisons.pruned import PrunedConfig
from attacks.poisons.registry import CloakConfig, PoisonConfig
from attacks.poisons.victim import VictimConfig
from attacks.studies.poison_point import Defence, point_of
from attacks.studies.study_file import Point
from mi_splat.cameras import Camera
from mi_splat.directions import Point as Position
from mi_splat.errors import InvalidValueError
from mi_splat.fields import check_choice
from mi_splat.ledger import Job, Part
from mi_splat.training.resume import SPLAT

_KINDS = "attacks.poisons"
CLASSIFIED = f"{_KINDS}.classified"
"""Kind of the jobs in which a classifier looks."""
DEFENDED = "defended"
"""Condition of rows of a splat whose victim defends itself."""
TRAINING, HELD_OUT, PHOTOGRAPH = "training cameras", "held-out cameras", "photograph"
"""Conditions of what is seen of a splat, or of pictures, from the cameras of the training or others."""
_SEED, _OWN_NAME = "seed", "the study"


@cache
def classifier_of(name: str) -> Classifier:
    """A classifier with its usual weights, loaded once."""
    return load_classifier(name)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainedVictim:
    """A splat of a point, and who measures it.

    Attributes:
        splat: "clean" or "attacked".
        defended: Whether the victim defends itself.
        trained: The training.
        measured: What looks at the result.
        looks: Of classifiers and detectors.
    """

    splat: str
    defended: bool
    trained: Job
    measured: Job
    looks: Sequence[Look]


class Attempt:
    """A point as jobs.

    Args:
        point: The point.
        name: Of the study.
    """

    def __init__(self, point: Point, name: str) -> None:
        labels = {axis: label for axis, label in point.labels.items() if axis != _SEED}
        self.value = ", ".join(map(str, labels.values())) or point.part or _OWN_NAME
        self.part = point.part or " and ".join(labels) or name
        self.asked = point_of(point.settings, name)
        self._steps = StudySteps(study=self.asked.study(self.asked.training), folder=Path("."))
        self._labelled: dict[str, Job] = {}
        self.poisoned: Job | None = None
        self.pictures = self._made("taking pictures", self._steps.pictures())
        self.victims = list(self._victims())

    @property
    def title(self) -> str:
        """What rows call it, whatever its seed."""
        return f"{self.part}: {self.value}"

    def jobs(self) -> dict[str, Job]:
        """Every job by its label."""
        return self._labelled

    @property
    def centre(self) -> Position:
        """Centre of the object, world units."""
        return self._steps.study.centre

    def cameras(self, condition: str) -> Sequence[Camera]:
        """Cameras of a condition, as its rows number them."""
        setup = self._steps.setup
        return setup.training_cameras if TRAINING in condition else setup.held_out_cameras

    def _made(self, label: str, job: Job) -> Job:
        return self._labelled.setdefault(f"{self.title}, seed {self.asked.seed} / {label}", job)

    def _victims(self) -> Iterator[TrainedVictim]:
        asked = self.asked
        clean = self._trained(f"{CLEAN} pictures", self.pictures)
        yield self._measured(CLEAN, clean, trained=clean)
        sets = {CLEAN: self.pictures}
        if asked.poison is not None:
            sets[ATTACKED] = self.poisoned = self._made("poisoning", self._changed(asked.poison, clean))
            attacked = self._trained(f"{ATTACKED} pictures", self.poisoned)
            yield self._measured(ATTACKED, attacked, trained=attacked)
        if asked.defence is not None:
            for splat, pictures in sets.items():
                trained, finished = self._defended(asked.defence, splat, pictures, clean)
                yield self._measured(splat, finished, trained=trained, defended=True)

    def _changed(self, poison: PoisonConfig, clean: Job) -> Job:
        """The poisoned set; an attacker who trains otherwise than the victim starts from a splat of their own."""
        asked, study = self.asked, self._steps.study
        if isinstance(poison, CloakConfig):
            return replace(self._steps, study=replace(study, attack=poison.attack)).poisoned(asked.seed)
        if isinstance(poison, MIFGSMConfig):
            return self._misread(poison, clean)
        config = ChangedConfig(**self._attackers_step, poison=poison, device=asked.victim.device)
        inputs = {"pictures": self.pictures.part(f"{SET}/*"), "splat": self._start(clean)}
        return Job(kind=f"{_KINDS}.changed", config=config, inputs=inputs)

    def _start(self, clean: Job) -> Part:
        """The splat that a decoy starts as: the victim's, or the attacker's if they train otherwise."""
        asked = self.asked
        if asked.attacker is None:
            return clean.part(SPLAT)
        return self._trained("clean pictures, by the attacker", self.pictures, asked.attacker).part(SPLAT)

    @property
    def _attackers_step(self) -> dict[str, Any]:
        return self._step(self.asked.attacker or self.asked.training)

    def _misread(self, poison: MIFGSMConfig, clean: Job) -> Job:
        """The set whose pictures deceive a classifier."""
        asked = self.asked
        if not asked.deceive:
            do = 'write deceive = "prototypes"'
            raise InvalidValueError.of(self.title, "a classifier that M-IFGSM deceives", "none", do)
        masks, classifier = self._made("drawing masks", self._steps.masks()), self._classifier_cells(asked.deceive)
        if poison.target is not None:
            others = [name for name in classifier_of(asked.deceive).classes if name != classifier["label"]]
            check_choice(f"target for {asked.deceive}", poison.target, others)
        inputs = {"pictures": self.pictures.part(f"{SET}/*"), "masks": masks.part("*.png")}
        if poison.decoy_steps:
            inputs["splat"] = self._start(clean)
        step = self._attackers_step if poison.decoy_steps else self._step(TrainingConfig())
        return Job(kind=f"{_KINDS}.changed", config=ChangedConfig(**step, poison=poison, **classifier), inputs=inputs)

    def _classifier_cells(self, name: str) -> dict[str, Any]:
        """A classifier, which has to know the object's class."""
        label, classifier = self.asked.scene.class_name, classifier_of(name)
        check_choice(f"class for {name}", label, classifier.classes)
        device = self.asked.victim.device
        return {"classifier": name, "fingerprint": classifier.fingerprint, "label": label, "device": device}

    def _looks(self, splat: str, finished: Job, *, defended: bool) -> Iterator[Look]:
        """Everybody's looks: at a splat from training and held-out cameras, and at undefended pictures of the same."""
        setup, pictures = self._steps.setup, self.pictures if splat == CLEAN else self.poisoned
        shown: dict[str, tuple[str, Job, Sequence[Camera]]] = {
            TRAINING: ("splat", finished, setup.training_cameras),
            HELD_OUT: ("splat", finished, setup.held_out_cameras),
        }
        if pictures is not None and not defended:
            shown[f"{PHOTOGRAPH}, {TRAINING}"] = ("set", pictures, ())
        if splat == CLEAN and not defended:
            shown[f"{PHOTOGRAPH}, {HELD_OUT}"] = ("pictures", self._steps.true_pictures(setup.held_out_cameras), ())
        also = f", {DEFENDED}" * defended
        for condition, (what, job, cameras) in shown.items():
            looking = {name: self._classified(name, what, job, cameras) for name in self.asked.classifiers}
            looking |= {name: self._detected(name, job, condition) for name in self.asked.detectors}
            for name, look in looking.items():
                label = f"{name} looks at the {splat} splat{also}, {condition}"
                yield Look(
                    label=label,
                    job=self._made(label, look),
                    splat=splat,
                    seed=self.asked.seed,
                    condition=f"{condition}{also}",
                )

    def _classified(self, name: str, what: str, shown: Job, cameras: Sequence[Camera]) -> Job:
        """What a classifier takes the object for, on a splat from cameras, in a set, or in pictures."""
        part = {"splat": SPLAT, "set": f"{SET}/*", "pictures": "*.png"}[what]
        step = {**self._step(TrainingConfig()), **self._classifier_cells(name)}
        config = ClassifiedConfig(**step, poses=tuple(map(Pose.of, cameras)))
        return Job(kind=CLASSIFIED, config=config, inputs={what: shown.part(part)})

    def _detected(self, name: str, shown: Job, condition: str) -> Job:
        """What a detector reports, which has to know the object's class."""
        detector = loaded(name)
        check_choice(f"class for {name}", self.asked.scene.class_name, detector.classes)
        if HELD_OUT in condition:
            return self._steps.seen(shown, detector)
        return self._steps.seen_in_training(shown, detector, self.asked.seed)

    def _step(self, training: TrainingConfig) -> dict[str, Any]:
        """The part of a configuration that a training, or what renders its splat, depends on."""
        scene, training = SceneConfig(background=self.asked.scene.background), replace(training, near=self._near)
        seeds, attack = (self.asked.seed,), NO_ATTACK
        return {"asked": StudyConfig(name="step", scene=scene, training=training, seeds=seeds, attack=attack)}

    @cached_property
    def _near(self) -> float:
        return self._steps.setup.near

    def _trained(
        self, on: str, pictures: Job, training: TrainingConfig | None = None, *, limited_by: Job | None = None
    ) -> Job:
        asked, step = self.asked, self._step(training or self.asked.training)
        limit = asked.defence.limit if limited_by is not None and asked.defence is not None else None
        config = VictimConfig(**step, **asdict(asked.victim), limit=limit)
        inputs = {"pictures": pictures.part(f"{SET}/*")}
        if limited_by is not None:
            inputs["clean"] = limited_by.part(SPLAT)
        return self._made(f"training on {on}", Job(kind=f"{_KINDS}.victim", config=config, inputs=inputs))

    def _defended(self, defence: Defence, splat: str, pictures: Job, clean: Job) -> tuple[Job, Job]:
        """The training of a victim that defends itself, and the job that has what is left in the end."""
        step, inputs = self._step(TrainingConfig()), {"pictures": pictures.part(f"{SET}/*")}
        if defence.filter is not None:
            config = FilteredConfig(**step, filter=defence.filter)
            filtering = Job(kind=f"{_KINDS}.filtered", config=config, inputs=inputs)
            shown = self._made(f"filtering {splat} pictures", filtering)
            trained = self._trained(f"filtered {splat} pictures", shown)
            return trained, trained
        limited_by, how = (None, "") if defence.limit is None else (clean, ", limited")
        trained = self._trained(f"{splat} pictures{how}", pictures, limited_by=limited_by)
        if defence.prune is None:
            return trained, trained
        inputs["splat"] = trained.part(SPLAT)
        pruning = Job(kind=f"{_KINDS}.pruned", config=PrunedConfig(**step, prune=defence.prune), inputs=inputs)
        return trained, self._made(f"pruning the {splat} splat", pruning)

    def _measured(self, splat: str, finished: Job, *, trained: Job, defended: bool = False) -> TrainedVictim:
        cameras = self._steps.setup.held_out_cameras
        true = self._made("taking pictures to compare with", self._steps.true_pictures(cameras))
        step, poses = self._step(TrainingConfig()), tuple(map(Pose.of, cameras))
        config = MeasuredConfig(**step, poses=poses, device=self.asked.victim.device)
        inputs = {"splat": finished.part(SPLAT), "pictures": true.part("*.png")}
        label = f"measuring the {splat} splat{', defended' * defended}"
        job = self._made(label, Job(kind=f"{_KINDS}.measured", config=config, inputs=inputs))
        looks = list(self._looks(splat, finished, defended=defended))
        return TrainedVictim(splat=splat, defended=defended, trained=trained, measured=job, looks=looks)
