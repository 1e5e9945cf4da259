"""Studies of attacks on training pictures: what a victim pays, sees, and can do about it.

Every point takes pictures of a scene, poisons them, and trains a victim on both sets: the clean one is the control.
With a defence both are trained once more: what a defence costs on clean pictures may be more than it saves.

    study = "poison"
    cameras = { size = 128 }
    training = { iterations = 30000, max_gaussians = "none" }
    poison = { kind = "poison-splat", steps = 12000 }

    [matrix]
    seed = [0, 1, 2]
    "poison.eps" = [8, 16, 24]

    [[case]]
    name = "blur"
    defence = { filter = "blur" }

What is not the scene's, the cameras' or the training's stands in `PoisonPoint`.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from attacks.classifiers.base import Classifier
from attacks.classifiers.registry import load_classifier
from attacks.cloak.config import CameraConfig, EvaluationConfig, SceneConfig, StudyConfig, TrainingConfig
from attacks.cloak.kinds.parts import SET, Pose
from attacks.cloak.kinds.seen import NO_ATTACK, SeenConfig, loaded
from attacks.cloak.steps import Look, StudySteps
from attacks.observe.measures import reported
from attacks.observe.rows import ATTACKED, CLEAN, DETECTIONS, FIDELITY, ROWS, SUFFIX, by_camera, frame_of, write_rows
from attacks.poisons.changed import SHEET, ChangedConfig
from attacks.poisons.classified import ClassifiedConfig
from attacks.poisons.config import FilterConfig, FrequencyPruningConfig, MIFGSMConfig
from attacks.poisons.filtered import FilteredConfig
from attacks.poisons.measured import CENTRES, COUNT, SPEED, MeasuredConfig
from attacks.poisons.pruned import PrunedConfig
from attacks.poisons.registry import CloakConfig, PoisonConfig, poison_config
from attacks.poisons.victim import COST, VictimConfig
from attacks.studies.plan import Work
from attacks.studies.poison_figures import figures, summary_tables
from attacks.studies.study_file import Point, Settings, Study, with_none
from attacks.tables import sections
from mi_splat import provenance
from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Checked, Seed, above, check, check_choice, decode
from mi_splat.io.documents import save_json, save_text
from mi_splat.io.folders import RECORD
from mi_splat.io.parsing import read_json
from mi_splat.ledger import Done, Job, Part
from mi_splat.ledger.plans import Result
from mi_splat.training.resume import SPLAT

STORY, STUDY_FILE, TABLE, PICTURES = "poison-study", "study.toml", "table.md", "pictures"
_KINDS = "attacks.poisons"
CLASSIFIED = f"{_KINDS}.classified"
_SEED = "seed"
DEFENDED = "defended"
"""Condition of rows of a splat whose victim defends itself."""
TRAINING, HELD_OUT, PHOTOGRAPH = "training cameras", "held-out cameras", "photograph"
"""Conditions of what is seen of a splat, or of pictures, from the cameras of the training or others."""
_OWN_NAME = "the study"


@dataclass(frozen=True, slots=True, kw_only=True)
class Victim(Checked):
    """What the victim trains on, and can afford; see `attacks.poisons.victim.VictimConfig`."""

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
    poison: PoisonConfig | None = None
    defence: Defence | None = None
    deceive: str = ""
    classifiers: tuple[str, ...] = ()
    detectors: tuple[str, ...] = ()

    def study(self, training: TrainingConfig) -> StudyConfig:
        """Scene, cameras and a training, in which no look is hidden."""
        return StudyConfig(
            name="poison",
            seeds=(self.seed,),
            scene=self.scene,
            cameras=self.cameras,
            training=training,
            evaluation=self.evaluation,
            attack=NO_ATTACK,
        )


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
        masks, who = self._made("drawing masks", self._steps.masks()), self._who(asked.deceive)
        if poison.target is not None:
            others = [name for name in classifier_of(asked.deceive).classes if name != who["label"]]
            check_choice(f"target for {asked.deceive}", poison.target, others)
        inputs = {"pictures": self.pictures.part(f"{SET}/*"), "masks": masks.part("*.png")}
        if poison.decoy_steps:
            inputs["splat"] = self._start(clean)
        step = self._attackers_step if poison.decoy_steps else self._step(TrainingConfig())
        return Job(kind=f"{_KINDS}.changed", config=ChangedConfig(**step, poison=poison, **who), inputs=inputs)

    def _who(self, name: str) -> dict[str, Any]:
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
        step = {**self._step(TrainingConfig()), **self._who(name)}
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


class PoisonWork(Work):
    """The jobs of a study of attacks on training pictures.

    Raises:
        MiSplatError: A setting cannot be; before any job is done.
    """

    def __init__(self, study: Study) -> None:
        self.study = study
        if study.judges or any(point.bisected for point in study.points):
            raise InvalidValueError.of(study.name, "no judge and no bisect", "one", "leave it out")
        self.attempts: list[Attempt] = [Attempt(point, study.name) for point in study.points]

    def write(self, results: Mapping[str, Result], out: Path) -> list[Path]:
        """As in `Work`."""
        labelled = {job.identity: results.get(label) for label, job in self.jobs().items()}
        done = {identity: result for identity, result in labelled.items() if isinstance(result, Done)}
        victims, paths = list[dict[str, Any]](), list[Path]()
        rows: dict[str, list[dict[str, Any]]] = {FIDELITY: [], ROWS: []}
        for attempt in self.attempts:
            for victim in attempt.victims:
                if {victim.trained.identity, victim.measured.identity} <= done.keys():
                    victims.append(_told(attempt, victim, done))
                    for name, of_victim in _rows(attempt, victim, done):
                        rows[name] += of_victim
            paths += _pictures(attempt, done, out / PICTURES)
        tables = {name: by_camera(frame_of(of_table)) for name, of_table in rows.items() if of_table}
        named: dict[str, Any] = {"study": self.study.kind, "name": self.study.name, "question": self.study.question}
        named["seeds"] = sorted({victim["seed"] for victim in victims})
        looks = [look.job.config for attempt in self.attempts for victim in attempt.victims for look in victim.looks]
        named["detectors"] = {one.detector: one.fingerprint for one in looks if isinstance(one, SeenConfig)}
        record = {"story": STORY, **named, "victims": victims, **provenance.origin()}
        record |= figures(record, tables)
        paths += [write_rows(table, out / f"{name}{SUFFIX}") for name, table in tables.items()]
        save_text(sections(summary_tables(record)), out / TABLE)
        save_text(self.study.text, out / STUDY_FILE)
        save_json(record, out / RECORD)
        return [*paths, *(out / name for name in (TABLE, STUDY_FILE, RECORD))]


def point_of(settings: Settings, name: str) -> PoisonPoint:
    """What a point asks for.

    Args:
        settings: As the file has them; "none" stands for None.
        name: Of the study.

    Raises:
        InvalidValueError: A setting is unknown or cannot be.
    """
    values = with_none(settings)
    table = values.pop("poison", None)
    poison = None if table is None else poison_config(table, f"{name}, poison")
    return replace(decode(PoisonPoint, values, name), poison=poison)


def _told(attempt: Attempt, victim: TrainedVictim, done: Mapping[str, Done]) -> dict[str, Any]:
    """What is known of a victim, its rows apart."""
    trained, measured = done[victim.trained.identity], done[victim.measured.identity]
    named = {"part": attempt.part, "value": attempt.value, "seed": attempt.asked.seed, "splat": victim.splat}
    told = {**named, "defended": victim.defended, **read_json(measured.folder / COUNT)}
    return {**told, **read_json(trained.folder / COST), **read_json(measured.folder / SPEED)}


def _rows(
    attempt: Attempt, victim: TrainedVictim, done: Mapping[str, Done]
) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """How true a victim's splat is, and what classifiers take its object for; by the table that they belong to."""
    cells: dict[str, Any] = {"attack": attempt.title, "seed": attempt.asked.seed, "splat": victim.splat}
    condition = DEFENDED if victim.defended else None
    yield FIDELITY, [{**cells, "condition": condition, **row} for row in done[victim.measured.identity].rows]
    for look in victim.looks:
        if look.job.identity in done:
            rows = _seen(look, done[look.job.identity], attempt.asked.evaluation.confidence)
            yield ROWS, [{**cells, "condition": look.condition, **row} for row in rows]


