"""Studies of attacks on training images: what a victim pays, sees, and can do about
it.

Every point takes images of a scene, poisons them, and trains a victim on both sets:
the clean one is the control. With a defence both are trained once more: what a defence
costs on clean images may be more than it saves. Settings are the fields of
`PoisonPoint`; see scenes/studies/poison_splat.toml.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import polars as pl

from attacks.classifiers.base import Classifier
from attacks.classifiers.registry import load_classifier
from attacks.cloak.config import (
    CameraConfig,
    EvaluationConfig,
    SceneConfig,
    StudyConfig,
    TrainingConfig,
)
from attacks.cloak.kinds.seen import SeenConfig, loaded
from attacks.cloak.kinds.trained import COST
from attacks.cloak.setup import Pose
from attacks.cloak.steps import PICTURES as SET_FILES
from attacks.cloak.steps import POISONED_KIND, Look, StudySteps
from attacks.figures.frame import Figures
from attacks.figures.tables import Table
from attacks.observe.observations import camera_cells
from attacks.observe.rates import reported
from attacks.observe.rows import (
    ATTACKED,
    CLEAN,
    DETECTIONS,
    FIDELITY,
    ROWS,
    by_camera,
    frame_of,
)
from attacks.poisons.config import FilterConfig, FrequencyPruningConfig
from attacks.poisons.defences import PrunedConfig
from attacks.poisons.judged import (
    CENTRES,
    COUNT,
    SPEED,
    ClassifiedConfig,
    MeasuredConfig,
)
from attacks.poisons.poisoned import CLOAK, SHEET, PoisonedConfig
from attacks.poisons.specs import ChosenPoison
from attacks.studies.poison_figures import figures, tables
from attacks.studies.running import OWN_NAME, Attempt, Observed, Work, copied, names_of
from attacks.studies.study_file import Point, Settings, Study, with_none
from mi_splat.cameras.camera import Camera
from mi_splat.cameras.directions import direction_of
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Checked, Seed, above, at_least, check, check_choice, decode
from mi_splat.io.parsing import read_json
from mi_splat.ledger import Done, Job, Part
from mi_splat.ledger.plans import Result
from mi_splat.training.resume import SPLAT

JUDGED = "attacks.poisons.judged"
"""Kind of the jobs in which a classifier looks, or a splat is measured."""
DEFENDED = "defended"
"""Condition of rows of a splat whose victim defends itself."""
TRAINING = "training cameras"
HELD_OUT = "held-out cameras"
HIGHER = "higher cameras"
PHOTOGRAPH = "photograph"
"""Conditions of what is seen of a splat, or of images, from the cameras of the
training or others.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Defence(Checked):
    """What a victim does who fears poison; one of these."""

    # of all images before the training, not of those that it is compared with
    filter: FilterConfig | None = None
    # no more than so many
    limit: Annotated[float, above(0, "times the clean splat's Gaussians")] | None = None
    # of Gaussians of the finished splat that are too fine for the cameras
    prune: FrequencyPruningConfig | None = None

    def __post_init__(self) -> None:
        check(self)
        given = [
            name
            for name in ("filter", "limit", "prune")
            if getattr(self, name) is not None
        ]
        if len(given) != 1:
            do = "make each a case of its own"
            raise InvalidValueError.of(
                "defence", "one of filter, limit and prune", given or "none", do
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class PoisonPoint:
    """What a point asks for."""

    seed: Seed = 0  # of the poison, and of both trainings
    scene: SceneConfig = field(default_factory=SceneConfig)
    cameras: CameraConfig = field(default_factory=CameraConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)  # of the victim
    # of the splat that the attacker starts from; None is as the victim's
    attacker: TrainingConfig | None = None
    device: Literal["cpu", "cuda"] = "cpu"  # of its trainings, and of poisons
    # held-out cameras
    evaluation: EvaluationConfig = field(
        default_factory=lambda: EvaluationConfig(cameras=60)
    )
    # classifiers look from so far above, too; 0: they do not
    higher: Annotated[float, at_least(0, "degrees")] = 0.0
    poison: ChosenPoison | None = None  # None leaves the set as it is
    defence: Defence | None = None  # None is nothing
    deceive: str = ""  # the classifier that M-IFGSM deceives
    # that say what the object is, in images and on splats
    classifiers: tuple[str, ...] = ()
    detectors: tuple[str, ...] = ()  # that look for it there

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
    """A point as jobs, which are put together by asking for its victims."""

    part: str
    value: str
    options: PoisonPoint
    jobs: dict[str, Job]

    @classmethod
    def of(cls, point: Point, study: str) -> PoisonAttempt:
        """The jobs of a point."""
        part, value = names_of(point, study, without=("seed",))
        value = point.part if value == OWN_NAME and point.part else value
        options = point_of(point.settings, study)
        attempt = cls(
            point=point,
            title=f"{part}: {value}",
            jobs={},
            part=part,
            value=value,
            options=options,
        )
        _ = attempt.victims
        return attempt

    @cached_property
    def steps(self) -> StudySteps:
        """The steps of CLOAK's studies, of which those without an attack serve here,
        too.
        """
        return StudySteps(study=self.options.study)

    @cached_property
    def pictures(self) -> Job:
        """The clean set."""
        return self._made("taking images", self.steps.pictures())

    @cached_property
    def clean(self) -> Job:
        """The training on it."""
        return self._trained(f"{CLEAN} images", self.pictures)

    @cached_property
    def poisoned(self) -> Job | None:
        """The poisoned set; None without a poison."""
        poison = self.options.poison
        if poison is None:
            return None
        return self._made("poisoning", self._poisoned(poison))

    @cached_property
    def victims(self) -> Sequence[TrainedVictim]:
        """The splats of clean and of poisoned images, and those of a victim that
        defends itself.
        """
        sets = {CLEAN: self.pictures} | (
            {} if self.poisoned is None else {ATTACKED: self.poisoned}
        )
        victims = []
        for splat, pictures in sets.items():
            trained = self._trained(f"{splat} images", pictures)
            victims.append(self._victim(splat, trained, trained))
        if self.options.defence is not None:
            for splat, pictures in sets.items():
                trained, finished = self._defended(
                    self.options.defence, splat, pictures
                )
                victims.append(self._victim(splat, trained, finished, defended=True))
        return victims

    def cameras(self, condition: str) -> Sequence[Camera]:
        """Cameras of a condition, as its rows number them."""
        setup = self.steps.setup
        if condition.startswith(HIGHER):
            raised = tuple(
                elevation + self.options.higher
                for elevation in setup.cameras.elevations
            )
            return replace(
                setup, cameras=replace(setup.cameras, elevations=raised)
            ).training_cameras
        if TRAINING in condition:
            return setup.training_cameras
        return setup.held_out_cameras

    def _made(self, label: str, job: Job) -> Job:
        return self.jobs.setdefault(
            f"{self.title}, seed {self.options.seed} / {label}", job
        )

    def _poisoned(self, poison: ChosenPoison) -> Job:
        """The poisoned set; an attacker who trains otherwise than the victim starts
        from a splat of their own.
        """
        options = self.options
        config = poison.config
        needs = poison.spec.needs
        if poison.kind == CLOAK:
            return replace(
                self.steps, study=replace(options.study, attack=config.attack)
            ).poisoned(options.seed)
        values: dict[str, Any] = {"device": options.device}
        inputs: dict[str, Part | Path] = {"pictures": self.pictures.part(SET_FILES)}
        if "classifier" in needs:
            values |= self._deceived(getattr(config, "target", None))
        if "object" in needs:
            values["scene"] = self.steps.scene_job()
            inputs |= self.steps.object_input
        if "splat" in needs or getattr(config, "decoy_steps", 0) > 0:
            recipe = options.attacker or options.training
            start = self.clean
            if options.attacker is not None:
                start = self._trained(
                    "clean images, by the attacker", self.pictures, options.attacker
                )
            values |= {
                "training": replace(recipe, near=None),
                "near": self.steps.setup.near,
            }
            inputs["splat"] = start.part(SPLAT)
        background = options.scene.background
        poisoning = PoisonedConfig(
            poison=poison, background=background, seed=options.seed, **values
        )
        return Job(kind=POISONED_KIND, config=poisoning, inputs=inputs)

    def _deceived(self, target: str | None) -> dict[str, Any]:
        name = self.options.deceive
        if not name:
            do = 'write deceive = "prototypes"'
            raise InvalidValueError.of(
                self.title, "a classifier that M-IFGSM deceives", "none", do
            )
        classifier = self._classifier_cells(name)
        if target is not None:
            others = [
                known
                for known in classifier_of(name).classes
                if known != classifier["label"]
            ]
            check_choice(f"target for {name}", target, others)
        return classifier

    def _classifier_cells(self, name: str) -> dict[str, Any]:
        """A classifier, which has to know the object's class."""
        label = self.options.scene.class_name
        classifier = classifier_of(name)
        check_choice(f"class for {name}", label, classifier.classes)
        device = self.options.device
        return {
            "classifier": name,
            "fingerprint": classifier.fingerprint,
            "label": label,
            "device": device,
        }

    def _looks(self, splat: str, finished: Job, *, defended: bool) -> Iterator[Look]:
        """Everybody's looks: at a splat from training and held-out cameras, and at
        undefended images of the same.
        """
        places = (TRAINING, HELD_OUT, *((HIGHER,) if self.options.higher else ()))
        shown = dict.fromkeys(places, ("splat", finished))
        pictures = self.pictures if splat == CLEAN else self.poisoned
        if pictures is not None and not defended:
            shown[f"{PHOTOGRAPH}, {TRAINING}"] = ("set", pictures)
        if splat == CLEAN and not defended:
            shown[f"{PHOTOGRAPH}, {HELD_OUT}"] = (
                "pictures",
                self.steps.true_pictures(self.cameras(HELD_OUT)),
            )
        also = f", {DEFENDED}" * defended
        for condition, (what, job) in shown.items():
            looking = {
                name: self._classified(name, what, job, condition)
                for name in self.options.classifiers
            }
            detectors = self.options.detectors if condition != HIGHER else ()
            looking |= {
                name: self._detected(name, job, condition) for name in detectors
            }
            for name, look in looking.items():
                label = f"{name} looks at the {splat} splat{also}, {condition}"
                job = self._made(label, look)
                seed = self.options.seed
                yield Look(
                    label=label,
                    job=job,
                    splat=splat,
                    seed=seed,
                    condition=f"{condition}{also}",
                )

    def _classified(self, name: str, what: str, shown: Job, condition: str) -> Job:
        """What a classifier takes the object for, on a splat from cameras, in a set, or
        in images.
        """
        part = {"splat": SPLAT, "set": SET_FILES, "pictures": "*.png"}[what]
        cells = {**self.steps.splat_job(), **self._classifier_cells(name)}
        cameras = self.cameras(condition) if what == "splat" else ()
        config = ClassifiedConfig(**cells, poses=tuple(map(Pose.of, cameras)))
        return Job(kind=JUDGED, config=config, inputs={what: shown.part(part)})

    def _detected(self, name: str, shown: Job, condition: str) -> Job:
        """What a detector reports, which has to know the object's class."""
        detector = loaded(name)
        check_choice(
            f"class for {name}", self.options.scene.class_name, detector.classes
        )
        return self.steps.seen(shown, detector, training=TRAINING in condition)

    def _trained(
        self,
        on: str,
        pictures: Job,
        training: TrainingConfig | None = None,
        *,
        limit: float | None = None,
    ) -> Job:
        clean = None if limit is None else self.clean
        job = self.steps.trained_on(
            pictures,
            self.options.seed,
            training,
            clean,
            device=self.options.device,
            limit=limit,
        )
        return self._made(f"training on {on}", job)

    def _defended(self, defence: Defence, splat: str, pictures: Job) -> tuple[Job, Job]:
        """The training of a victim that defends itself, and the job that has what is
        left in the end.
        """
        inputs = {"pictures": pictures.part(SET_FILES)}
        if defence.filter is not None:
            config = PoisonedConfig(
                poison=defence.filter, background=self.options.scene.background
            )
            filtering = Job(kind=POISONED_KIND, config=config, inputs=inputs)
            trained = self._trained(
                f"filtered {splat} images",
                self._made(f"filtering {splat} images", filtering),
            )
            return trained, trained
        if defence.limit is not None:
            trained = self._trained(
                f"{splat} images, limited", pictures, limit=defence.limit
            )
            return trained, trained
        trained = self._trained(f"{splat} images", pictures)
        inputs["splat"] = trained.part(SPLAT)
        assert defence.prune is not None
        pruned = PrunedConfig(prune=defence.prune, near=self.steps.setup.near)
        job = Job(kind="attacks.poisons.defences", config=pruned, inputs=inputs)
        return trained, self._made(f"pruning the {splat} splat", job)

    def _victim(
        self, splat: str, trained: Job, finished: Job, *, defended: bool = False
    ) -> TrainedVictim:
        cameras = self.cameras(HELD_OUT)
        true = self._made(
            "taking images to compare with", self.steps.true_pictures(cameras)
        )
        device = self.options.device
        poses = tuple(map(Pose.of, cameras))
        config = MeasuredConfig(**self.steps.splat_job(), poses=poses, device=device)
        inputs = {"splat": finished.part(SPLAT), "pictures": true.part("*.png")}
        label = f"measuring the {splat} splat{', defended' * defended}"
        job = self._made(label, Job(kind=JUDGED, config=config, inputs=inputs))
        looks = list(self._looks(splat, finished, defended=defended))
        return TrainedVictim(
            splat=splat, defended=defended, trained=trained, measured=job, looks=looks
        )


STORY = "poison-study"
PICTURES = "pictures"


class PoisonWork(Work[PoisonAttempt]):
    """Studies of attacks on training images."""

    story = STORY
    has_evaluations = False

    def __init__(self, study: Study) -> None:
        super().__init__(study, map(self.attempt, study.points))

    def attempt(self, point: Point) -> PoisonAttempt:
        """The victims of a point."""
        return PoisonAttempt.of(point, self.study.name)

    def observed(self, results: Mapping[str, Result], out: Path) -> Observed:
        """What each victim has paid, its rows, and images of what was done."""
        done = {
            key: left
            for attempt in self.attempts
            for key, left in attempt.done(results).items()
        }
        victims = list[dict[str, Any]]()
        paths = list[Path]()
        fingerprints = dict[str, str]()
        rows: dict[str, list[dict[str, Any]]] = {FIDELITY: [], ROWS: []}
        for attempt in self.attempts:
            for victim in attempt.victims:
                looks = [look.job.config for look in victim.looks]
                fingerprints |= {
                    seen.detector: seen.fingerprint
                    for seen in looks
                    if isinstance(seen, SeenConfig)
                }
                if {victim.trained.identity, victim.measured.identity} <= done.keys():
                    victims.append(_cost(attempt, victim, done))
                    for name, of_victim in _rows(attempt, victim, done):
                        rows[name] += of_victim
            paths += _pictures(attempt, done, out / PICTURES)
        seeds = sorted({victim["seed"] for victim in victims})
        tables = {
            name: by_camera(frame_of(of_table))
            for name, of_table in rows.items()
            if of_table
        }
        return (
            {"seeds": seeds, "detectors": fingerprints, "victims": victims},
            tables,
            paths,
        )

    def figures(
        self, record: Mapping[str, Any], rows: Mapping[str, pl.DataFrame]
    ) -> Figures:
        """What victims pay, see and lose."""
        return figures(record, rows)

    def tables(self, record: Mapping[str, Any], figures: Figures) -> Iterator[Table]:
        """The tables of costs, and of what is seen."""
        return tables(figures)


def _cost(
    attempt: PoisonAttempt, victim: TrainedVictim, done: Mapping[str, Done]
) -> dict[str, Any]:
    trained = done[victim.trained.identity]
    measured = done[victim.measured.identity]
    named = {
        "part": attempt.part,
        "value": attempt.value,
        "seed": attempt.options.seed,
        "splat": victim.splat,
    }
    counted = {
        **named,
        "defended": victim.defended,
        **read_json(measured.folder / COUNT),
    }
    return {
        **counted,
        **read_json(trained.folder / COST),
        **read_json(measured.folder / SPEED),
    }


def _rows(
    attempt: PoisonAttempt, victim: TrainedVictim, done: Mapping[str, Done]
) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """How true a victim's splat is, and what classifiers take its object for; by the
    table that they belong to.
    """
    cells: dict[str, Any] = {
        "attack": attempt.title,
        "seed": attempt.options.seed,
        "splat": victim.splat,
    }
    condition = DEFENDED if victim.defended else None
    yield (
        FIDELITY,
        [
            {**cells, "condition": condition, **row}
            for row in done[victim.measured.identity].rows
        ],
    )
    for look in victim.looks:
        if look.job.identity in done:
            rows = _seen(attempt, look, done[look.job.identity])
            yield ROWS, [{**cells, "condition": look.condition, **row} for row in rows]


def _seen(
    attempt: PoisonAttempt, look: Look, done: Done
) -> Iterable[Mapping[str, Any]]:
    """What was seen, image by image; a success is an object that is misread, or
    reported with less confidence.
    """
    if look.job.kind == JUDGED:
        cameras = attempt.cameras(look.condition)
        centre = attempt.steps.setup.centre
        cells = [
            camera_cells(camera, None, direction_of(camera, centre))
            for camera in cameras
        ]
        distances = [math.dist(camera.position.tolist(), centre) for camera in cameras]
        return [
            {**row, **cells[row["view"]], "distance": distances[row["view"]]}
            for row in done.rows
        ]
    missed = ~reported("original_score", attempt.options.evaluation.confidence)
    (table,) = (
        table for name, table in look.tables(done).items() if name != DETECTIONS
    )
    return table.with_columns(success=missed).iter_rows(named=True)


def _pictures(
    attempt: PoisonAttempt, done: Mapping[str, Done], folder: Path
) -> list[Path]:
    """Copy the images of a point with seed 0: what was done to the set, and where
    each splat has its Gaussians.
    """
    if attempt.options.seed != 0:
        return []
    shown = {
        f"{victim.splat}{' defended' * victim.defended} centres": (
            victim.measured,
            CENTRES,
        )
        for victim in attempt.victims
    }
    if attempt.poisoned is not None:
        shown["poisoned"] = (attempt.poisoned, SHEET)
    return [
        copied(done[job.identity].folder / file, folder, f"{attempt.title} {name}")
        for name, (job, file) in shown.items()
        # CLOAK leaves no sheet
        if job.identity in done and (done[job.identity].folder / file).is_file()
    ]
