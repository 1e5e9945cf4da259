"""How a study becomes jobs, and is run: plans whose later jobs may depend on earlier
ones, and the result.
"""

from __future__ import annotations

import importlib
import re
import shutil
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import polars as pl

from attacks.figures.frame import Figures, write_figures
from attacks.figures.tables import Table, sections
from attacks.observe.rows import SUFFIX, write_rows
from attacks.studies.study_file import KINDS, Point, Study, read_study
from mi_splat import provenance
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import save_json, save_text
from mi_splat.io.folders import RECORD, check_own_folder, own_folder, write_manifest
from mi_splat.ledger import Done, Job
from mi_splat.ledger.engines import engine_for
from mi_splat.ledger.job import by_depth
from mi_splat.ledger.plans import Driver, Plan, Result, grid

if TYPE_CHECKING:
    from mi_splat.ledger.engines import Engine

STUDY_FILE = "study.toml"
TABLE = "table.md"
STORE = Path("out/store")
"""Names of files of a result, and the folder of finished jobs where none is named."""
OWN_NAME = "the study"
"""What a value is called in a study in which nothing varies."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Attempt:
    """A point of a study as jobs."""

    point: Point
    title: str
    jobs: Mapping[str, Job]

    def done(self, results: Mapping[str, Result]) -> dict[str, Done]:
        """What its jobs left, by their identity, as far as they are done."""
        ended = {job.identity: results.get(label) for label, job in self.jobs.items()}
        return {
            identity: result
            for identity, result in ended.items()
            if isinstance(result, Done)
        }

    def is_done(self, done: Mapping[str, Done]) -> bool:
        """Whether all of its jobs are done."""
        return all(job.identity in done for job in self.jobs.values())


_Attempt = TypeVar("_Attempt", bound=Attempt)
Observed = tuple[dict[str, Any], Mapping[str, pl.DataFrame], list[Path]]
"""What a result says of finished jobs, its tables of rows, and the images that were
copied beside it.
"""


class Work(ABC, Generic[_Attempt]):
    """A kind of study: the jobs of each point, and what its result says of them.

    Raises:
        MiSplatError: A setting cannot be, a detector cannot be loaded, or a file is
            missing; before any job is done.
    """

    story: ClassVar[str]
    has_evaluations: ClassVar[bool] = True
    can_bisect: ClassVar[bool] = False
    searches: Sequence[Sequence[_Attempt]] = ()

    def __init__(self, study: Study, attempts: Iterable[_Attempt]) -> None:
        self.study = study
        if study.evaluations and not self.has_evaluations:
            raise InvalidValueError.of(
                study.name, "no table evaluate_with", "one", "leave it out"
            )
        if not self.can_bisect and any(point.bisected for point in study.points):
            raise InvalidValueError.of(
                study.name, "no bisect, for want of a single aim", "one", "leave it out"
            )
        self.attempts = list(attempts)

    @abstractmethod
    def observed(self, results: Mapping[str, Result], out: Path) -> Observed:
        """What is seen in the results."""

    @abstractmethod
    def figures(
        self, record: Mapping[str, Any], rows: Mapping[str, pl.DataFrame]
    ) -> Figures:
        """Every figure that follows from a record and its rows."""

    @abstractmethod
    def tables(self, record: Mapping[str, Any], figures: Figures) -> Iterable[Table]:
        """The tables of a result."""

    def jobs(self) -> dict[str, Job]:
        """Every job that may be asked for, by its label."""
        return {
            label: job
            for attempt in self.attempts
            for label, job in attempt.jobs.items()
        }

    @property
    def size(self) -> int:
        """Number of different jobs, with those that others read."""
        return sum(map(len, by_depth(self.jobs().values())))

    def plans(self) -> list[Plan]:
        """What is to be done, in plans that do not depend on each other."""
        return [grid(self.jobs())]

    def write(self, results: Mapping[str, Result], out: Path) -> list[Path]:
        """Write result.json, tables of rows, study.toml and table.md into a folder that
        exists.
        """
        facts, frames, paths = self.observed(results, out)
        record = {
            "story": self.story,
            **self.study.named,
            **facts,
            **provenance.origin(),
        }
        figures = self.figures(record, frames)
        if len(figures):
            paths.append(write_figures(figures, out))
        paths += [
            write_rows(table, out / f"{name}{SUFFIX}") for name, table in frames.items()
        ]
        title = self.study.question or self.study.name
        save_text(f"# {title}\n\n{sections(self.tables(record, figures))}", out / TABLE)
        save_text(self.study.text, out / STUDY_FILE)
        save_json(record, out / RECORD, indent=None)
        return [*paths, *(out / name for name in (TABLE, STUDY_FILE, RECORD))]


def names_of(
    point: Point, study: str, *, without: Sequence[str] = ()
) -> tuple[str, str]:
    """What tables call the part of a study that a point belongs to, and what varies in
    it but for some axes.
    """
    labels = {
        axis: str(label) for axis, label in point.labels.items() if axis not in without
    }
    return (
        point.part or " and ".join(labels) or study,
        ", ".join(labels.values()) or OWN_NAME,
    )


def bisection(
    attempts: Sequence[_Attempt],
    suffices: Callable[[_Attempt, Mapping[str, Result]], bool | None],
) -> Plan:
    """A plan that looks for the first attempt that suffices."""
    low = -1
    high = len(attempts)  # fails, suffices
    while high - low > 1:
        middle = (low + high) // 2
        enough = suffices(attempts[middle], (yield attempts[middle].jobs) or {})
        if enough is None:
            return
        low, high = (low, middle) if enough else (middle, high)


def copied(file: Path, folder: Path, name: str) -> Path:
    """An image of a job, beside the result under a name of its own."""
    folder.mkdir(exist_ok=True)
    return Path(
        shutil.copyfile(file, folder / (re.sub(r"[^0-9A-Za-z.]+", "-", name) + ".png"))
    )


def check_apart(where: str, looks: Iterable[str]) -> None:
    """Raise if two looks at one splat are called the same: their rows would be counted
    as if they were one look's.
    """
    for name, number in Counter(looks).items():
        if number > 1:
            do = "tell evaluations apart by detector and condition"
            raise InvalidValueError.of(
                where, "one look of each name", f"{number}: {name}", do
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """What a run of a study left behind."""

    jobs: int  # how many there are
    failed: dict[str, str]  # what was said by those that have failed, by their labels
    files: tuple[Path, ...]  # of the result; none where all jobs have failed


def work_of(study: Study) -> Work[Any]:
    """The jobs of a study, by its kind."""
    module, name = KINDS[study.kind]
    work: Work[Any] = getattr(importlib.import_module(module), name)(study)
    return work


def run_with(engine: Engine, work: Work[Any], *, out: Path) -> Run:
    """Do what of a study is not done yet, and write its result into a folder that is
    its own; jobs that have failed earlier are tried again.
    """
    store = engine.store.folder
    results = Driver(engine, name=work.study.name).run(work.plans())
    failed = {
        label: result for label, result in results.items() if isinstance(result, str)
    }
    files = [] if len(failed) == len(results) else work.write(results, out)
    if files:
        write_manifest(out, without=(store.name,) if store.parent == out else ())
    return Run(jobs=len(results), failed=failed, files=tuple(files))


def run_study(
    study: str | Path,
    *,
    out: str | Path | None = None,
    store: str | Path = STORE,
    workers: int = 0,
    scheduler: str = "",
    parts: Sequence[str] = (),
) -> Path:
    """Run a study: many attacks and what they depend on, from one TOML file.

    Finished jobs are kept in the store, so that an interrupted run resumes
    where it stopped.

    Args:
        study: TOML file of the study; scenes/studies has some, and docs/studies.md says
            what may stand in it.
        out: Folder for the result. Default: out/studies/NAME. `rows` reads its table.
        store: Folder of finished jobs, which several studies may share.
        workers: Processes that run jobs in parallel; 0 runs them in this one.
        scheduler: Address of a Dask scheduler whose workers run the jobs instead; the
            store has to be on a disk that all of them share.
        parts: Names of cases to run. Default: all.

    Returns:
        The folder of the result.

    Raises:
        InvalidValueError: The file is no study, a setting cannot be, or a job of
            another process has failed; what a job of this process raises comes as it
            is.
        EngineError: The cluster cannot be used any more.
    """
    asked = read_study(Path(study)).of(tuple(parts))
    folder = Path("out/studies") / asked.name if out is None else Path(out)
    check_own_folder(folder, STUDY_FILE)
    work = work_of(asked)
    with own_folder(folder, STUDY_FILE):
        engine = engine_for(Path(store), workers=workers, scheduler=scheduler)
        run = run_with(engine, work, out=folder)
    if run.failed:
        label, text = next(iter(run.failed.items()))
        expected = f"{run.jobs} jobs that are done"
        got = f"{len(run.failed)} that failed; {label}: {text.strip()}"
        raise InvalidValueError.of(
            str(study),
            expected,
            got,
            "mend the cause, and run it again with mi-splat study run",
        )
    return folder
