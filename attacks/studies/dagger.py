"""Studies of DAGGER: what their settings mean, and the jobs that they are made of.

`study = "dagger"` attacks an object from some of its scene's cameras, or from those of
a file, `study = "dagger-eot"` from all cameras of a region. Seed 0 looks from the
scene's own cameras and starts at the clean splat; another one turns these cameras about
the object by up to 6 degrees, moves them by up to 5 %, and starts at a random point of
the ball. Cameras of a file stay where they are. In a region the seed draws the views.
With a table `around` (a `CameraCone`), an attack is made for the views around its
camera and for changed images (`images`), and it is evaluated on plain held-out images.

Settings are the fields of `Attack`, and in their place `scene`, `aim`, `target` and
`objective`, `seed`, `cameras` (the path of a file, or a table that is a region), and in
a region `images`, and `evaluation_images` where the evaluation's are others.
[evaluate_with] has those of `AttackEvaluation`.
"""

import dataclasses
import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from attacks.dagger.config import NARROW_CHANGES, REGION, narrow_defaults
from attacks.detectors.registry import DetectorSpec, detector_spec, load_detector
from attacks.figures.frame import Figures
from attacks.figures.tables import Table
from attacks.objectives import OBJECTIVES, PluggedObjective
from attacks.objectives.relabel import Relabel
from attacks.objectives.suppression import Hide, Untargeted
from attacks.observe import Control
from attacks.observe.conditions import OWN, SunTable, package_of
from attacks.observe.rows import ROWS, column_of, frame_of
from attacks.optimisers import OPTIMISERS
from attacks.studies.attack import (
    CAMERAS,
    SPLAT,
    WHOLE_SPLAT,
    Attack,
    check_scene,
    scene_files,
    street_of,
)
from attacks.studies.look import Look
from attacks.studies.result import figures, shared_apart, views_of
from attacks.studies.running import Attempt, Observed, Work, bisection, check_apart
from attacks.studies.study_file import Point, Settings, Study, label_of, with_none
from attacks.studies.tables import tables
from attacks.transformations.config import (
    CameraCone,
    ImageTransformations,
    Transformations,
)
from mi_splat.attributes import ATTRIBUTES
from mi_splat.errors import InvalidValueError
from mi_splat.fields import FieldError, check_choice, decode
from mi_splat.io.folders import RECORD
from mi_splat.io.parsing import read_json
from mi_splat.ledger import Done, Job, Part
from mi_splat.ledger.plans import Plan, Result, grid

