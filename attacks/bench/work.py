"""The jobs of a suite for one detector: attacks, splats that hide the object, and the looks that judge them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import polars as pl

from attacks.bench.row import DEFENDED, KNOWS, Asked, write
from attacks.bench.suite import ALL_VIEWS, CLOAK, COLUMNS, ONE_VIEW, TRANSFER, Suite
from attacks.cloak.steps import ROW_NAMES, StudySteps
from attacks.detectors.registry import detector_spec, load_detector, use_weights
from attacks.observe.conditions import OWN, check_condition
from attacks.observe.rows import DEPTH, ROWS, SUFFIX, read_rows
from attacks.studies.cloak import config_of
from attacks.studies.dagger import DaggerWork
from attacks.studies.plan import Attempt, Work
from attacks.studies.study_file import Point, Settings, Study, merged, study_of
from mi_splat.errors import MiSplatError
from mi_splat.fields import check_choice
from mi_splat.io.documents import sha256
from mi_splat.ledger import Done, Job
from mi_splat.ledger.plans import Result

CELLS = ("view", "azimuth", "elevation", "original", "score", "original_score")
"""What of a look is kept in the rows of a suite."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Entry(Attempt):
    """One attack of a suite, or one splat that hides the object beside its clean one."""

    column: str  # that it counts for
    labels: Mapping[str, Any]  # what varies
    seed: int  # of the attack, or of the training
    made: Mapping[str, Job]  # the jobs that make the splats, by their labels
    looks: Sequence[tuple[Job, Mapping[str, Any]]]  # the jobs that judge them, each with what its rows are of besides
    knows: bool = False  # whether the attacker knows the defence

    def rows(self, done: Mapping[str, Done]) -> Iterator[dict[str, Any]]:
        """The rows of its looks, by the identity of their jobs."""
        for job, ids in self.looks:
            for row in _rows_of(job, done[job.identity]):
                cells = {name: row[name] for name in CELLS}
                yield {"attack": self.title, "seed": self.seed, "splat": row.get("splat"), **cells, **ids}


def _labelled(name: str, made: Mapping[str, Job], looks: Sequence[tuple[Job, Mapping[str, Any]]]) -> dict[str, Job]:
    """Every job of an entry by its label."""
    return {**made, **{f"{name} / look {number + 1}": job for number, (job, _) in enumerate(looks)}}


def _rows_of(job: Job, done: Done) -> Iterable[Mapping[str, Any]]:
    """The rows of a look; of a splat that hides the object those from well inside its trigger."""
    if done.rows:
        return done.rows
    config = job.config
    inside = pl.col(f"{DEPTH}{config.attacks[0].name}") >= config.evaluation.well_inside
    return read_rows(done.folder / f"{ROWS}{SUFFIX}").filter(inside).iter_rows(named=True)


