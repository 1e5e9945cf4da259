"""A suite: a folder of study files in which the detector is left out, so that it is the
same for every detector.

suite.toml says what is asked, and which detectors are surrogates. Each column is a
study file of the column's name. A file whose `base` names another one of the folder
begins with what stands there.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import polars as pl

from attacks.bench.row import (
    ALL_VIEWS,
    CLOAK,
    COLUMNS,
    DEFENDED,
    KNOWS,
    ONE_VIEW,
    STORY,
    TRANSFER,
    figures,
    table_of,
)
from attacks.cloak.steps import Look, StudySteps
from attacks.detectors.registry import detector_spec, load_detector, use_weights
from attacks.figures.frame import Figures
from attacks.figures.tables import Table
from attacks.observe.conditions import OWN, check_condition
from attacks.observe.rows import DEPTH, NOISE, NORM_NOISE, ROWS, frame_of
from attacks.studies.cloak import CloakEvaluation, config_of
from attacks.studies.dagger import DaggerWork
from attacks.studies.running import Attempt, Observed, Work
from attacks.studies.study_file import Settings, Study, merged, study_of
from mi_splat.errors import InvalidValueError, MiSplatError, nearest
from mi_splat.fields import check_choice
from mi_splat.io.documents import sha256
from mi_splat.io.parsing import DocumentReader
from mi_splat.ledger import Done, Job
from mi_splat.ledger.plans import Result

SUITES = Path("scenes/suites")
HEAD = "suite.toml"
_READER = DocumentReader(
    expected="a TOML file", do="correct it, or get the suite again"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Suite:
    """What is asked of everybody."""

    name: str  # of the suite
    question: str  # what it asks, one sentence
    # detectors that the attacks of the column transfer are made on
    surrogates: tuple[str, ...]
    # tables of the study files, by column
    studies: Mapping[str, Settings] = field(repr=False)
    # 32 hex digits that stand for its files, and for the scenes that they name
    digest: str


def read_suite(name: str) -> Suite:
    """A suite by its name."""
    folder = next(
        (known for known in (SUITES / name, Path(name)) if (known / HEAD).is_file()),
        Path(name),
    )
    if not (folder / HEAD).is_file():
        known = sorted(path.parent.name for path in SUITES.glob(f"*/{HEAD}"))
        do = nearest(name, known, "run it in a checkout, or pass a folder of a suite")
        raise InvalidValueError.of(
            "suite", " or ".join(known) or f"a folder with {HEAD}", name, do
        )
    head = _READER.read_toml(folder / HEAD)
    files = {path.name: path for path in sorted(folder.glob("*.toml"))}
    tables = {path.stem: _whole(folder, path) for path in files.values()}
    scenes = {
        Path(scene).as_posix(): Path(scene)
        for table in tables.values()
        for scene in _scenes(table)
    }
    return Suite(
        name=folder.name,
        question=str(head.get("question", "")),
        surrogates=tuple(map(str, head.get("surrogates", ()))),
        studies={column: tables[column] for column in COLUMNS if column in tables},
        digest=_digest({**files, **_files_of(scenes)}),
    )


def _whole(folder: Path, path: Path) -> Settings:
    table = _READER.read_toml(path)
    if "base" not in table:
        return table
    check_choice(
        f"base of {path}",
        table["base"],
        sorted(file.name for file in folder.glob("*.toml")),
    )
    base = _READER.read_toml(folder / str(table["base"]))
    whole: Settings = merged(
        base, {key: value for key, value in table.items() if key != "base"}
    )
    return whole


def _scenes(table: Any) -> Iterator[str]:
    if isinstance(table, Mapping):
        for value in table.values():
            yield from _scenes(value)
    elif isinstance(table, list):
        for value in table:
            yield from _scenes(value)
    elif isinstance(table, str) and table.endswith(".xml"):
        yield table


def _files_of(scenes: Mapping[str, Path]) -> dict[str, Path]:
    from attacks.studies.attack import scene_files

    return {
        path.name: path
        for scene in scenes.values()
        for path in scene_files(scene).values()
    }


def _digest(files: Mapping[str, Path]) -> str:
    text = "\n".join(f"{name} {sha256(path)}" for name, path in sorted(files.items()))
    return hashlib.sha256(text.encode()).hexdigest()[:32]


# The jobs of a suite


CELLS = ("view", "azimuth", "elevation", "original", "score", "original_score")
"""What of a look is kept in the rows of a suite."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Entry(Attempt):
    """One attack of a suite, or the splats of one that hide the object beside their
    clean ones.
    """

    column: str  # that it counts for
    made: Mapping[str, Job]  # the jobs that make the splats, by their labels
    looks: Sequence[Look]  # that evaluate them
    knows: bool = False  # whether the attacker knows the defence

    @classmethod
    def of(cls, made: Mapping[str, Job], looks: Sequence[Look], **more: Any) -> Entry:
        """An entry of some jobs."""
        return cls(
            made=made,
            looks=looks,
            jobs={**made, **{look.label: look.job for look in looks}},
            **more,
        )

    def rows(self, done: Mapping[str, Done]) -> Iterator[dict[str, Any]]:
        """The rows of its looks, by the identity of their jobs."""
        for look in self.looks:
            named = {
                "attack": self.title,
                "seed": look.seed,
                "detector": look.job.config.detector,
            }
            named["condition"] = OWN if look.condition == OWN else DEFENDED
            for row in _rows_of(look, done[look.job.identity]):
                splat = NOISE if row["splat"] == NORM_NOISE else row["splat"]
                yield {**named, "splat": splat, **{name: row[name] for name in CELLS}}


