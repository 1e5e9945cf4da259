"""A point of a study of poisoned pictures as jobs: victims are trained and measured, and others look at them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from attacks.classifiers.base import Classifier
from attacks.classifiers.registry import load_classifier
from attacks.cloak.cleaning import CleanedConfig
from attacks.cloak.config import CameraConfig, EvaluationConfig, SceneConfig, StudyConfig, TrainingConfig
from attacks.cloak.kinds.seen import loaded
from attacks.cloak.setup import Pose
from attacks.cloak.steps import PICTURES, POISONED_KIND, Look, StudySteps
from attacks.observe.rows import ATTACKED, CLEAN
from attacks.poisons.classified import ClassifiedConfig
from attacks.poisons.cloak import CLOAK
from attacks.poisons.config import FilterConfig, FrequencyPruningConfig
from attacks.poisons.measured import MeasuredConfig
from attacks.poisons.poisoned import PoisonedConfig
from attacks.poisons.specs import ChosenPoison
from attacks.studies.plan import OWN_NAME, Attempt, names_of
from attacks.studies.study_file import Point, Settings, with_none
from mi_splat.cameras import Camera
from mi_splat.directions import Point as Position
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Checked, Seed, above, check, check_choice, decode
from mi_splat.ledger import Job, Part
from mi_splat.training.resume import SPLAT

CLASSIFIED = "attacks.poisons.classified"
"""Kind of the jobs in which a classifier looks."""
DEFENDED = "defended"
"""Condition of rows of a splat whose victim defends itself."""
TRAINING, HELD_OUT, PHOTOGRAPH = "training cameras", "held-out cameras", "photograph"
"""Conditions of what is seen of a splat, or of pictures, from the cameras of the training or others."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Victim(Checked):
    """What the victim trains on, and can afford; see `attacks.cloak.kinds.trained.TrainedConfig`."""

    device: Literal["cpu", "cuda"] = "cpu"
    seconds: Annotated[float, above(0, "seconds")] | None = None
    megabytes: Annotated[float, above(0, "MB")] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Defence(Checked):
    """What a victim does who fears poison; one of these.

    Attributes:
        filter: All pictures are filtered before the training, and those that it is compared with are not.
        limit: No more Gaussians than so many times those of the clean splat.
        prune: Gaussians that are too fine for the cameras are taken out of the finished splat.
    """

    filter: FilterConfig | None = None
    limit: Annotated[float, above(0, "times the clean splat's Gaussians")] | None = None
    prune: FrequencyPruningConfig | None = None

    def __post_init__(self) -> None:
        check(self)
        given = [name for name in ("filter", "limit", "prune") if getattr(self, name) is not None]
        if len(given) != 1:
            do = "make each a case of its own"
            raise InvalidValueError.of("defence", "one of filter, limit and prune", given or "none", do)


