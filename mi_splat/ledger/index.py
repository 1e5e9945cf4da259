"""Labels of jobs, and how far each job is: files beside the results, which no key depends on."""

from __future__ import annotations

import json
import statistics
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from mi_splat.errors import InvalidValueError, message
from mi_splat.import_closure import code_digest
from mi_splat.io.documents import save_text
from mi_splat.io.parsing import DocumentReader
from mi_splat.ledger.job import Done, Job
from mi_splat.ledger.running import task_for
from mi_splat.ledger.store import Store

STATES = ("waiting", "ready", "running", "done", "failed")
"""For others before it; for an engine; for its end; for nothing; for somebody who mends it."""
_OFTEN = 5.0
"""Least seconds between two writings of a list of jobs that grows."""
_MEASURED = 200
"""Most finished jobs that tell how long one takes."""
_READER = DocumentReader(expected="a list of jobs", do="plan the study again", most=1 << 30)


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A job of an index.

    Attributes:
        labels: What the plan calls it; empty if only other jobs ask for it.
        kind: Of the job.
        state: One of `STATES`.
        key: Empty while it is not known, as what it reads is not done.
    """

    labels: tuple[str, ...]
    kind: str
    state: str
    key: str


class Index:
    """The jobs of a plan by name, and the keys of all jobs of a store.

    Args:
        folder: The store.
        name: Of the plan.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self._path, self._keys_path = folder / "plans" / f"{name}.json", folder / "plans" / "keys"
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._jobs: dict[str, tuple[str, list[str], list[str]]] = {}
        self._keys = read_keys(folder)
        self._written = time.monotonic()
        self._changed = False

    def add(self, job: Job, label: str = "") -> None:
        """A job of the plan, under one more label."""
        if job.identity not in self._jobs:
            self._jobs[job.identity] = (job.kind, [other.identity for other in job.before], [])
            self._changed = True
        labels = self._jobs[job.identity][2]
        if label and label not in labels:
            labels.append(label)
            self._changed = True
        if time.monotonic() - self._written > _OFTEN:
            self.write()

    def set_key(self, job: Job, code: str, key: str) -> None:
        """The key of a job whose inputs are done."""
        if self._keys.get(job.identity) != (code, key):
            self._keys[job.identity] = (code, key)
            with self._keys_path.open("a") as file:
                file.write(f"{job.identity} {code} {key}\n")

    def write(self) -> None:
        """Write the list of jobs, if it has grown."""
        if self._changed:
            save_text(json.dumps([[name, *rest] for name, rest in self._jobs.items()]), self._path)
            self._written, self._changed = time.monotonic(), False


def plan(store: Store, name: str, jobs: Mapping[str, Job]) -> list[Entry]:
    """Write down the jobs of a plan by their labels, and all before them, and look how far each is.

    Raises:
        InvalidValueError: An input is not there, or a finished job was changed.
    """
    index, results = Index(store.folder, name), dict[str, Done | None]()
    for label, job in jobs.items():
        _resolve(job, store, index, results)
        index.add(job, label)
    index.write()
    return status(store, name)


def _resolve(job: Job, store: Store, index: Index, results: dict[str, Done | None]) -> None:
    """Look up a job, those before it first; what reads one that is not done has no key yet."""
    if job.identity in results:
        return
    for needed in job.before:
        _resolve(needed, store, index, results)
    index.add(job)
    finished = {needed.identity: done for needed in job.before if (done := results[needed.identity]) is not None}
    results[job.identity] = None
    if all(needed.identity in finished for needed in job.before):
        task = task_for(job, store, finished)
        index.set_key(job, task.code, task.key)
        results[job.identity] = store.done(task.key)


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


def read_keys(folder: Path) -> dict[str, tuple[str, str]]:
    """Code and key of every job, by its identity, as the drivers have last known them."""
    path = folder / "plans" / "keys"
    lines = path.read_text().splitlines() if path.is_file() else []
    return {parts[0]: (parts[1], parts[2]) for parts in map(str.split, lines) if len(parts) == 3}


def status(store: Store, name: str) -> list[Entry]:
    """The jobs of a plan and their states, as of its last planning.

    Raises:
        InvalidValueError: There is no such plan.
    """
    path = store.folder / "plans" / f"{name}.json"
    if not path.is_file():
        raise InvalidValueError(message(str(path), "a plan", "none", "plan or run the study first"))
    jobs, keys = _READER.read_json_value(path), read_keys(store.folder)
    digests = {kind: code_digest(kind) for kind in {kind for _, kind, _, _ in jobs}}
    finished, live, failed = store.keys(), store.leases.live(), store.failed()
    known = {name: keys[name][1] for name, kind, _, _ in jobs if name in keys and keys[name][0] == digests[kind]}
    earlier = {name: before for name, _, before, _ in jobs}
    done: dict[str, bool] = {}

    def is_done(name: str) -> bool:
        """Whether a job is done with all before it: where one of these has changed, the key is of what it was."""
        if name not in done:
            done[name] = known.get(name) in finished and all(is_done(other) for other in earlier[name])
        return done[name]

    entries = []
    for name, kind, before, labels in jobs:
        key = known.get(name, "")
        if is_done(name):
            state = "done"
        elif key in live:
            state = "running"
        elif key in failed:
            state = "failed"
        else:
            state = "ready" if all(map(is_done, before)) else "waiting"
        entries.append(Entry(labels=tuple(labels), kind=kind, state=state, key=key))
    return entries
