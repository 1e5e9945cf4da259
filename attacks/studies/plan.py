"""What a study is made of: jobs by labels, in plans whose later jobs may depend on the results of earlier ones."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import polars as pl

from attacks.observe.rows import SUFFIX, write_rows
from attacks.studies.study_file import Point, Study
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import save_json, save_text
from mi_splat.io.folders import RECORD
from mi_splat.ledger import Done, Job
from mi_splat.ledger.plans import Plan, Result, grid

STUDY_FILE, TABLE = "study.toml", "table.md"
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
        return {identity: result for identity, result in ended.items() if isinstance(result, Done)}

    def is_done(self, done: Mapping[str, Done]) -> bool:
        """Whether all of its jobs are done."""
        return all(job.identity in done for job in self.jobs.values())


_Attempt = TypeVar("_Attempt", bound=Attempt)


def names_of(point: Point, study: str, *, without: Sequence[str] = ()) -> tuple[str, str]:
    """What tables call the part of a study that a point belongs to, and what varies in it but for some axes."""
    labels = {axis: str(label) for axis, label in point.labels.items() if axis not in without}
    return point.part or " and ".join(labels) or study, ", ".join(labels.values()) or OWN_NAME


class Work:
    """The jobs of a study."""

    study: Study
    attempts: Sequence[Attempt]
    searches: Sequence[Sequence[Attempt]] = ()

    def jobs(self) -> dict[str, Job]:
        """Every job that may be asked for, by its label."""
        return {label: job for attempt in self.attempts for label, job in attempt.jobs.items()}

    @property
    def size(self) -> int:
        """Number of different jobs."""
        return len({job.identity for job in self.jobs().values()})

    def plans(self) -> list[Plan]:
        """Plans for a driver of the ledger."""
        return [grid(self.jobs())]

    def check_room(self, store: Path) -> None:
        """Refuse a disk that has no room for what the jobs leave."""

    def write(self, results: Mapping[str, Result], out: Path) -> list[Path]:
        """Write result.json, tables of rows, study.toml and table.md into a folder that exists."""
        raise NotImplementedError


def write_study(
    study: Study,
    record: Mapping[str, Any],
    page: str,
    rows: Mapping[str, pl.DataFrame],
    out: Path,
    *,
    indent: int | None = 2,
) -> list[Path]:
    """Write tables of rows, table.md, study.toml and result.json into a folder that exists."""
    paths = [write_rows(table, out / f"{name}{SUFFIX}") for name, table in rows.items()]
    save_text(page, out / TABLE)
    save_text(study.text, out / STUDY_FILE)
    save_json(record, out / RECORD, indent=indent)
    return [*paths, *(out / name for name in (TABLE, STUDY_FILE, RECORD))]


def bisection(attempts: Sequence[_Attempt], suffices: Callable[[_Attempt, Mapping[str, Result]], bool | None]) -> Plan:
    """A plan that looks for the first attempt that suffices."""
    low, high = -1, len(attempts)  # fails, suffices
    while high - low > 1:
        middle = (low + high) // 2
        enough = suffices(attempts[middle], (yield attempts[middle].jobs) or {})
        if enough is None:
            return
        low, high = (low, middle) if enough else (middle, high)


def check_apart(where: str, looks: Iterable[str]) -> None:
    """Raise if two looks at one splat are called the same: their rows would be counted as if they were one look's."""
    for name, number in Counter(looks).items():
        if number > 1:
            do = "tell judges apart by detector and condition"
            raise InvalidValueError.of(where, "one look of each name", f"{number}: {name}", do)