@dataclass(frozen=True, slots=True, kw_only=True)
class PoisonPoint:
    """What a point asks for.

    Attributes:
        seed: Of the poison, and of both trainings.
        scene: What is photographed.
        cameras: Where from.
        training: How the victim trains.
        attacker: How the splat is trained that the attacker starts from; None is as the victim does.
        victim: What it trains on, and can afford.
        evaluation: Its `cameras` are those that no training used; of its `confidence` on, a detection counts.
        poison: The attack; None leaves the set as it is.
        defence: What the victim does against it; None is nothing.
        deceive: Classifier that M-IFGSM deceives.
        classifiers: Who says what the object is, in pictures and on splats.
        detectors: Who looks for it there.
    """

    seed: Seed = 0
    scene: SceneConfig = field(default_factory=SceneConfig)
    cameras: CameraConfig = field(default_factory=CameraConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    attacker: TrainingConfig | None = None
    victim: Victim = field(default_factory=Victim)
    evaluation: EvaluationConfig = field(default_factory=lambda: EvaluationConfig(cameras=60))
    poison: ChosenPoison | None = None
    defence: Defence | None = None
    deceive: str = ""
    classifiers: tuple[str, ...] = ()
    detectors: tuple[str, ...] = ()

    @property
    def study(self) -> StudyConfig:
        """Scene, cameras and training, in which no appearance is hidden."""
        return StudyConfig(
            name="poison",
            seeds=(self.seed,),
            scene=self.scene,
            cameras=self.cameras,
            training=self.training,
            evaluation=self.evaluation,
        )


def point_of(settings: Settings, name: str) -> PoisonPoint:
    """What a point asks for."""
    values = with_none(settings)
    table = values.pop("poison", None)
    poison = None if table is None else ChosenPoison.of(table, f"{name}, poison")
    return replace(decode(PoisonPoint, values, name), poison=poison)


@cache
def classifier_of(name: str) -> Classifier:
    """A classifier with its usual weights, loaded once."""
    return load_classifier(name)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainedVictim:
    """A splat of a point, and who measures it."""

    splat: str
    defended: bool
    trained: Job
    measured: Job
    looks: Sequence[Look]


@dataclass(frozen=True, kw_only=True, eq=False)
class PoisonAttempt(Attempt):
    """A point as jobs."""

    part: str
    value: str
    options: PoisonPoint
    steps: StudySteps
    poisoned: Job | None  # the poisoned set; None without a poison
    victims: Sequence[TrainedVictim]

    @property
    def centre(self) -> Position:
        """Centre of the object, world units."""
        return self.steps.setup.centre

    def cameras(self, condition: str) -> Sequence[Camera]:
        """Cameras of a condition, as its rows number them."""
        setup = self.steps.setup
        return setup.training_cameras if TRAINING in condition else setup.held_out_cameras


def attempt_of(point: Point, study: str) -> PoisonAttempt:
    """The jobs of a point."""
    part, value = names_of(point, study, without=("seed",))
    value = point.part if value == OWN_NAME and point.part else value
    options = point_of(point.settings, study)
    builder = _Builder(options, f"{part}: {value}", f"{part}: {value}, seed {options.seed}")
    victims = list(builder.victims())
    return PoisonAttempt(
        point=point,
        title=builder.title,
        jobs=builder.jobs,
        part=part,
        value=value,
        options=options,
        steps=builder.steps,
        poisoned=builder.poisoned,
        victims=victims,
    )


class _Builder:
    """Puts the jobs of a point together."""

    def __init__(self, options: PoisonPoint, title: str, label: str) -> None:
        self.options, self.title, self._label = options, title, label
        self.steps = StudySteps(study=options.study)
        self.jobs: dict[str, Job] = {}
        self.poisoned: Job | None = None
        self.pictures = self._made("taking pictures", self.steps.pictures())

    def _made(self, label: str, job: Job) -> Job:
        return self.jobs.setdefault(f"{self._label} / {label}", job)

    def victims(self) -> Iterator[TrainedVictim]:
        """The splats of clean and of poisoned pictures, and those of a victim that defends itself."""
        options = self.options
        clean = self._trained(f"{CLEAN} pictures", self.pictures)
        yield self._measured(CLEAN, clean, trained=clean)
        sets = {CLEAN: self.pictures}
        if options.poison is not None:
            sets[ATTACKED] = self.poisoned = self._made("poisoning", self._poisoned(options.poison, clean))
            attacked = self._trained(f"{ATTACKED} pictures", self.poisoned)
            yield self._measured(ATTACKED, attacked, trained=attacked)
        if options.defence is not None:
            for splat, pictures in sets.items():
                trained, finished = self._defended(options.defence, splat, pictures, clean)
                yield self._measured(splat, finished, trained=trained, defended=True)

    def _poisoned(self, poison: ChosenPoison, clean: Job) -> Job:
        """The poisoned set; an attacker who trains otherwise than the victim starts from a splat of their own."""
        options, config, needs = self.options, poison.config, poison.spec.needs
        if poison.kind == CLOAK:
            return replace(self.steps, study=replace(options.study, attack=config.attack)).poisoned(options.seed)
        values: dict[str, Any] = {"device": options.victim.device}
        inputs: dict[str, Part | Path] = {"pictures": self.pictures.part(PICTURES)}
        if "classifier" in needs:
            values |= {**self._deceived(config.target), "scene": self.steps.scene_job()}
            inputs |= self.steps.mesh
        if "splat" in needs or getattr(config, "decoy_steps", 0) > 0:
            values |= {
                "training": replace(options.attacker or options.training, near=None),
                "near": self.steps.setup.near,
            }
            inputs["splat"] = self._start(clean)
        background = options.scene.background
        return Job(
            kind=POISONED_KIND,
            config=PoisonedConfig(poison=poison, background=background, seed=options.seed, **values),
            inputs=inputs,
        )

    def _start(self, clean: Job) -> Part:
        """The splat that a decoy starts as: the victim's, or the attacker's if they train otherwise."""
        options = self.options
        if options.attacker is None:
            return clean.part(SPLAT)
        return self._trained("clean pictures, by the attacker", self.pictures, options.attacker).part(SPLAT)

    def _deceived(self, target: str | None) -> dict[str, Any]:
        """The classifier that is to be deceived."""
        name = self.options.deceive
        if not name:
            do = 'write deceive = "prototypes"'
            raise InvalidValueError.of(self.title, "a classifier that M-IFGSM deceives", "none", do)
        classifier = self._classifier_cells(name)
        if target is not None:
            others = [known for known in classifier_of(name).classes if known != classifier["label"]]
            check_choice(f"target for {name}", target, others)
        return classifier

    def _classifier_cells(self, name: str) -> dict[str, Any]:
        """A classifier, which has to know the object's class."""
        label, classifier = self.options.scene.class_name, classifier_of(name)
        check_choice(f"class for {name}", label, classifier.classes)
        device = self.options.victim.device
        return {"classifier": name, "fingerprint": classifier.fingerprint, "label": label, "device": device}

    def _looks(self, splat: str, finished: Job, *, defended: bool) -> Iterator[Look]:
        """Everybody's looks: at a splat from training and held-out cameras, and at undefended pictures of the same."""
        setup, pictures = self.steps.setup, self.pictures if splat == CLEAN else self.poisoned
        shown: dict[str, tuple[str, Job, Sequence[Camera]]] = {
            TRAINING: ("splat", finished, setup.training_cameras),
            HELD_OUT: ("splat", finished, setup.held_out_cameras),
        }
        if pictures is not None and not defended:
            shown[f"{PHOTOGRAPH}, {TRAINING}"] = ("set", pictures, ())
        if splat == CLEAN and not defended:
            shown[f"{PHOTOGRAPH}, {HELD_OUT}"] = ("pictures", self.steps.true_pictures(setup.held_out_cameras), ())
        also = f", {DEFENDED}" * defended
        for condition, (what, job, cameras) in shown.items():
            looking = {name: self._classified(name, what, job, cameras) for name in self.options.classifiers}
            looking |= {name: self._detected(name, job, condition) for name in self.options.detectors}
            for name, look in looking.items():
                label = f"{name} looks at the {splat} splat{also}, {condition}"
                yield Look(
                    label=label,
                    job=self._made(label, look),
                    splat=splat,
                    seed=self.options.seed,
                    condition=f"{condition}{also}",
                )

    def _classified(self, name: str, what: str, shown: Job, cameras: Sequence[Camera]) -> Job:
        """What a classifier takes the object for, on a splat from cameras, in a set, or in pictures."""
        part = {"splat": SPLAT, "set": PICTURES, "pictures": "*.png"}[what]
        cells = {**self.steps.splat_job(), **self._classifier_cells(name)}
        config = ClassifiedConfig(**cells, poses=tuple(map(Pose.of, cameras)))
        return Job(kind=CLASSIFIED, config=config, inputs={what: shown.part(part)})

    def _detected(self, name: str, shown: Job, condition: str) -> Job:
        """What a detector reports, which has to know the object's class."""
        detector = loaded(name)
        check_choice(f"class for {name}", self.options.scene.class_name, detector.classes)
        if HELD_OUT in condition:
            return self.steps.seen(shown, detector)
        return self.steps.seen_in_training(shown, detector, self.options.seed)

    def _trained(
        self,
        on: str,
        pictures: Job,
        training: TrainingConfig | None = None,
        clean: Job | None = None,
        limit: float | None = None,
    ) -> Job:
        limits = {**asdict(self.options.victim), "limit": limit}
        job = self.steps.trained_on(pictures, self.options.seed, training, clean, **limits)
        return self._made(f"training on {on}", job)

    def _defended(self, defence: Defence, splat: str, pictures: Job, clean: Job) -> tuple[Job, Job]:
        """The training of a victim that defends itself, and the job that has what is left in the end."""
        inputs = {"pictures": pictures.part(PICTURES)}
        if defence.filter is not None:
            config = PoisonedConfig(poison=defence.filter, background=self.options.scene.background)
            filtering = Job(kind=POISONED_KIND, config=config, inputs=inputs)
            shown = self._made(f"filtering {splat} pictures", filtering)
            trained = self._trained(f"filtered {splat} pictures", shown)
            return trained, trained
        if defence.limit is not None:
            trained = self._trained(f"{splat} pictures, limited", pictures, clean=clean, limit=defence.limit)
            return trained, trained
        trained = self._trained(f"{splat} pictures", pictures)
        inputs["splat"] = trained.part(SPLAT)
        pruned = CleanedConfig(prune=defence.prune, near=self.steps.setup.near)
        job = Job(kind="attacks.cloak.cleaning", config=pruned, inputs=inputs)
        return trained, self._made(f"pruning the {splat} splat", job)

    def _measured(self, splat: str, finished: Job, *, trained: Job, defended: bool = False) -> TrainedVictim:
        cameras = self.steps.setup.held_out_cameras
        true = self._made("taking pictures to compare with", self.steps.true_pictures(cameras))
        device, poses = self.options.victim.device, tuple(map(Pose.of, cameras))
        config = MeasuredConfig(**self.steps.splat_job(), poses=poses, device=device)
        inputs = {"splat": finished.part(SPLAT), "pictures": true.part("*.png")}
        label = f"measuring the {splat} splat{', defended' * defended}"
        job = self._made(label, Job(kind="attacks.poisons.measured", config=config, inputs=inputs))
        looks = list(self._looks(splat, finished, defended=defended))
        return TrainedVictim(splat=splat, defended=defended, trained=trained, measured=job, looks=looks)
