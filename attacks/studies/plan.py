"""What a study is made of: jobs by labels, in plans whose later jobs may depend on the results of earlier ones."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

from attacks.studies.study_file import Study
from mi_splat.errors import InvalidValueError
from mi_splat.ledger import Job
from mi_splat.ledger.plans import Plan, Result, grid


class Attempt(Protocol):
    """A point of a study as jobs."""

    def jobs(self) -> Mapping[str, Job]:
        """Every job by its label."""
        ...


_Attempt = TypeVar("_Attempt", bound=Attempt)


class Work:
    """The jobs of a study.

    Attributes:
        study: The study.
        attempts: Every point that may be asked for.
        searches: Those of which some are, search by search.
    """

    study: Study
    attempts: Sequence[Attempt]
    searches: Sequence[Sequence[Attempt]] = ()

    def jobs(self) -> dict[str, Job]:
        """Every job that may be asked for, by its label."""
        return {label: job for attempt in self.attempts for label, job in attempt.jobs().items()}

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


def bisection(attempts: Sequence[_Attempt], suffices: Callable[[_Attempt, Mapping[str, Result]], bool | None]) -> Plan:
    """A plan that looks for the first attempt that suffices."""
    low, high = -1, len(attempts)  # fails, suffices
    while high - low > 1:
        middle = (low + high) // 2
        enough = suffices(attempts[middle], (yield attempts[middle].jobs()) or {})
        if enough is None:
            return
        low, high = (low, middle) if enough else (middle, high)


def check_apart(where: str, looks: Iterable[str]) -> None:
    """Raise if two looks at one splat are called the same: their rows would be counted as if they were one look's."""
    for name, number in Counter(looks).items():
        if number > 1:
            do = "tell judges apart by detector and condition"
            raise InvalidValueError.of(where, "one look of each name", f"{number}: {name}", do)
