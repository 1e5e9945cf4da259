"""Labels of jobs, and how far each job is: files beside the results, which no key depends on."""

import contextlib
import functools
import json
import statistics
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_splat.errors import InvalidValueError
from mi_splat.import_closure import code_digest
from mi_splat.io.documents import save_text
from mi_splat.io.parsing import DocumentReader
from mi_splat.ledger.job import Job, Task
from mi_splat.ledger.running import looked_up
from mi_splat.ledger.store import Store, checked_key

STATES = ("waiting", "ready", "running", "done", "failed")
"""For others before it; for an engine; for its end; for nothing; for somebody who mends it."""
_OFTEN = 5.0
"""Least seconds between two writings of a list of jobs that grows."""
_MEASURED = 200
"""Most finished jobs that tell how long one takes."""
_READER = DocumentReader(expected="a list of jobs", do="plan the study again", most=1 << 30)


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A job of an index."""

    labels: tuple[str, ...]
    kind: str
    state: str
    key: str


class Index:
    """The jobs of a plan by name: labels, and the keys as a driver has last known them."""

    def __init__(self, store: Store, name: str) -> None:
        self._path = store.path("plans") / f"{name}.json"
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._lines: dict[str, list[Any]] = {}
        self._written = time.monotonic()

    def add(self, job: Job, label: str = "") -> None:
        """A job of the plan, under one more label."""
        if (line := self._lines.get(job.identity)) is None:
            before = [needed.identity for needed in job.before]
            line = [job.identity, job.kind, before, [], "", ""]
            self._lines[job.identity] = line
        if label and label not in line[3]:
            line[3].append(label)
        if time.monotonic() - self._written > _OFTEN:
            self.write()

    def set_key(self, job: Job, task: Task) -> None:
        """The key of a job whose inputs are done."""
        self._lines[job.identity][4:] = task.code, task.key
        self.add(job)

    def write(self) -> None:
        """Write the list of jobs, and keep the keys that another driver of the plan has written."""
        known = _keys([self._path])
        for line in self._lines.values():
            line[4:] = line[4:] if line[5] else known.get(line[0], ("", ""))
        save_text(json.dumps(list(self._lines.values())), self._path)
        self._written = time.monotonic()


def _read(path: Path) -> list[list[Any]]:
    """Identity, kind, identities of those before, labels, code and key of every job of a plan."""
    lines: list[list[Any]] = _READER.read_json_value(path)
    if not isinstance(lines, list) or not all(map(_is_line, lines)):
        raise _READER.broken(str(path), "another document")
    known = {line[0] for line in lines}
    for _, _, before, _, _, key in lines:
        if key:
            checked_key(key)
        if not known.issuperset(before):
            raise _READER.broken(str(path), "a job that reads another, which is missing")
    return lines


def _is_line(line: Any) -> bool:
    if not (isinstance(line, list) and len(line) == 6):
        return False
    identity, kind, before, labels, code, key = line
    texts = [identity, kind, code, key, *(text for part in (before, labels) if isinstance(part, list) for text in part)]
    return isinstance(before, list) and isinstance(labels, list) and all(isinstance(text, str) for text in texts)


def _code_of(kind: str) -> str:
    """Digest of the code of a kind; empty if there is no such kind any more."""
    try:
        return code_digest(kind)
    except ModuleNotFoundError:
        return ""


def _keys(plans: Iterable[Path]) -> dict[str, tuple[str, str]]:
    """Code and key of each job by its identity, where a plan knows them, the last one that does."""
    keys: dict[str, tuple[str, str]] = {}
    for path in plans:
        with contextlib.suppress(InvalidValueError):  # none, or one that planning again replaces
            keys |= {identity: (code, key) for identity, *_, code, key in _read(path) if key}
    return keys


def plan(store: Store, name: str, jobs: Mapping[str, Job]) -> list[Entry]:
    """Write down the jobs of a plan by their labels, and all before them, and look how far each is."""
    index = Index(store, name)
    for job, task, _ in looked_up(jobs.values(), store):
        index.add(job)
        if task is not None:
            index.set_key(job, task)
    for label, job in jobs.items():
        index.add(job, label)
    index.write()
    return status(store, name)


def forecast(store: Store, entries: Iterable[Entry]) -> tuple[float, int]:
    """Seconds that the jobs which are not done take one after the other, and how many of them nobody can tell.

    Each is taken to need as long as the median of its kind: of those that are done in the plan, or else in the store.
    """
    done: dict[str, list[str]] = {}
    missing: Counter[str] = Counter()
    for entry in entries:
        if entry.state == "done":
            done.setdefault(entry.kind, []).append(entry.key)
        else:
            missing[entry.kind] += 1
    others = sorted(store.keys())[:_MEASURED] if missing.keys() - done.keys() else []
    seconds, unknown = 0.0, 0
    for kind, count in missing.items():
        records = [store.record(key) for key in done.get(kind, others)[:_MEASURED]]
        measured = [float(record["seconds"]) for record in records if record["kind"] == kind]
        seconds += count * statistics.median(measured) if measured else 0.0
        unknown += 0 if measured else count
    return seconds, unknown


def status(store: Store, name: str) -> list[Entry]:
    """The jobs of a plan and their states, as of its last planning."""
    path = store.folder / "plans" / f"{name}.json"
    if not path.is_file():
        raise InvalidValueError.of(str(path), "a plan", "none", "plan or run the study first")
    lines = _read(path)
    finished, failed = store.keys(), store.failed()
    others = sorted(other for other in path.parent.glob("*.json") if other != path)
    known = _keys([*others, path])  # what another plan has done, this one knows
    coded = {identity: known.get(identity, ("", "")) for identity, *_ in lines}
    keys = {name: coded[name][1] if _code_of(kind) == coded[name][0] else "" for name, kind, *_ in lines}
    earlier = {identity: before for identity, _, before, *_ in lines}

    @functools.cache
    def is_done(identity: str) -> bool:
        """Whether a job is done with all before it: where one of these has changed, the key is of what it was."""
        return keys[identity] in finished and all(map(is_done, earlier[identity]))

    def state(identity: str) -> str:
        if is_done(identity):
            return "done"
        if keys[identity] and store.is_held(keys[identity]):
            return "running"
        if keys[identity] in failed:
            return "failed"
        return "ready" if all(map(is_done, earlier[identity])) else "waiting"

    return [
        Entry(labels=tuple(labels), kind=kind, state=state(identity), key=keys[identity])
        for identity, kind, _, labels, *_ in lines
    ]
