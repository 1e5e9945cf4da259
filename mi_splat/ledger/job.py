"""What a job is: a kind of work, its configuration and its inputs; and what it
leaves.
"""

from __future__ import annotations

import dataclasses
import enum
import fnmatch
import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.folders import LockedError

# key of the name of a class in the JSON of one of its values: module, colon, class
CLASS = "class"
_FLOAT = "float"
_NAME = "name"


def canonical(value: Any) -> str:
    """A JSON value as its one text: keys sorted, numbers exact, nothing between."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest(value: Any) -> str:
    """32 hex digits that stand for a JSON value."""
    return hashlib.sha256(canonical(value).encode()).hexdigest()[:32]


def encoded(value: Any, where: str = "config") -> Any:
    """A configuration as JSON: every field of every frozen dataclass, members of
    enumerations, tuples as lists.
    """
    kind = type(value)
    if value is None or kind is str or kind is int or kind is bool:
        return value
    if isinstance(value, float):
        number = float(value)
        if math.isfinite(number):
            return number
        return {CLASS: _FLOAT, _NAME: repr(number)}
    if kind is tuple or kind is list:
        return [encoded(item, where) for item in value]
    if is_frozen(value):
        fields = {
            field.name: encoded(getattr(value, field.name), f"{where}.{field.name}")
            for field in dataclasses.fields(kind)
        }
        return {CLASS: kind.__qualname__, **fields}
    if isinstance(value, enum.Enum):
        return {CLASS: kind.__qualname__, _NAME: value.name}
    if isinstance(value, Mapping) and all(
        type(key) is str and key != CLASS for key in value
    ):
        return {key: encoded(item, f"{where}.{key}") for key, item in value.items()}
    expected = "numbers, texts, tuples, mappings and frozen dataclasses"
    do = "give what it stands for, or make the file that holds it an input"
    raise InvalidValueError.of(where, expected, kind.__name__, do)


def is_frozen(value: Any) -> bool:
    """Whether a value is one of a frozen dataclass."""
    parameters = getattr(type(value), "__dataclass_params__", None)
    return parameters is not None and bool(parameters.frozen)


ALL = "*"
_SIGNS_OF_PATTERNS = frozenset("*?[")

# one row of what a job measured: numbers, texts, truth values and None by their names
Row = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class Job:
    """A piece of work whose result depends on nothing but what stands here and on the
    code of its kind.
    """

    kind: str  # dotted name of a module with `run(config, inputs, out)`
    config: Any  # a frozen dataclass; every field counts
    inputs: Mapping[str, Job | Part | Path] = field(
        default_factory=lambda: MappingProxyType({})
    )

    def __post_init__(self) -> None:
        if not is_frozen(self.config):
            expected = "a frozen dataclass"
            do = "say all that the result depends on as its fields"
            raise InvalidValueError.of(
                f"config of {self.kind}", expected, type(self.config).__name__, do
            )

    @cached_property
    def config_json(self) -> Any:
        """The configuration as JSON, see `mi_splat.ledger.job.encoded`."""
        return encoded(self.config)

    @cached_property
    def identity(self) -> str:
        """32 hex digits that stand for the job and all before it: known before anything
        is done, and never a key.
        """
        inputs = {
            name: (
                f"{source.job.identity}/{source.pattern}"
                if isinstance(source, Part)
                else f"path {source.absolute()}"
            )
            for name, source in self.sources.items()
        }
        return digest({"kind": self.kind, "config": self.config_json, "inputs": inputs})

    @cached_property
    def sources(self) -> Mapping[str, Part | Path]:
        """The inputs, a job as the part `*` of itself."""
        return {
            name: s.part(ALL) if isinstance(s, Job) else s
            for name, s in self.inputs.items()
        }

    def part(self, pattern: str) -> Part:
        """Some of the files that the job leaves, as an input: only their names and
        bytes count.
        """
        return Part(job=self, pattern=pattern)

    @property
    def before(self) -> tuple[Job, ...]:
        """The jobs that it reads."""
        return tuple(
            source.job for source in self.sources.values() if isinstance(source, Part)
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """Some of the files that a job leaves; see `Job.part`."""

    job: Job
    pattern: str = ALL


def by_depth(jobs: Iterable[Job]) -> list[list[Job]]:
    """Jobs and all before them, by the longest way that leads to each."""
    depths: dict[str, int] = {}
    levels: list[list[Job]] = []

    def depth(job: Job) -> int:
        if job.identity not in depths:
            depths[job.identity] = number = 1 + max(
                (depth(needed) for needed in job.before), default=-1
            )
            levels.extend([] for _ in range(len(levels), number + 1))
            levels[number].append(job)
        return depths[job.identity]

    for job in jobs:
        depth(job)
    return levels


def key_of(config: Any, inputs: Mapping[str, Mapping[str, str]], code: str) -> str:
    """The key of a job: by its configuration as JSON, the contents of its inputs, and
    the code, which stands for the kind wherever that lies.
    """
    contents = {name: source["content"] for name, source in inputs.items()}
    return digest({"config": config, "inputs": contents, "code": code})


@dataclass(frozen=True, kw_only=True)
class Task:
    """A job whose inputs are done: all that a process needs to run it."""

    kind: str
    config: Any
    inputs: Mapping[str, Mapping[str, str]]
    code: str

    @cached_property
    def as_json(self) -> Mapping[str, Any]:
        """The task as JSON can hold it."""
        return {
            "kind": self.kind,
            "config": encoded(self.config),
            "inputs": self.inputs,
            "code": self.code,
        }

    @cached_property
    def key(self) -> str:
        """The key of the job."""
        return key_of(self.as_json["config"], self.inputs, self.code)

    def event(self, state: str, **values: Any) -> Event:
        """Something that happens to the job."""
        return Event(state=state, key=self.key, kind=self.kind, **values)


@dataclass(frozen=True, kw_only=True)
class Done:
    """A finished job."""

    key: str
    folder: Path
    record: Mapping[str, Any]

    @property
    def rows(self) -> Sequence[Row]:
        """What `run` returned; empty for nothing."""
        rows: list[Row] = self.record["rows"]
        return rows

    @property
    def content(self) -> str:
        """What stands for all files and rows that it left, the files apart that its
        kind says may vary.
        """
        return self.content_of(ALL)

    def content_of(self, pattern: str) -> str:
        """What stands for the files that fit a pattern, see `Job.part`; with the rows
        if it is `*`.
        """
        varies = self.record["varies"]
        names = [
            n
            for n in self.record["files"]
            if fits(n, pattern) and not any(fits(n, other) for other in varies)
        ]
        files = {name: self.record["files"][name] for name in names}
        if pattern == ALL:
            return digest({"files": files, "rows": self.record["rows"]})
        if not files:
            do = "name one of its files, or make the job again"
            raise InvalidValueError.of(
                f"job {self.key}", f"files {pattern}", "none", do
            )
        return digest({"files": files})

    def input_path(self, pattern: str) -> Path:
        """What a job that reads this one is given: the file of that name, or the folder
        for a pattern with signs.
        """
        if _SIGNS_OF_PATTERNS & set(pattern):
            return self.folder
        return self.folder / pattern


def fits(name: str, pattern: str) -> bool:
    """Whether the name of a file fits a pattern, whose `*` is of any depth."""
    return pattern in (ALL, name) or fnmatch.fnmatchcase(name, pattern)


class DiskFullError(MiSplatError):
    """The disk that holds the store is full."""


HeldError = LockedError  # another process does the job now


@dataclass(frozen=True, kw_only=True)
class Event:
    """What happens to a job: running, progress, note (for people to keep), done, kept,
    held or failed.
    """

    state: str
    key: str
    kind: str
    text: str = ""
    done: int = 0
    total: int = 0
    seconds: float = 0.0


OnEvent = Callable[[Event], None]


class EngineError(MiSplatError):
    """What runs jobs does not work itself."""


class EngineWarning(UserWarning):
    """What runs jobs works, but not yet."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a try of a task ended: done, held (by another process), again (it failed and
    may be tried again), failed (for good) or stopped.
    """

    state: str
    text: str = ""


def nobody(event: Event) -> None:
    """Tells nobody."""


@dataclass(frozen=True, kw_only=True)
class Out:
    """Where a job writes."""

    # folder of what it leaves; new at every try. `out / name` is short for
    # `out.files / name`
    files: Path
    kept: Path  # where `partial` is
    # called with what goes on, units of it that are done, and all
    progress: Callable[[str, int, int], None]
    # called with a line that people should keep
    note: Callable[[str], None] = lambda text: None

    @property
    def partial(self) -> Path:
        """Folder of its own that outlasts a killed or failed try, and is gone once the
        job is done.
        """
        self.kept.mkdir(parents=True, exist_ok=True)
        return self.kept

    def __truediv__(self, name: str) -> Path:
        return self.files / name