@dataclass(eq=False)
class BenchWork(Work):
    """The jobs of a suite.

    Attributes:
        suite: The suite.
        detector: Name of the one that is asked.
        weights: File of its weights; None for the usual ones.
        defence: Name of the condition that a defender puts before the detector; empty for none.
        columns: Those that are done.

    Raises:
        MiSplatError: There is no such detector or defence, or a setting cannot be; before any job is done.
    """

    suite: Suite
    detector: str
    weights: Path | None = None
    defence: str = ""
    columns: Sequence[str] = ()
    attempts: list[Entry] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)
    study: Study = field(init=False)

    def __post_init__(self) -> None:
        detector_spec(self.detector)
        if self.weights is not None:
            use_weights(self.detector, self.weights)
        check_condition(self.defence, None)
        for column in self.columns:
            check_choice("column", column, COLUMNS)
        self.study = Study(
            name=f"bench-{self.suite.name}-{self.detector}", kind="dagger", question="", parts={}, judges=(), text=""
        )
        self.loaded = load_detector(self.detector)
        for column in COLUMNS:
            if column not in self.suite.studies:
                self.missing[column] = "not in the suite"
            elif self.columns and column not in self.columns:
                self.missing[column] = "not done"
            else:
                self._add(column, self.suite.studies[column])

    def _add(self, column: str, table: Settings) -> None:
        """Add the entries of a column; without the surrogates there are none of transfer."""
        try:
            self.attempts += [*(self._hidden(table) if column == CLOAK else self._attacked(column, table))]
        except MiSplatError as error:
            if column != TRANSFER:
                raise
            self.missing[column] = str(error)

    def _attacked(self, column: str, table: Settings) -> Iterator[Entry]:
        """The attacks of a column; where the attacker can know the defence, these, too."""
        surrogates = [name for name in self.suite.surrogates if name != self.detector]
        asked = {**table, "detectors": surrogates if column == TRANSFER else [self.detector]}
        conditions = ["", self.defence] if self.defence else [""]
        yield from self._studied(column, asked, conditions)
        if (known := KNOWS.get(self.defence)) is not None and column in _ATTACKED:
            yield from self._studied(column, merged(asked, known), conditions, knows=True)

    def _studied(
        self, column: str, table: Settings, conditions: Sequence[str], *, knows: bool = False
    ) -> Iterator[Entry]:
        judge = {**table.get("judge", {}), "detector": self.detector, "matrix": {"condition": list(conditions)}}
        work = DaggerWork(study_of({**table, "judge": judge}, column))
        for attempt in work.attempts:
            name = f"{column}: {attempt.title}{', who knows the defence' if knows else ''}"
            looks = [(look, self._ids(look.config.condition)) for look in attempt.looks.values()]
            yield Entry(
                point=attempt.point,
                title=name,
                jobs=_labelled(name, {name: attempt.job}, looks),
                column=column,
                labels={axis: label for axis, label in attempt.point.labels.items() if axis != "seed"},
                seed=attempt.job.config.attack.seed,
                made={name: attempt.job},
                looks=looks,
                knows=knows,
            )

    def _hidden(self, table: Settings) -> Iterator[Entry]:
        """The splats of the column of CLOAK, which no detector has a part in."""
        settings = merged(table, {"evaluation": {"detectors": [self.detector]}})
        for point in study_of(settings, CLOAK).points:
            yield from self._of_point(point)

    def _of_point(self, point: Point) -> Iterator[Entry]:
        weights = {} if self.weights is None else {self.detector: self.weights}
        steps = StudySteps(study=config_of(point.settings, CLOAK), weights=weights)
        value = ", ".join(map(str, point.labels.values()))
        for seed in steps.study.seeds:
            mine = [name for name in steps.names() if name[1] == seed]
            looks = [
                (
                    steps.seen(steps.splat(splat, seed), self.loaded, condition=condition),
                    {**self._ids(condition), "splat": ROW_NAMES[splat]},
                )
                for condition in dict.fromkeys(("", self.defence))
                for splat, _ in mine
            ]
            name = f"{CLOAK}: {value}, seed {seed}"
            made = {f"{CLOAK}: {value} / {label}": job for label, job in steps.made()}
            yield Entry(
                point=point,
                title=name,
                jobs=_labelled(name, made, looks),
                column=CLOAK,
                labels=dict(point.labels),
                seed=seed,
                made=made,
                looks=looks,
            )

    def _ids(self, condition: str) -> dict[str, Any]:
        return {"detector": self.detector, "condition": DEFENDED if condition else OWN}

    def write(self, results: Mapping[str, Result], out: Path) -> list[Path]:
        """As in `Work`; attacks of which a job has failed are left out, and the column with them is told so."""
        jobs = self.jobs()
        done = {jobs[label].identity: result for label, result in results.items() if isinstance(result, Done)}
        rows, attacks = list[dict[str, Any]](), dict[str, Any]()
        for entry in self.attempts:
            if not entry.is_done(done):
                self.missing[entry.column] = "a job has failed"
                continue
            rows += entry.rows(done)
            attacks[entry.title] = {"column": entry.column, "labels": dict(entry.labels), "knows": entry.knows}
        asked = Asked(suite=self.suite, detector=self.loaded, weights=self._digest_of_weights(), defence=self.defence)
        return write(asked, attacks, rows, self._seconds(done), self.missing, out)

    def _digest_of_weights(self) -> str:
        spec = detector_spec(self.detector)
        return "" if spec.weights is None else sha256(spec.weights())

    def _seconds(self, done: Mapping[str, Done]) -> dict[str, float]:
        """CPU seconds of the jobs of each column, and of those that every detector shares."""
        told = dict.fromkeys((*self.suite.studies, "shared"), 0.0)
        counted = set[str]()
        for entry in self.attempts:
            shared = {job.identity for job in entry.made.values()} if entry.column in (CLOAK, TRANSFER) else set()
            for job in entry.jobs.values():
                if job.identity in done and job.identity not in counted:
                    counted.add(job.identity)
                    key = "shared" if job.identity in shared else entry.column
                    told[key] += done[job.identity].record.get("cpu_seconds", 0.0)
        return {name: round(seconds, 1) for name, seconds in told.items() if seconds}


_ATTACKED = (ONE_VIEW, ALL_VIEWS)