def _rows_of(look: Look, done: Done) -> Iterable[Mapping[str, Any]]:
    """The rows of a look; of a splat that hides the object those from well inside its
    trigger.
    """
    if done.rows:
        return done.rows
    config = look.job.config
    inside = pl.col(f"{DEPTH}{config.attacks[0].name}") >= config.evaluation.well_inside
    return look.tables(done)[ROWS].filter(inside).iter_rows(named=True)


class BenchWork(Work[Entry]):
    """The jobs of a suite for a detector, with its usual weights or those of a file.

    A defender may put a `defence`, which is a condition, before the detector. Columns
    are all if none is named.

    Raises:
        MiSplatError: There is no such detector or defence, or a setting cannot be;
            before any job is done.
    """

    story = STORY

    def __init__(
        self,
        suite: Suite,
        detector: str,
        weights: Path | None = None,
        defence: str = "",
        columns: Sequence[str] = (),
    ) -> None:
        detector_spec(detector)
        if weights is not None:
            use_weights(detector, weights)
        check_condition(defence, None)
        for column in columns:
            check_choice("column", column, COLUMNS)
        super().__init__(
            Study(name=f"bench-{suite.name}-{detector}", kind="dagger", parts={}), ()
        )
        self.suite, self.detector, self.weights, self.defence = (
            suite,
            load_detector(detector),
            weights,
            defence,
        )
        self.conditions = ["", defence] if defence else [""]
        self.missing: dict[str, str] = {}
        for column in COLUMNS:
            if column not in suite.studies:
                self.missing[column] = "not in the suite"
            elif columns and column not in columns:
                self.missing[column] = "not done"
            else:
                self._add(column, suite.studies[column])

    def _add(self, column: str, table: Settings) -> None:
        try:
            self.attempts += [
                *(
                    self._hidden(table)
                    if column == CLOAK
                    else self._attacked(column, table)
                )
            ]
        except MiSplatError as error:
            if column != TRANSFER:
                raise
            self.missing[column] = str(error)

    def _attacked(self, column: str, table: Settings) -> Iterator[Entry]:
        """The attacks of a column; where the attacker can know the defence, these,
        too.
        """
        name = self.detector.name
        surrogates = [other for other in self.suite.surrogates if other != name]
        evaluation = {
            **table.get("evaluate_with", {}),
            "detector": name,
            "matrix": {"condition": self.conditions},
        }
        # as in the first rows of suite v1, which call it noise
        evaluation["controls"] = [NORM_NOISE]
        settings = {
            "": {
                **table,
                "detectors": surrogates if column == TRANSFER else [name],
                "evaluate_with": evaluation,
            }
        }
        known = KNOWS.get(self.defence)
        if known is not None and column in (
            ONE_VIEW,
            ALL_VIEWS,
        ):
            settings[", by an attacker who knows the defence"] = merged(
                settings[""], known
            )
        for who, whole in settings.items():
            for attempt in DaggerWork(study_of(whole, column)).attempts:
                title = f"{column}: {attempt.title}{who}"
                seed = attempt.job.config.attack.seed
                looks = [
                    Look(
                        label=f"{title} / {label}",
                        job=job,
                        splat="",
                        seed=seed,
                        condition=job.config.condition or OWN,
                    )
                    for label, job in attempt.looks.items()
                ]
                more = {"point": attempt.point, "column": column, "knows": bool(who)}
                yield Entry.of({title: attempt.job}, looks, title=title, **more)

    def _hidden(self, table: Settings) -> Iterator[Entry]:
        """The splats of the column of CLOAK, which no detector has a part in."""
        weights = {} if self.weights is None else {self.detector.name: self.weights}
        evaluations = [
            CloakEvaluation(condition=condition, every=1)
            for condition in self.conditions
        ]
        for point in study_of(
            merged(table, {"evaluation": {"detectors": [self.detector.name]}}), CLOAK
        ).points:
            steps = StudySteps(study=config_of(point.settings, CLOAK), weights=weights)
            title = f"{CLOAK}: {', '.join(map(str, point.labels.values()))}"
            seen = [
                look
                for way in evaluations
                for look in way.looks(steps, [self.detector])
            ]
            looks = [replace(look, label=f"{title} / {look.label}") for look in seen]
            looks.sort(key=lambda look: look.seed or 0)
            made = {f"{title} / {label}": job for label, job in steps.made()}
            yield Entry.of(made, looks, title=title, point=point, column=CLOAK)

    def observed(self, results: Mapping[str, Result], out: Path) -> Observed:
        """What attacks leave; those of which a job has failed are left out, and the
        column with them is told so.
        """
        jobs = self.jobs()
        done = {
            jobs[label].identity: result
            for label, result in results.items()
            if isinstance(result, Done)
        }
        rows = list[dict[str, Any]]()
        attacks = dict[str, Any]()
        for entry in self.attempts:
            if not entry.is_done(done):
                self.missing[entry.column] = "a job has failed"
                continue
            rows += entry.rows(done)
            labels = {
                axis: label
                for axis, label in entry.point.labels.items()
                if axis != "seed"
            }
            attacks[entry.title] = {
                "column": entry.column,
                "labels": labels,
                "knows": entry.knows,
            }
        suite = self.suite
        spec = detector_spec(self.detector.name)
        seconds = self._seconds(done)
        facts = {
            "suite": {"name": suite.name, "digest": suite.digest},
            "detector": {
                "name": self.detector.name,
                "fingerprint": self.detector.fingerprint,
                "weights": "" if spec.weights is None else sha256(spec.weights()),
                "classes": len(self.detector.classes),
            },
            "defence": self.defence,
            "missing": self.missing,
            "cpu_seconds": {**seconds, "all": round(sum(seconds.values()), 1)},
            "attacks": attacks,
        }
        return facts, {ROWS: frame_of(rows)}, []

    def figures(
        self, record: Mapping[str, Any], rows: Mapping[str, pl.DataFrame]
    ) -> Figures:
        """Its columns and score."""
        return figures(record, rows)

    def tables(self, record: Mapping[str, Any], figures: Figures) -> list[Table]:
        """The row as a table."""
        return [table_of([(record, figures)])]

    def _seconds(self, done: Mapping[str, Done]) -> dict[str, float]:
        """CPU seconds of the jobs of each column, and of those that every detector
        shares.
        """
        seconds = dict.fromkeys((*self.suite.studies, "shared"), 0.0)
        counted = set[str]()
        for entry in self.attempts:
            if entry.column in (CLOAK, TRANSFER):
                shared = {job.identity for job in entry.made.values()}
            else:
                shared = set()
            for job in entry.jobs.values():
                if job.identity in done and job.identity not in counted:
                    counted.add(job.identity)
                    key = "shared" if job.identity in shared else entry.column
                    seconds[key] += done[job.identity].record.get("cpu_seconds", 0.0)
        return {name: round(spent, 1) for name, spent in seconds.items() if spent}