ATTACK = "attacks.studies.attack"
LOOK = "attacks.studies.look"
AS_ATTACKED = "as attacked"
"""The condition that is the renderer of the attack."""
_AIMS = {"relabel": Relabel, "hide": Hide, "untargeted": Untargeted}
"""Aims whose settings a table may have; those of other packages have a confidence
alone.
"""
_ELSEWHERE = ("fingerprints", "packages", "transformations", "evaluation")
"""Fields of attacks that are no settings."""
_OF_CAMERAS = ("camera", "views", "renderer", "gradient")
_AROUND = "around"
_OF_REGION = (CAMERAS, "images", "evaluation_images")
"""Settings of attacks from cameras, and from a region, alone."""
_UNBOUND = 1e9
"""A radius that binds nothing."""
STORY = "study"
_NAME_DIGITS = 12
_STATED = (
    *(
        "steps",
        "image_psnr",
        "image",
        "control_psnr",
        "used",
        "used_in_file",
        "changed_gaussians",
        "object_gaussians",
    ),
    *(
        "clamped_fraction",
        "redraws",
        "warnings",
        "seconds",
        "versions",
        "variant",
        "commit",
    ),
    *("evaluations", "cpu_seconds", "loss"),
)
"""What an attack says of itself that does not follow from rows."""
_BRIEFLY = (
    "steps",
    "image_psnr",
    "versions",
    "variant",
    "commit",
    "evaluations",
    "cpu_seconds",
)
"""The same of one of many that differ in the camera alone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AttackEvaluation:
    """How an attacked splat is evaluated: by which detector, and how it is shown."""

    detector: str | None = None  # None is each of those attacked
    condition: str = AS_ATTACKED  # see `attacks.observe.conditions`
    sun: SunTable | None = None  # a street of meshes for conditions that are hours
    # held-out views of a region, at most as many as have evaluated the attack; fixed
    # cameras stay
    views: int = 24
    # random changes beside the attack; see `DaggerConfig`
    controls: tuple[Control, ...] = ("noise",)

    def looks(self, scene: Path, attacked: Job) -> list[Job]:
        """A look by each detector at the splat of an attack."""
        config: Attack = attacked.config
        attack = config.attack
        of = dict[str, Any]()
        if config.transformations is None:
            of = {
                "eps": attack.eps,
                "seed": attack.seed,
                "camera": config.camera,
                "views": config.views,
            }
        else:
            of = {
                "eps": (_UNBOUND,),
                "seed": attack.held_out_seed,
                "sh_degree": attack.sh_degree,
            }
            of |= {
                "views": min(self.views, attack.held_out),
                "camera": config.camera,
                "transformations": config.evaluation or config.transformations,
            }
        splat = SPLAT if config.transformations is None else WHOLE_SPLAT
        renderer = config.renderer
        condition = renderer if self.condition == AS_ATTACKED else self.condition
        sun, street = street_of(condition, self.sun)
        inputs: dict[str, Job | Part | Path] = {
            "attacked": attacked.part(splat),
            **street,
        }
        inputs |= {
            name: path for name, path in attacked.inputs.items() if name == CAMERAS
        }
        of |= {
            "object": config.object,
            "objective": config.objective,
            "condition": condition,
            "sun": sun,
        }
        of |= {"package": package_of(condition), "controls": self.controls}
        of |= {"attributes": attack.attributes, "norm": attack.norm}
        return [
            Job(
                kind=LOOK,
                config=Look(**of, detector=name, fingerprints=fingerprints((name,))),
                inputs={**inputs, **scene_files(scene), **weights((name,))},
            )
            for name in (
                config.detectors if self.detector is None else (self.detector,)
            )
        ]


def attack_of(settings: Settings, where: str, *, region: bool) -> tuple[Path, Job]:
    """The scene and the attack that settings ask for; "none" stands for None."""
    values: dict[str, Any] = with_none(settings)
    names = {entry.name for entry in dataclasses.fields(Attack)} - {
        *_ELSEWHERE,
        *(_OF_CAMERAS if region else ()),
    }
    known = (
        "scene",
        "aim",
        "target",
        "seed",
        *sorted(names),
        *(_OF_REGION if region else (CAMERAS, _AROUND, "images")),
    )
    for key in values:
        check_choice(f"key in {where}", key, known)
    scene = values.pop("scene", None)
    attack = {"seed": values.pop("seed", 0), **values.get("attack", {})}
    if not isinstance(scene, str):
        raise FieldError.of(where, "the key scene", scene or "none", "name an XML file")
    drawn = None if region else values.pop(CAMERAS, None)
    if not isinstance(drawn, str | None):
        raise FieldError.of(
            where, "cameras: a path", drawn, "name a JSON file with cameras"
        )
    if "seed" in values.get("attack", {}):
        raise InvalidValueError.of(
            f"attack in {where}",
            "no seed",
            attack["seed"],
            "write seed above the tables",
        )
    around = dict[str, Any]()
    if region:
        views = {name: values.pop(name) for name in _OF_REGION if name in values}
        drawn_from = views.pop("evaluation_images", None)
        values["transformations"], attack = views, {**REGION, **attack}
        values["evaluation"] = (
            None if drawn_from is None else {**views, "images": drawn_from}
        )
    elif _AROUND in values:
        around = _around(values, where)
        attack = {**narrow_defaults(attack), **attack}
    elif "images" in values:
        raise FieldError.of(where, "around with images", "none", "add it")
    elif attack["seed"] > 0:
        attack["random_start"] = True
    values |= {"attack": attack, "objective": _objective(values, where)}
    config = dataclasses.replace(decode(Attack, values, where), **around)
    for name in config.attack.attributes:
        # what is judged under conditions is looked for where the clean object is
        check_choice(f"{where}, attributes", name, ATTRIBUTES)
    for name in config.detectors if config.objective.label is not None else ():
        check_choice(
            f"target: class of {name}",
            config.objective.label,
            detector_spec(name).classes,
        )
    brought = [
        OPTIMISERS.package(config.attack.optimiser),
        *map(package_of, (config.renderer, config.gradient)),
    ]
    packages = tuple(filter(None, brought))
    config = dataclasses.replace(
        config, fingerprints=fingerprints(config.detectors), packages=packages
    )
    path = Path(scene)
    cameras = None if drawn is None else Path(drawn)
    renderers = (config.renderer, config.gradient)
    check_scene(
        path, config.object, camera=config.camera, cameras=cameras, renderers=renderers
    )
    inputs = {
        **scene_files(path),
        **weights(config.detectors),
        **({} if cameras is None else {CAMERAS: cameras}),
    }
    return path, Job(kind=ATTACK, config=config, inputs=inputs)


def _around(values: dict[str, Any], where: str) -> dict[str, Any]:
    """Where the views around a camera are drawn from, for the search and for the
    evaluation; takes its settings out of the tables.
    """
    cone = decode(CameraCone, values.pop(_AROUND), f"{where}, {_AROUND}")
    table = {**NARROW_CHANGES, **values.pop("images", {})}
    changes = decode(ImageTransformations, table, f"{where}, images")
    drawn = Transformations(cameras=cone, images=changes)
    return {"transformations": drawn, "evaluation": drawn.plain}


def _objective(
    values: dict[str, Any], where: str
) -> Relabel | Hide | Untargeted | PluggedObjective:
    """What the detectors shall see; takes its settings out of the tables."""
    aim = values.pop("aim", "relabel")
    target = values.pop("target", None)
    table = values.pop("objective", {})
    check_choice(f"aim in {where}", aim, tuple(OBJECTIVES))
    if OBJECTIVES[aim].targeted is (target is None):
        if target is None:
            do = "name the class wanted, for instance person"
        else:
            do = "leave it out"
        raise InvalidValueError.of(
            "target", f"what the aim {aim} has", target or "none", do
        )
    label = {} if target is None else {"label": target}
    if aim in _AIMS:
        return decode(_AIMS[aim], {**label, **table}, "objective")
    plugged = decode(PluggedObjective, {"kind": aim, **label, **table}, "objective")
    return dataclasses.replace(plugged, package=OBJECTIVES.package(aim))


def weights(detectors: tuple[str, ...]) -> dict[str, Path]:
    """The files with the weights of detectors, as inputs of a job."""
    files = {}
    for name in detectors:
        spec = detector_spec(name)
        missing = spec.missing()
        if missing:
            raise InvalidValueError.of(
                f"detector {name}", "one that can be loaded", "one that cannot", missing
            )
        if spec.weights is not None:
            files[f"weights {name}"] = spec.weights()
    return files


def fingerprints(detectors: tuple[str, ...]) -> tuple[str, ...]:
    """Fingerprints of those detectors whose weights are in no file."""
    pairs = [(name, detector_spec(name)) for name in detectors]
    return tuple(
        _fingerprint(name, spec) for name, spec in pairs if spec.weights is None
    )


@functools.lru_cache(maxsize=64)
def _fingerprint(name: str, spec: DetectorSpec) -> str:
    """The fingerprint of a detector, which is loaded once for all attempts of a
    study.
    """
    return load_detector(name).fingerprint


@dataclass(frozen=True, kw_only=True, eq=False)
class DaggerAttempt(Attempt):
    """An attack as jobs."""

    job: Job
    looks: Mapping[str, Job]


class DaggerWork(Work[DaggerAttempt]):
    """Attacks, and the looks at each."""

    story = STORY
    can_bisect = True

    def __init__(self, study: Study) -> None:
        _fingerprint.cache_clear()  # weights may be others by now
        super().__init__(study, map(self.attempt, study.points))
        searches: dict[Any, list[DaggerAttempt]] = {}
        for attempt in self.attempts:
            bisected = attempt.point.bisected
            if bisected:
                alike = [
                    label
                    for label in attempt.point.labels.items()
                    if label[0] != bisected
                ]
                searches.setdefault((attempt.point.part, *alike), []).append(attempt)
        self.searches = list(searches.values())
        if not self.attempts:
            raise InvalidValueError.of(
                study.name, "something to do", "nothing", "add settings"
            )

    def attempt(self, point: Point) -> DaggerAttempt:
        """An attack, and the looks at it."""
        name = self.study.name
        region = self.study.kind == "dagger-eot"
        scene, job = attack_of(
            point.settings,
            f"{name}, {point.part}" if point.part else name,
            region=region,
        )
        label = ": ".join(filter(None, (point.part, _named(point.labels)))) or name
        looks = dict[str, Job]()
        where = f"{name}, evaluate_with"
        for way in self.study.evaluations:
            for look in decode(AttackEvaluation, with_none(way.settings), where).looks(
                scene, job
            ):
                looks[
                    f"{label} /"
                    f" {_named({**way.labels, 'detector': look.config.detector})}"
                ] = look
        configs = [look.config for look in looks.values()]
        check_apart(
            where, (f"{look.detector}, {look.condition or OWN}" for look in configs)
        )
        return DaggerAttempt(
            title=label, point=point, jobs={label: job, **looks}, job=job, looks=looks
        )

    def plans(self) -> list[Plan]:
        """One plan of all points that are known, and one for each search."""
        known = [
            attempt.jobs for attempt in self.attempts if not attempt.point.bisected
        ]
        if known:
            fixed = [
                grid({label: job for jobs in known for label, job in jobs.items()})
            ]
        else:
            fixed = []
        return [
            *fixed,
            *(bisection(search, self._suffices) for search in self.searches),
        ]

    def _suffices(
        self, attempt: DaggerAttempt, results: Mapping[str, Result]
    ) -> bool | None:
        """Whether an attack has its aim; None if it has failed."""
        result = results.get(attempt.title)
        if isinstance(result, Done):
            return bool(_record_of(result)["success"])
        return None

    def observed(self, results: Mapping[str, Result], out: Path) -> Observed:
        """What each attack says of itself, and one table of all rows."""
        rows = list[dict[str, Any]]()
        attacks = dict[str, dict[str, Any]]()
        marks = dict[str, str]()
        for attempt in self.attempts:
            if not isinstance(result := results.get(attempt.title), Done):
                continue
            record = _record_of(result)
            config = attempt.job.config
            marks |= {
                told["detector"]: told["detector_fingerprint"]
                for told in record["detectors"]
            }
            name = result.key[:_NAME_DIGITS]
            # an attack that several parts have
            count = sum(key.startswith(name) for key in attacks)
            if count:
                name = f"{name}-{count + 1}"
            attacks[name] = _stated(attempt, result, record)
            ids = {
                "attack": name,
                "sources": "+".join(config.detectors),
                "seed": config.attack.seed,
            }
            done = (result, *filter(None, map(results.get, attempt.looks)))
            rows += [
                {**ids, **row}
                for part in done
                if isinstance(part, Done)
                for row in part.rows
            ]
        facts = {
            **shared_apart(attacks),
            "seeds": sorted({attack["seed"] for attack in attacks.values()}),
        }
        return {**facts, "detectors": marks}, {ROWS: frame_of(_whole(rows))}, []

    def figures(
        self, record: Mapping[str, Any], rows: Mapping[str, pl.DataFrame]
    ) -> Figures:
        """What the attacks have reached, and who else is deceived."""
        return figures(record, rows)

    def tables(self, record: Mapping[str, Any], figures: Figures) -> Iterator[Table]:
        """What attacks have reached, the smallest that suffices, and what others
        report.
        """
        return tables(figures)


def _stated(
    attempt: DaggerAttempt, result: Done, record: Mapping[str, Any]
) -> dict[str, Any]:
    """What is known of an attack besides its rows."""
    config = attempt.job.config
    files = {
        name: str(path)
        for name, path in attempt.job.inputs.items()
        if name in ("scene", CAMERAS)
    }
    settings = {**files, **dataclasses.asdict(config)}
    stated = _BRIEFLY if views_of(settings) == "drawn" else _STATED
    return {
        "part": attempt.point.part,
        "labels": dict(attempt.point.labels),
        "bisected": attempt.point.bisected,
        "sources": list(config.detectors),
        "aim": config.objective.name,
        "target": config.objective.label,
        "confidence": config.objective.confidence,
        "seed": config.attack.seed,
        "settings": settings,
        "key": result.key,
        **{name: record[name] for name in stated if name in record},
    }


def _whole(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows without the columns that some of them lack and none may."""
    names = dict.fromkeys(name for row in rows for name in row)
    kept = [
        name
        for name in names
        if column_of(name).optional or all(row.get(name) is not None for row in rows)
    ]
    return [{name: row.get(name) for name in kept} for row in rows]


def _record_of(done: Done) -> dict[str, Any]:
    return read_json(done.folder / RECORD)


def _named(labels: Mapping[str, Any]) -> str:
    return ", ".join(
        f"{name.removeprefix('attack.')} {label_of(value)}"
        for name, value in labels.items()
    )
