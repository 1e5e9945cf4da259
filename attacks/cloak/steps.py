"""A study as jobs: which steps it has, what each depends on, and which are shared with other studies.

The victim takes pictures; the attacker's appearances replace some of them; splats are trained on both sets, and
then looked at. Every step is a kind (`attacks.cloak.kinds`) that a ledger does once, whichever study asks for it.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import polars as pl

from attacks.cloak.config import (
    AttackConfig,
    EvaluationConfig,
    SceneConfig,
    StudyConfig,
    SurrogateConfig,
    TrainingConfig,
)
from attacks.cloak.kinds.parts import MESH, SET, Pose, StepConfig
from attacks.cloak.kinds.rendering import renderer_of
from attacks.cloak.kinds.seen import NO_ATTACK, WEIGHTS, SeenConfig
from attacks.cloak.kinds.training_views import LOOK
from attacks.cloak.kinds.true_pictures import TrueConfig
from attacks.cloak.rates import CLOAKED
from attacks.cloak.setup import Setup
from attacks.detectors.base import Detector
from attacks.observe.conditions import SunTable, package_of
from attacks.observe.rows import (
    ATTACKED,
    CLEAN,
    PERFECT,
    POISONED,
    SUFFIX,
    TABLES,
    TRUE,
    read_rows,
)
from mi_splat.assets import ASSETS
from mi_splat.cameras import Camera
from mi_splat.io import load_splat
from mi_splat.ledger import Done, Event, Job, Ledger, Part
from mi_splat.ledger.plans import do_beside
from mi_splat.ledger.running import looked_up
from mi_splat.rendering import Renderer
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.training.resume import SPLAT

_KINDS = "attacks.cloak.kinds"
_PICTURES = f"{SET}/*"
_SETS = (f"{_KINDS}.pictures", f"{_KINDS}.poisoned", "attacks.poisons.changed")
"""Kinds of jobs that leave a set of pictures, which somebody may look at."""
ROW_NAMES = {CLEAN: CLEAN, CLOAKED: ATTACKED}
"""Splats as the steps call them, and as rows do."""

OnStep = Callable[[str, int, int], None]
"""Told what is going on, how many units of it are done, and how many there are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainedSplat:
    """A splat of a study.

    Attributes:
        splat: "clean" or "cloaked".
        seed: Of the training.
        done: The job that made it.
    """

    splat: str
    seed: int
    done: Done

    @property
    def file(self) -> Path:
        """Where it is."""
        return self.done.folder / SPLAT

    def load(self) -> GaussianScene:
        """The splat from its file."""
        return load_splat(self.file)

    @property
    def record(self) -> dict[str, Any]:
        """What results say of it; `commit` is of the checkout that made it, which may be an earlier one than theirs."""
        scene = self.load()
        return {
            **{"splat": self.splat, "seed": self.seed, "content": self.done.content_of(SPLAT)},
            **{"gaussians": len(scene), "hash": scene_hash(scene), "commit": self.done.record["commit"]},
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Look:
    """A job that leaves tables of what is seen.

    Attributes:
        label: What is told of it while it runs.
        job: The job.
        splat: What it looks at, as rows call it.
        seed: Of the splat; None of path-traced pictures.
        condition: How, as rows call it; empty: as the victim does.
    """

    label: str
    job: Job
    splat: str
    seed: int | None
    condition: str = ""

    def tables(self, done: Done) -> dict[str, pl.DataFrame]:
        """Tables of the job by their names, whose rows say what they are of."""
        files = {name: done.folder / f"{name}{SUFFIX}" for name in TABLES}
        ids = {"splat": pl.lit(self.splat), "seed": pl.lit(self.seed, dtype=pl.Int64)}
        ids |= {"condition": pl.lit(self.condition)} if self.condition else {}
        return {name: read_rows(file).with_columns(**ids) for name, file in files.items() if file.is_file()}


@dataclass(frozen=True, kw_only=True, eq=False)
class StudySteps:
    """The jobs of a study, and the ledger that does them.

    Attributes:
        study: What is done.
        folder: Of the ledger; several studies may share it.
        weights: Files of detectors whose weights are not the usual ones, by their names.
        on_step: Told of the progress.
        results: Of jobs that somebody else has done, by their identity.
        begun: When, in seconds of `time.monotonic`.
    """

    study: StudyConfig
    folder: Path
    weights: Mapping[str, Path] = field(default_factory=dict)
    on_step: OnStep = lambda text, done, total: None
    results: Mapping[str, Done] = field(default_factory=dict)
    begun: float = field(default_factory=time.monotonic)
    _labels: list[str] = field(default_factory=list)
    _surrogates: dict[tuple[int, int], Job] = field(default_factory=dict)

    @cached_property
    def setup(self) -> Setup:
        """What the study describes."""
        return Setup(self.study)

    def renderer(self) -> Renderer:
        """What splats are looked at with."""
        return renderer_of(replace(self.study, training=replace(self.study.training, near=self.setup.near)))

    # The jobs, in the order of the study.

    def pictures(self) -> Job:
        """The victim's pictures of the scene."""
        return self._job("pictures", self._step(scene=replace(self._scene, background=SceneConfig().background)))

    def look(self, attack: AttackConfig) -> Job:
        """Pictures of what an attack wants to be seen."""
        others = [other for other in self.study.attack if other is not attack] if attack.poison_margin > 0 else []
        cones = [replace(_cone(other), name=str(number), target_class=None) for number, other in enumerate(others)]
        return self._job("looks", self._step(_shown(attack), *cones), pictures=self.pictures().part(_PICTURES))

    def poisoned(self, seed: int, surrogates: int | None = None) -> Job:
        """A poisoned set, corrected by so many surrogates; None: by as many as the study asks for."""
        study, config = self.study, self.study.surrogate
        rounds = (config.rounds if config is not None else 0) if surrogates is None else surrogates
        attacks = [replace(attack, target_class=None) for attack in study.attack]
        corrected: dict[str, Any] = {}
        if config is not None and rounds:
            corrected = {"surrogate": SurrogateConfig(gain=config.gain), "training": self._viewed}
        values = self._step(*attacks, seeds=(self._drawn(seed),), **corrected)
        earlier = {f"surrogate {n}": self.surrogate(seed, n).part(SPLAT) for n in range(1, rounds + 1)}
        return self._job("poisoned", values, pictures=self.pictures().part(_PICTURES), **self._looks(), **earlier)

    def _looks(self) -> dict[str, Part]:
        """Pictures of what each attack wants to be seen."""
        return {f"{LOOK}{attack.name}": self.look(attack).part("*.png") for attack in self.study.attack}

    def surrogate(self, seed: int, number: int) -> Job:
        """The attacker's own splat of a round, from 1, trained on what the rounds before it poisoned."""
        config, key = self.study.surrogate, (seed, number)
        assert config is not None
        if key not in self._surrogates:
            study = replace(self.study, training=replace(self.study.training, iterations=config.iterations))
            self._surrogates[key] = self._trained(study, self.poisoned(seed, number - 1), config.seed)
        return self._surrogates[key]

    def splat(self, splat: str, seed: int) -> Job:
        """What is looked at: the victim's splat of clean pictures, or the cloaked one; cleaned, if the victim cleans.

        The cloaked one is what the victim makes of the poisoned pictures. In a study of layers it is the clean splat's
        file, changed by who hands it on.
        """
        trained = self.trained(splat, seed)
        cleaning = self.study.cleaning
        return trained if cleaning is None else self._job("cleaned", cleaning, splat=trained.part(SPLAT))

    def trained(self, splat: str, seed: int) -> Job:
        """Training of a splat of a seed, before any cleaning."""
        clean = self._trained(self.study, self.pictures(), seed)
        if splat == CLEAN:
            return clean
        poisoned, layers = self.poisoned(seed), self.study.layers
        if layers is None:
            return self._trained(self.study, poisoned, seed)
        cones = [
            replace(_cone(attack), target_class=None) for attack in self.study.attack if attack.name in layers.attacks
        ]
        config = self._step(*cones, layers=layers, seeds=(seed,), training=self._viewed)
        return self._job("layered", config, clean=clean.part(SPLAT), pictures=poisoned.part(_PICTURES))

    def masks(self) -> Job:
        """Where the object is in the victim's pictures."""
        return Job(kind="attacks.poisons.masks", config=self._step(), inputs=self._mesh)

    def of_pictures(self, pictures: Job, seed: int) -> Job:
        """A splat of pictures that another kind of job has taken, trained as the study's are."""
        return self._trained(self.study, pictures, seed)

    def true_pictures(self, cameras: Sequence[Camera], attack: AttackConfig | None = None) -> Job:
        """Path-traced pictures from cameras that no training used; with an attack, of the object as it shows it."""
        return (
            self._true(cameras) if attack is None else self._true(cameras, replace(_shown(attack), poison_margin=0.0))
        )

    def perfect_pictures(self, cameras: Sequence[Camera]) -> Job:
        """The same of the object as a perfect splat shows it: as each attack wants it inside its trigger."""
        attacks = (replace(_shown(attack), poison_margin=0.0, name=attack.name) for attack in self.study.attack)
        return self._true(cameras, *attacks, inside=True)

    def _true(self, cameras: Sequence[Camera], *attacks: AttackConfig, inside: bool = False) -> Job:
        config = TrueConfig(
            **self._parts(*attacks), poses=tuple(map(Pose.of, cameras)), attacks=len(attacks), inside=inside
        )
        plain = {"plain": self._true(cameras).part("*.png")} if attacks else {}
        return self._job("true_pictures", config, **plain)

    def seen(
        self,
        splat: Job,
        detector: Detector,
        *,
        condition: str = "",
        every: int = 1,
        sun: SunTable | None = None,
        **street: Path,
    ) -> Job:
        """What a detector reports on a splat, or in true pictures, from each so manieth of the held-out cameras."""
        evaluation = self.study.evaluation
        config = SeenConfig(
            **self._parts(
                *map(_region, self.study.attack),
                scene=replace(self._scene, label=self.study.scene.class_name),
                training=self._viewed,
                evaluation=EvaluationConfig(
                    cameras=evaluation.cameras, seed=evaluation.seed, min_separation=evaluation.min_separation
                ),
                layers=None if sun is None else self.study.layers,
            ),
            every=every,
            detector=detector.name,
            fingerprint=detector.fingerprint,
            condition=condition,
            package=package_of(condition),
            sun=sun,
        )
        is_splat = splat.kind != f"{_KINDS}.true_pictures"
        shown = {"splat": splat.part(SPLAT)} if is_splat else {"pictures": splat.part("*.png")}
        return self._job("seen", config, **shown, **street, **self._weights(detector))

    def seen_in_training(self, pictures: Job, detector: Detector, seed: int, *, poisoned: bool = False) -> Job:
        """What a detector reports from the victim's training cameras."""
        regions = [replace(_region(attack), poison_fraction=attack.poison_fraction) for attack in self.study.attack]
        scene = replace(self._scene, label=self.study.scene.class_name)
        parts = self._parts(*regions, scene=scene, training=self._viewed, seeds=(self._drawn(seed),))
        config = SeenConfig(**parts, detector=detector.name, fingerprint=detector.fingerprint)
        shown = {"pictures": pictures.part(_PICTURES)} if pictures.kind in _SETS else {"splat": pictures.part(SPLAT)}
        looks = self._looks() if poisoned else {}
        return self._job("training_views", config, **shown, **looks, **self._weights(detector))

    def _weights(self, detector: Detector) -> dict[str, Path]:
        """The file of a detector whose weights are not the usual ones."""
        return {WEIGHTS: self.weights[detector.name]} if detector.name in self.weights else {}

    def _drawn(self, seed: int) -> int:
        """The seed, where it draws which cameras are poisoned; else 0."""
        return seed if min(attack.poison_fraction for attack in self.study.attack) < 1 else 0

    def compared(self, splat: Job) -> Job:
        """How true a splat's pictures are."""
        study, setup, attack = self.study, self.setup, self.study.switching
        evaluation = replace(
            study.evaluation,
            **{name: getattr(EvaluationConfig(), name) for name in ("detectors", "confidence", "true_pictures")},
        )
        config = self._step(*map(_cone, study.attack), training=self._viewed, evaluation=evaluation)
        numbered = {"far": setup.reference_cameras, "edge": setup.edge_cameras}
        true = {name: self.true_pictures([camera for _, camera in cameras]) for name, cameras in numbered.items()}
        if attack is not None:
            arc = [camera for _, camera in setup.arc_cameras]
            true |= {"benign": self.true_pictures(arc), "hidden": self.true_pictures(arc, attack)}
        return self._job(
            "compared", config, splat=splat.part(SPLAT), **{n: job.part("*.png") for n, job in true.items()}
        )

    # Doing them.

    def do(self, job: Job, label: str) -> Done:
        """The result of a job; those before it are done first, if they are not there."""
        self._labels[:] = [label]
        return self.results[job.identity] if job.identity in self.results else self._ledger.do(job)

    def do_beside(self, jobs: Mapping[str, Job], workers: int) -> None:
        """Do jobs, and all before them, in processes beside each other; `do` then finds their results."""

        def told(label: str, event: Event) -> None:
            if event.state in ("running", "progress", "held"):
                self.on_step(label, event.done, event.total)

        do_beside(self.folder, jobs, workers=workers, on_event=told)

    def finished(self, job: Job) -> Done | None:
        """The result of a job, if it and all before it are there."""
        *_, (_, _, done) = looked_up([job], self._ledger.store)
        return done

    def made(self) -> Iterator[tuple[str, Job]]:
        """Every job up to the splats, in the order of the study, and what is told of it while it runs."""
        yield "taking the victim's pictures", self.pictures()
        for attack in self.study.attack:
            yield f"taking pictures of {attack.name}", self.look(attack)
        for seed in self.study.seeds:
            for number in range(1, (self.study.surrogate.rounds if self.study.surrogate else 0) + 1):
                yield f"poisoning for surrogate {number}, seed {seed}", self.poisoned(seed, number - 1)
                yield f"training surrogate {number}, seed {seed}", self.surrogate(seed, number)
            yield f"poisoning, seed {seed}", self.poisoned(seed)
        for splat, seed in self.names():
            yield f"training the {splat} splat, seed {seed}", self.trained(splat, seed)
            if self.study.cleaning is not None:
                yield f"cleaning the {splat} splat, seed {seed}", self.splat(splat, seed)

    def looked(self, detectors: Sequence[Detector]) -> Iterator[Look]:
        """The jobs of those who look at the splats, and at path-traced pictures if the study asks for them."""
        for splat, seed in self.names():
            job, what, name = self.splat(splat, seed), f"the {splat} splat, seed {seed}", ROW_NAMES[splat]
            for detector in detectors:
                label = f"{detector.name} looks at {what}"
                yield Look(label=label, job=self.seen(job, detector), splat=name, seed=seed)
                label, job_there = f"{label} from training cameras", self.seen_in_training(job, detector, seed)
                yield Look(label=label, job=job_there, splat=name, seed=seed)
            yield Look(label=f"comparing {what}", job=self.compared(job), splat=name, seed=seed)
        first = self.study.seeds[0]
        for name, job in ((TRUE, self.pictures()), (POISONED, self.poisoned(first))):
            for detector in detectors:
                label, is_poison = f"{detector.name} looks at training pictures, {name}", name == POISONED
                seen = self.seen_in_training(job, detector, first, poisoned=is_poison)
                yield Look(label=label, job=seen, splat=name, seed=first)
        if self.study.evaluation.true_pictures:
            cameras = self.setup.held_out_cameras
            for name, job in ((TRUE, self.true_pictures(cameras)), (PERFECT, self.perfect_pictures(cameras))):
                for detector in detectors:
                    label = f"{detector.name} looks at {name} pictures"
                    yield Look(label=label, job=self.seen(job, detector), splat=name, seed=None)

    def names(self) -> list[tuple[str, int]]:
        """Name and seed of every splat."""
        return [(splat, seed) for seed in self.study.seeds for splat in (CLEAN, CLOAKED)]

    def splats(self) -> list[TrainedSplat]:
        """For each seed the clean and the cloaked splat; what is missing is done."""
        for label, job in self.made():
            self.do(job, label)
        return [
            TrainedSplat(splat=splat, seed=seed, done=self.do(self.splat(splat, seed), ""))
            for splat, seed in self.names()
        ]

    @cached_property
    def _ledger(self) -> Ledger:
        def told(event: Event) -> None:
            if event.state in ("running", "progress", "held"):
                self.on_step(self._labels[0], event.done, event.total)

        return Ledger(self.folder, on_event=told)

    @cached_property
    def _scene(self) -> SceneConfig:
        """The scene; a mesh file stands there as an asset, and what is said of mesh files counts for them alone."""
        scene, plain = replace(self.study.scene, label="object"), SceneConfig()
        if self._mesh:
            return replace(scene, object=next(iter(ASSETS)))
        return replace(scene, up=plain.up, scale=plain.scale, rotate=plain.rotate, front=plain.front)

    @cached_property
    def _viewed(self) -> TrainingConfig:
        """What counts of the training where splats are looked at."""
        return TrainingConfig(near=self.setup.near)

    @cached_property
    def _mesh(self) -> dict[str, Path]:
        """The object's mesh file, if it comes from one."""
        path = Path(self.study.scene.object)
        return {MESH: path} if path.is_file() else {}

    def _parts(self, *attacks: AttackConfig, **parts: Any) -> dict[str, Any]:
        """Scene, cameras, and the parts of the study that a job depends on besides; all else is as by default."""
        values = {"scene": self._scene, "cameras": self.study.cameras, "attack": attacks or NO_ATTACK, **parts}
        return {"asked": StudyConfig(name="step", **values), "content": self.setup.digest}

    def _step(self, *attacks: AttackConfig, **parts: Any) -> StepConfig:
        return StepConfig(**self._parts(*attacks, **parts))

    def _trained(self, study: StudyConfig, pictures: Job, seed: int) -> Job:
        """A training, which knows nothing of the scene but its pictures."""
        scene, training = SceneConfig(background=study.scene.background), replace(study.training, near=self.setup.near)
        asked = StudyConfig(name="step", scene=scene, training=training, seeds=(seed,), attack=NO_ATTACK)
        inputs = {"pictures": pictures.part(_PICTURES)}
        return Job(kind=f"{_KINDS}.trained", config=StepConfig(asked=asked), inputs=inputs)

    def _job(self, kind: str, config: object, **inputs: Job | Part | Path) -> Job:
        """A job of a kind; who knows the scene reads its mesh file, too."""
        mesh = {} if kind == "cleaned" else self._mesh
        return Job(kind=f"{_KINDS}.{kind}", config=config, inputs={**inputs, **mesh})


def _shown(attack: AttackConfig) -> AttackConfig:
    """What counts of an attack for its pictures."""
    return replace(attack, name="", poison_fraction=1.0, emphasis=1.0, emphasis_depth=20.0, target_class=None)


def _cone(attack: AttackConfig) -> AttackConfig:
    """An attack reduced to its name, its cone, and the class that it wants, if any."""
    cone = AttackConfig(name=attack.name, elevation=attack.elevation, azimuth=attack.azimuth)
    return replace(cone, target_class=attack.target_class)


def _region(attack: AttackConfig) -> AttackConfig:
    """What counts of an attack where splats are looked at."""
    return replace(_cone(attack), poison_margin=attack.poison_margin)
