"""What a study is made of: jobs by labels, in plans whose later jobs may depend on the results of earlier ones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from attacks.studies.dagger import KINDS, Drawn, Fixed, settings_of
from attacks.studies.study_file import Point, Search, Study, label_of
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.folders import RECORD
from mi_splat.io.parsing import read_json
from mi_splat.ledger import Done, Job
from mi_splat.ledger.plans import Plan, Result, grid


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Look:
    """A look at what came out of an attack.

    Attributes:
        label: Of the job.
        labels: Of the judges' axes.
        job: The job.
    """

    label: str
    labels: Mapping[str, Any]
    job: Job


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Attempt:
    """A point of a study as jobs.

    Attributes:
        label: Of the attack's job.
        point: The point.
        settings: Its settings.
        job: The attack.
        looks: Those at its splat.
        bisected: The axis of which the smallest value is looked for; empty for none.
    """

    label: str
    point: Point
    settings: Fixed | Drawn
    job: Job
    looks: tuple[Look, ...]
    bisected: str = ""

    def jobs(self) -> dict[str, Job]:
        """Every job by its label."""
        return {self.label: self.job, **{look.label: look.job for look in self.looks}}


class Work:
    """The jobs of a study.

    Attributes:
        study: The study.
        attempts: Every point that may be asked for.
        searches: Those of which some points are.

    Raises:
        MiSplatError: A setting cannot be, a detector cannot be loaded, or a file is missing; before any job is done.
    """

    def __init__(self, study: Study) -> None:
        self.study = study
        self._groups = list(study.points())
        self._judges = study.judges()
        self.searches = [group for group in self._groups if isinstance(group, Search)]
        self._by_point: dict[int, Attempt] = {}
        for group in self._groups:
            points, field = (group.points, group.field) if isinstance(group, Search) else ((group,), "")
            self._by_point |= {id(point): self._attempt(point, field) for point in points}
        self.attempts = list(self._by_point.values())
        if not self.attempts:
            raise InvalidValueError(message(study.name, "something to do", "nothing", "add settings"))

    def _attempt(self, point: Point, bisected: str) -> Attempt:
        kind, judge = KINDS[self.study.kind]
        where = f"{self.study.name}, {point.part}" if point.part else self.study.name
        settings = settings_of(kind, point.settings, where)
        job, label = settings.job(), _label(point) or self.study.name
        looks = []
        for judged in self._judges:
            judges: Any = settings_of(judge, judged.settings, f"{self.study.name}, judge")
            for look in judges.jobs(settings, job):
                labels = {**judged.labels, "detector": look.config.detector}
                looks.append(Look(label=f"{label} / {_named(labels)}", labels=labels, job=look))
        return Attempt(label=label, point=point, settings=settings, job=job, looks=tuple(looks), bisected=bisected)

    def plans(self) -> list[Plan]:
        """Plans for a driver of the ledger."""
        known: dict[str, Job] = {}
        searches: list[Plan] = []
        for group in self._groups:
            if isinstance(group, Search):
                searches.append(self._bisected(group))
            else:
                known |= self._by_point[id(group)].jobs()
        return [grid(known), *searches] if known else searches

    def _bisected(self, search: Search) -> Plan:
        outcomes: dict[int, bool | None] = {}
        while True:
            last = search.asked(lambda point: outcomes.get(id(point)))[-1]
            if id(last) in outcomes:
                return
            attempt = self._by_point[id(last)]
            results = yield attempt.jobs()
            outcomes[id(last)] = _succeeded((results or {}).get(attempt.label))
            if outcomes[id(last)] is None:  # it failed: nothing is known of those beyond it
                return

    def jobs(self) -> dict[str, Job]:
        """Every job that may be asked for, by its label."""
        return {label: job for attempt in self.attempts for label, job in attempt.jobs().items()}

    @property
    def size(self) -> int:
        """Number of different jobs."""
        return len({job.identity for job in self.jobs().values()})

    def done(self, results: Mapping[str, Result]) -> Iterator[tuple[Attempt, Done]]:
        """The attacks that are done."""
        for attempt in self.attempts:
            result = results.get(attempt.label)
            if isinstance(result, Done):
                yield attempt, result


def record_of(done: Done) -> dict[str, Any]:
    """What an attack says of itself."""
    return read_json(done.folder / RECORD)


def _succeeded(result: Result | None) -> bool | None:
    return bool(record_of(result)["success"]) if isinstance(result, Done) else None


def _label(point: Point) -> str:
    labels = _named(point.labels)
    return f"{point.part}: {labels}" if point.part and labels else point.part or labels


def _named(labels: Mapping[str, Any]) -> str:
    return ", ".join(f"{name.removeprefix('attack.')} {label_of(value)}" for name, value in labels.items())
