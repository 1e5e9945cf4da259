"""How far the jobs of a plan are, how long the rest takes, and which jobs a plan has
used.
"""

import contextlib
import json
import statistics
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import save_text
from mi_splat.io.parsing import DocumentReader
from mi_splat.ledger.job import Job
from mi_splat.ledger.running import lookup
from mi_splat.ledger.store import Store, checked_key

STATES = ("waiting", "ready", "running", "done", "failed")
"""For others before it; for an engine; for its end; for nothing; for somebody who mends
it.
"""
_MEASURED = 200  # most finished jobs that tell how long one takes
_READER = DocumentReader(
    expected="a list of keys", do="plan the study again", most=1 << 30
)


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A job of a plan."""

    labels: tuple[str, ...]
    kind: str
    state: str
    key: str


def status(store: Store, jobs: Mapping[str, Job]) -> list[Entry]:
    """Jobs by their labels, and all before them, each with its state."""
    labels: dict[str, list[str]] = {}
    for label, job in jobs.items():
        labels.setdefault(job.identity, []).append(label)
    entries = []
    failed = store.failed()
    for job, task, done in lookup(jobs.values(), store):
        state = "waiting" if task is None else "ready"
        if done is not None:
            state = "done"
        elif task is not None and store.is_held(task.key):
            state = "running"
        elif task is not None and task.key in failed:
            state = "failed"
        shown = tuple(labels.get(job.identity, ()))
        entries.append(
            Entry(
                labels=shown,
                kind=job.kind,
                state=state,
                key="" if task is None else task.key,
            )
        )
    return entries


def note_keys(store: Store, name: str, keys: Iterable[str]) -> None:
    """Write down, beside the results, which jobs a plan has used."""
    path = store.path("plans") / f"{name}.json"
    known = set[str]()
    path.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(InvalidValueError):  # none, or one that is replaced
        known = planned(store, name)
    save_text(json.dumps(sorted(known.union(keys))), path)


def planned(store: Store, name: str) -> set[str]:
    """Keys of the jobs that a plan has used."""
    path = store.folder / "plans" / f"{name}.json"
    if not path.is_file():
        raise InvalidValueError.of(
            str(path), "a plan", "none", "plan or run the study first"
        )
    keys = _READER.read_json_value(path)
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys):
        raise _READER.broken(str(path), "another document")
    return set(map(checked_key, keys))


def forecast(store: Store, entries: Iterable[Entry]) -> tuple[float, int]:
    """Seconds that the jobs which are not done take one after the other, and how many
    of them nobody can tell.
    """
    done: dict[str, list[str]] = {}
    missing: Counter[str] = Counter()
    for entry in entries:
        if entry.state == "done":
            done.setdefault(entry.kind, []).append(entry.key)
        else:
            missing[entry.kind] += 1
    others = sorted(store.keys())[:_MEASURED] if missing.keys() - done.keys() else []
    seconds = 0.0
    unknown = 0
    for kind, count in missing.items():
        records = [store.record(key) for key in done.get(kind, others)[:_MEASURED]]
        measured = [
            float(record["seconds"]) for record in records if record["kind"] == kind
        ]
        seconds += count * statistics.median(measured) if measured else 0.0
        unknown += 0 if measured else count
    return seconds, unknown