def _seen(look: Look, done: Done, confidence: float) -> Iterable[Mapping[str, Any]]:
    """What was seen, picture by picture; a success is an object that is misread, or reported with less confidence."""
    if look.job.kind == CLASSIFIED:
        return done.rows
    missed = ~reported("original_score", confidence)
    (table,) = (table for name, table in look.tables(done).items() if name != DETECTIONS)
    return table.with_columns(success=missed).iter_rows(named=True)


def _pictures(attempt: Attempt, done: Mapping[str, Done], folder: Path) -> list[Path]:
    """Copy the pictures of a point with seed 0: what was done to the set, and where each splat has its Gaussians."""
    if attempt.asked.seed != 0:
        return []
    shown = {f"{one.splat}{' defended' * one.defended} centres": (one.measured, CENTRES) for one in attempt.victims}
    if attempt.poisoned is not None:
        shown["poisoned"] = (attempt.poisoned, SHEET)
    paths = []
    for name, (job, file) in shown.items():
        if job.identity in done and (done[job.identity].folder / file).is_file():  # CLOAK leaves no sheet
            folder.mkdir(exist_ok=True)
            to = folder / (re.sub(r"[^0-9A-Za-z.]+", "-", f"{attempt.title} {name}") + ".png")
            paths.append(Path(shutil.copyfile(done[job.identity].folder / file, to)))
    return paths
