"""A study as jobs: which steps it has, what each depends on, and which are shared with
other studies.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import polars as pl

from attacks.cloak.config import (
    AttackConfig,
    EvaluationConfig,
    SceneConfig,
    StudyConfig,
    TrainingConfig,
    switching,
)
from attacks.cloak.kinds.pictures import APPEARANCE, PicturesConfig
from attacks.cloak.kinds.robust import RobustConfig
from attacks.cloak.kinds.seen import WEIGHTS, SeenConfig
from attacks.cloak.kinds.trained import TrainedConfig
from attacks.cloak.layers import LayeredConfig
from attacks.cloak.setup import OBJECT, SET, Pose, Setup, input_name
from attacks.detectors.base import Detector
from attacks.observe.conditions import SunTable, package_of
from attacks.observe.rows import ATTACKED, CLEAN, SUFFIX, TABLES, read_rows
from attacks.poisons.poisoned import CLOAK, PoisonedConfig
from attacks.poisons.specs import ChosenPoison
from mi_splat.cameras.camera import Camera
from mi_splat.capture.objects import object_file
from mi_splat.ledger import Done, Job, Part
from mi_splat.training.resume import SPLAT

_KINDS = "attacks.cloak.kinds"
POISONED_KIND = "attacks.poisons.poisoned"
PICTURES = f"{SET}/*"
"""The set of a job that leaves one."""
CLOAKED = "cloaked"
"""What files call the attacked splat."""
ROW_NAMES = {CLEAN: CLEAN, CLOAKED: ATTACKED}
"""Splats as the steps call them, and as rows do."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Look:
    """A job that leaves tables of what is seen."""

    label: str
    job: Job
    splat: str
    seed: int
    condition: str = ""  # how, as rows call it; empty: as the victim does

    def tables(self, done: Done) -> dict[str, pl.DataFrame]:
        """Tables of the job by their names, whose rows say what they are of."""
        files = {name: done.folder / f"{name}{SUFFIX}" for name in TABLES}
        ids = {"splat": pl.lit(self.splat), "seed": pl.lit(self.seed, dtype=pl.Int64)}
        ids |= {"condition": pl.lit(self.condition)} if self.condition else {}
        return {
            name: read_rows(file).with_columns(**ids)
            for name, file in files.items()
            if file.is_file()
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class StudySteps:
    """The jobs of a study."""

    study: StudyConfig
    weights: Mapping[str, Path] = field(default_factory=dict)

    @cached_property
    def setup(self) -> Setup:
        """What the study describes."""
        return Setup.of(self.study)

    # a study is planned once, and its steps live as long as the process
    @cache  # noqa: B019
    def pictures(self) -> Job:
        """The victim's images of the scene."""
        return self._job(
            "pictures",
            PicturesConfig(**self._parts(background=SceneConfig().background)),
        )

    def appearance(self, attack: AttackConfig) -> Job:
        """Images of what an attack wants to be seen, from the training cameras in its
        region.
        """
        cameras = self.setup.training_cameras
        held = attack.region(self.study.attack).holds(cameras, centre=self.study.centre)
        inside = [cameras[index] for index in held.nonzero().flatten().tolist()]
        return self._pictured(inside, (attack,), set=self.pictures().part(PICTURES))

    def true_pictures(
        self, cameras: Sequence[Camera], attack: AttackConfig | None = None
    ) -> Job:
        """Path-traced images from cameras that no training used; with an attack, of
        the object as it shows it.
        """
        return self._pictured(cameras, () if attack is None else (attack,))

    def _pictured(
        self, cameras: Sequence[Camera], attacks: Sequence[AttackConfig], **inputs: Part
    ) -> Job:
        parts = self._parts(attacks=tuple(map(_shown, attacks)))
        if attacks and not inputs:
            inputs = {"plain": self._pictured(cameras, ()).part("*.png")}
        files: dict[str, Path] = {}
        for attack in attacks:
            files |= _files(attack, _shown(attack).name)
        config = PicturesConfig(**parts, poses=tuple(map(Pose.of, cameras)))
        return self._job("pictures", config, **inputs, **files)

    @cache  # noqa: B019
    def poisoned(self, seed: int) -> Job:
        """A poisoned set."""
        study = self.study
        attacks = []
        files = dict(self.object_input)
        for attack in study.attack:
            attacks.append(asdict(replace(_portable(attack), target_class=None)))
            files |= _files(attack, attack.name)
        chosen = ChosenPoison(kind=CLOAK, settings={"attack": attacks})
        drawn = self._drawn(seed)
        scene = self.scene_job()
        poison = PoisonedConfig(
            poison=chosen, background=study.scene.background, scene=scene, seed=drawn
        )
        inputs: dict[str, Part | Path] = {
            "pictures": self.pictures().part(PICTURES),
            **self._appearances,
            **files,
        }
        return Job(kind=POISONED_KIND, config=poison, inputs=inputs)

    @cached_property
    def _appearances(self) -> dict[str, Part]:
        """Images of what each attack wants to be seen."""
        return {
            f"{APPEARANCE}{attack.name}": self.appearance(attack).part("*.png")
            for attack in self.study.attack
        }

    def splat(self, splat: str, seed: int) -> Job:
        """Training of a splat of a seed, clean or cloaked; layers change the clean
        splat's file instead.
        """
        clean = self.trained_on(self.pictures(), seed)
        if splat == CLEAN:
            return clean
        poisoned = self.poisoned(seed)
        layers = self.study.layers
        if layers is None:
            return self.trained_on(poisoned, seed, robust=self.study.robust)
        shown = [
            attack for attack in self.study.attack if attack.name in layers.attacks
        ]
        cones = tuple(replace(_cone(attack), target_class=None) for attack in shown)
        config = LayeredConfig(
            **self._parts(attacks=cones),
            layers=layers,
            seed=seed,
            near_plane=self.setup.near,
        )
        inputs: dict[str, Part | Path] = {
            "clean": clean.part(SPLAT),
            "pictures": poisoned.part(PICTURES),
            **self.object_input,
        }
        return Job(kind="attacks.cloak.layers", config=config, inputs=inputs)

    def trained_on(
        self,
        pictures: Job,
        seed: int,
        training: TrainingConfig | None = None,
        clean: Job | None = None,
        robust: bool = False,
        **limits: Any,
    ) -> Job:
        """A training, which knows nothing of the scene but its images; limits are
        those of `TrainedConfig`. A robust one leaves out images that the audit names.
        """
        recipe = replace(training or self.study.training, near=None)
        kind = "trained"
        made: type[TrainedConfig] = TrainedConfig
        if robust:
            kind = "robust"
            made = RobustConfig
        config = made(**self.splat_job(), training=recipe, seed=seed, **limits)
        inputs = {
            "pictures": pictures.part(PICTURES),
            **({} if clean is None else {"clean": clean.part(SPLAT)}),
        }
        return Job(kind=f"{_KINDS}.{kind}", config=config, inputs=inputs)

    def seen(
        self,
        splat: Job,
        detector: Detector,
        *,
        condition: str = "",
        every: int = 1,
        sun: SunTable | None = None,
        training: bool = False,
        **street: Path,
    ) -> Job:
        """What a detector reports on a splat, or in images, from every N-th held-out
        or training camera.
        """
        evaluation = self.study.evaluation
        regions = map(_region, self.study.attack)
        is_splat = splat.kind not in (f"{_KINDS}.pictures", POISONED_KIND)
        pictures = PICTURES if training else "*.png"
        if is_splat:
            shown = {"splat": splat.part(SPLAT)}
        else:
            shown = {"pictures": splat.part(pictures)}
        return self._seen(
            detector,
            regions,
            {**shown, **street},
            evaluation=EvaluationConfig(
                cameras=evaluation.cameras,
                seed=evaluation.seed,
                min_separation=evaluation.min_separation,
            ),
            training=training,
            every=every,
            condition=condition,
            package=package_of(condition),
            sun=sun,
            layers=None if sun is None else self.study.layers,
        )

    def seen_along_path(self, splat: Job, detector: Detector) -> Job:
        """What a detector reports on a splat from the path over the object."""
        return self._seen(
            detector,
            map(_region, self.study.attack),
            {"splat": splat.part(SPLAT)},
            path=True,
        )

    def _seen(
        self,
        detector: Detector,
        regions: Iterable[AttackConfig],
        inputs: Mapping[str, Part | Path],
        **how: Any,
    ) -> Job:
        """What a detector reports; the file of its weights is an input where they are
        not the usual ones.
        """
        parts = {
            **self._parts(attacks=tuple(regions)),
            "label": self.study.scene.class_name,
            "near_plane": self.setup.near,
        }
        config = SeenConfig(
            detector=detector.name, fingerprint=detector.fingerprint, **parts, **how
        )
        if detector.name in self.weights:
            weights = {WEIGHTS: self.weights[detector.name]}
        else:
            weights = {}
        return self._job("seen", config, **inputs, **weights)

    def _drawn(self, seed: int) -> int:
        """The seed, where it draws which cameras are poisoned; else 0."""
        if any(attack.poison_fraction < 1 for attack in self.study.attack):
            return seed
        return 0

    def compared(self, splat: Job) -> Job:
        """How true a splat's images are."""
        study, setup, attack = self.study, self.setup, switching(self.study.attack)
        usual = {
            key: getattr(EvaluationConfig(), key) for key in ("detectors", "confidence")
        }
        evaluation = replace(study.evaluation, **usual)
        config = self.scene_job(
            attacks=tuple(map(_cone, study.attack)),
            near_plane=setup.near,
            evaluation=evaluation,
        )
        numbered = {"far": setup.reference_cameras, "edge": setup.edge_cameras}
        true = {
            name: self.true_pictures([camera for _, camera in cameras])
            for name, cameras in numbered.items()
        }
        if attack is not None:
            arc = [camera for _, camera in setup.arc_cameras]
            true |= {
                "benign": self.true_pictures(arc),
                "hidden": self.true_pictures(arc, attack),
            }
        pictures = {name: job.part("*.png") for name, job in true.items()}
        return self._job("compared", config, splat=splat.part(SPLAT), **pictures)

    def made(self) -> Iterator[tuple[str, Job]]:
        """Every job up to the splats, in the order of the study, and what is told of it
        while it runs.
        """
        yield "taking the victim's images", self.pictures()
        for attack in self.study.attack:
            yield f"taking images of {attack.name}", self.appearance(attack)
        for seed in self.study.seeds:
            yield f"poisoning, seed {seed}", self.poisoned(seed)
        for splat, seed in self.names():
            yield f"training the {splat} splat, seed {seed}", self.splat(splat, seed)

    def looked(self, detectors: Sequence[Detector]) -> Iterator[Look]:
        """The jobs of those who look at the splats, and at path-traced images if the
        study asks for them.
        """
        for splat, seed in self.names():
            job = self.splat(splat, seed)
            what = f"the {splat} splat, seed {seed}"
            name = ROW_NAMES[splat]
            for detector in detectors:
                label = f"{detector.name} looks at {what}"
                yield Look(
                    label=label, job=self.seen(job, detector), splat=name, seed=seed
                )
                if seed == self.study.seeds[0]:
                    along = self.seen_along_path(job, detector)
                    yield Look(
                        label=f"{label} along a path", job=along, splat=name, seed=seed
                    )
            yield Look(
                label=f"comparing {what}", job=self.compared(job), splat=name, seed=seed
            )

    def names(self) -> list[tuple[str, int]]:
        """Name and seed of every splat."""
        return [
            (splat, seed) for seed in self.study.seeds for splat in (CLEAN, CLOAKED)
        ]

    def splat_job(self) -> dict[str, Any]:
        """What a training depends on, or what renders its splat."""
        return {"background": self.study.scene.background, "near": self.setup.near}

    def _parts(
        self, *, attacks: tuple[AttackConfig, ...] = (), **scene: Any
    ) -> dict[str, Any]:
        """What the jobs share that know the scene."""
        name = self.object_input[OBJECT].stem
        return {
            "scene": replace(self.study.scene, object=name, label=None, **scene),
            "cameras": self.study.cameras,
            "attacks": attacks,
        }

    @cached_property
    def object_input(self) -> dict[str, Path]:
        """The mesh file of the object, an input of jobs that know the scene."""
        return {OBJECT: object_file(self.study.scene.object, "scene.object")}

    def scene_job(
        self, *, attacks: tuple[AttackConfig, ...] = (), **parts: Any
    ) -> Setup:
        """A job that knows the scene."""
        return Setup(**self._parts(attacks=attacks), **parts)

    def _job(self, kind: str, config: Setup, **inputs: Job | Part | Path) -> Job:
        """A job that knows the scene."""
        everything = {**self.object_input, **inputs}
        return Job(kind=f"{_KINDS}.{kind}", config=config, inputs=everything)


def _files(attack: AttackConfig, name: str) -> dict[str, Path]:
    """What an attack reads, as inputs of a job that calls it `name`."""
    return {input_name(field, name): file for field, file in attack.files.items()}


def _portable(attack: AttackConfig) -> AttackConfig:
    """An attack whose files are called by their names, wherever they are."""
    return attack.reading({field: file.stem for field, file in attack.files.items()})


@cache
def _shown(attack: AttackConfig) -> AttackConfig:
    """What counts of an attack for its images."""
    plain = replace(_portable(attack), poison_margin=0.0, poison_fraction=1.0)
    return replace(plain, name="", target_class=None)


@cache
def _cone(attack: AttackConfig) -> AttackConfig:
    """An attack reduced to its name, its cone, and the class that it wants, if any."""
    kept = {
        key: getattr(attack, key)
        for key in ("name", "elevation", "azimuth", "target_class")
    }
    return AttackConfig(**kept)


@cache
def _region(attack: AttackConfig) -> AttackConfig:
    """What counts of an attack where splats are looked at."""
    return replace(_cone(attack), poison_margin=attack.poison_margin)
