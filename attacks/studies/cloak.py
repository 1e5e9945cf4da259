"""Studies of CLOAK with one thing changed at a time: how much of the attack depends on
it, as tables.

The settings of `study = "cloak"` are those of a file that `mi-splat cloak` reads;
`base` names such a file, and what the study says comes in the place of what stands
there. Every point is done with all of its seeds. An axis is a chart.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import polars as pl

from attacks.cloak.config import StudyConfig, check_files
from attacks.cloak.kinds.seen import loaded
from attacks.cloak.steps import ROW_NAMES, Look, StudySteps
from attacks.cloak.study import check_study, detectors_of, observed, write_report
from attacks.detectors.base import Detector
from attacks.figures.frame import Figures
from attacks.figures.tables import Table
from attacks.observe.conditions import OWN, SunTable
from attacks.observe.rows import by_camera
from attacks.studies.attack import street_of
from attacks.studies.cloak_figures import figures, tables
from attacks.studies.running import Attempt, Observed, Work, check_apart, names_of
from attacks.studies.study_file import Point, Settings, Study, merged, with_none
from mi_splat.errors import InvalidValueError
from mi_splat.fields import at_least, check, decode
from mi_splat.io.folders import RECORD
from mi_splat.io.parsing import DocumentReader
from mi_splat.ledger import Done
from mi_splat.ledger.plans import Result

STORY = "cloak-study"


@dataclass(frozen=True, slots=True, kw_only=True)
class CloakEvaluation:
    """By which further detector the splats of a point are evaluated, and how."""

    detector: str | None = None  # None is each of the study's
    condition: str = ""  # see `attacks.observe.conditions`
    # every N-th held-out camera is used
    every: Annotated[int, at_least(1, "cameras")] = 4
    sun: SunTable | None = None  # a street of meshes for conditions that are hours

    def __post_init__(self) -> None:
        check(self)

    def looks(self, steps: StudySteps, detectors: Sequence[Detector]) -> Iterator[Look]:
        """The looks at each splat of a study."""
        sun, files = street_of(self.condition, self.sun)
        street: dict[str, Any] = {**files}
        if sun is not None and steps.study.layers is None:
            do = (
                "take a study with [layers], whose object is known Gaussian by Gaussian"
            )
            raise InvalidValueError.of(
                f"study under the condition {self.condition}", "layers", "none", do
            )
        shown = self.condition or OWN
        for splat, seed in steps.names():
            for detector in (
                detectors if self.detector is None else [loaded(self.detector)]
            ):
                job = steps.seen(
                    steps.splat(splat, seed),
                    detector,
                    condition=self.condition,
                    every=self.every,
                    sun=sun,
                    **street,
                )
                label = (
                    f"{detector.name} looks at the {splat} splat, seed {seed}, {shown}"
                )
                yield Look(
                    label=label,
                    job=job,
                    splat=ROW_NAMES[splat],
                    seed=seed,
                    condition=shown,
                )


@dataclass(frozen=True, kw_only=True, eq=False)
class CloakAttempt(Attempt):
    """One study of CLOAK with its values."""

    part: str
    value: str
    steps: StudySteps
    detectors: Sequence[Detector]
    looks: Sequence[Look] = ()


class CloakWork(Work[CloakAttempt]):
    """Studies of CLOAK, which have no single objective to bisect for."""

    story = STORY

    def __init__(self, study: Study, weights: Mapping[str, Path] | None = None) -> None:
        self.weights = weights or {}
        super().__init__(study, map(self.attempt, study.points))

    def attempt(self, point: Point) -> CloakAttempt:
        """A study of CLOAK, and further looks at its splats."""
        config = config_of(point.settings, self.study.name)
        detectors = detectors_of(config, self.weights)
        steps = StudySteps(study=config, weights=self.weights)
        check_study(steps, detectors)
        where = f"{self.study.name}, evaluate_with"
        evaluations = [
            decode(CloakEvaluation, with_none(way.settings), where)
            for way in self.study.evaluations
        ]
        looks = [look for way in evaluations for look in way.looks(steps, detectors)]
        check_apart(where, (look.label for look in looks))
        part, value = names_of(point, self.study.name)
        title = f"{part}: {value}"
        jobs = {
            **dict(steps.made()),
            **{look.label: look.job for look in (*steps.looked(detectors), *looks)},
        }
        return CloakAttempt(
            point=point,
            title=title,
            jobs={f"{title} / {label}": job for label, job in jobs.items()},
            part=part,
            value=value,
            steps=steps,
            detectors=detectors,
            looks=looks,
        )

    def observed(self, results: Mapping[str, Result], out: Path) -> Observed:
        """What is seen at each point."""
        points = dict[str, dict[str, Any]]()
        frames = dict[str, list[pl.DataFrame]]()
        for attempt in self.attempts:
            done = attempt.done(results)
            if attempt.is_done(done):
                points[attempt.title], tables_of = _seen(attempt, done)
                for name, table in tables_of.items():
                    titled = by_camera(table).with_columns(attack=pl.lit(attempt.title))
                    frames.setdefault(name, []).append(titled)
        return (
            {"points": points},
            {name: pl.concat(parts, how="diagonal") for name, parts in frames.items()},
            [],
        )

    def figures(
        self, record: Mapping[str, Any], rows: Mapping[str, pl.DataFrame]
    ) -> Figures:
        """The rates of every point and part."""
        return figures(record, rows)

    def tables(self, record: Mapping[str, Any], figures: Figures) -> Iterator[Table]:
        """The tables of each part."""
        return tables(figures)


class CloakReport(CloakWork):
    """One study of CLOAK whose result has its splats and images, too: what
    `mi-splat cloak` does.
    """

    def write(self, results: Mapping[str, Result], out: Path) -> list[Path]:
        """Write the report of the study."""
        (attempt,) = self.attempts
        done = attempt.done(results)
        if not attempt.is_done(done):
            return []
        summary = write_report(attempt.steps, done, attempt.detectors, out)
        return [out / name for name in (*summary["files"], RECORD)]


def config_of(settings: Settings, name: str) -> StudyConfig:
    """The study of CLOAK of a point."""
    values = {key: value for key, value in settings.items() if key != "base"}
    if "base" in settings:
        path = Path(str(settings["base"]))
        if not path.is_file():
            raise InvalidValueError.of(
                f"base of {name}", "a TOML file", f"no file {path}", "check the path"
            )
        values = merged(
            DocumentReader(expected="a TOML file", do="correct it").read_toml(path),
            values,
        )
    study = decode(StudyConfig, {**with_none(values), "name": name}, name)
    check_files(study)
    return study


def _seen(
    attempt: CloakAttempt, done: Mapping[str, Done]
) -> tuple[dict[str, Any], dict[str, pl.DataFrame]]:
    """What was found at a point, as JSON can hold it, and its tables."""
    entry, tables = observed(attempt.steps, done, attempt.detectors, attempt.looks)
    fingerprints = {
        look.job.config.detector: look.job.config.fingerprint for look in attempt.looks
    }
    named = {"part": attempt.part, "value": attempt.value}
    return {**named, **entry, "detectors": entry["detectors"] | fingerprints}, tables
