"""Plans: which jobs there are, those among them that depend on the results of others,
and what drives them.
"""

import asyncio
import contextlib
import json
import statistics
import time
from collections import Counter
from collections.abc import Generator, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import save_text
from mi_splat.io.parsing import DocumentReader
from mi_splat.ledger.engines import Engine
from mi_splat.ledger.job import (
    Done,
    EngineError,
    Job,
    Outcome,
    Task,
)
from mi_splat.ledger.running import lookup, task_for
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


def plan(store: Store, name: str, jobs: Mapping[str, Job]) -> list[Entry]:
    """The states of the jobs of a plan, whose keys are noted."""
    entries = status(store, jobs)
    note_keys(store, name, (entry.key for entry in entries if entry.key))
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


Result = Done | str  # how a job of a plan ended: what it left, or why it has failed
Plan = Generator[Mapping[str, Job], Mapping[str, Result] | None, None]
"""Yields jobs by their labels, and is sent their results once all of them have ended;
ends when it wants no more.
"""
_VISIBLE = 60.0  # seconds after which a network disk shows what others have written
_POLL = 0.5  # seconds between two looks at a job that another process does


def grid(jobs: Mapping[str, Job]) -> Plan:
    """The plan of jobs that are all known."""
    yield jobs


class Driver:
    """Gives the jobs of plans to an engine, the ones before the others, until all have
    ended.
    """

    def __init__(self, engine: Engine, *, name: str = "") -> None:
        self._store = engine.store
        self._engine = engine
        self._name = name
        self._results: dict[str, Result] = {}
        self._jobs: dict[str, asyncio.Task[Result]] = {}
        self._keys: dict[str, str] = {}
        self._free = asyncio.Semaphore(engine.window)
        self._error: BaseException | None = None

    def run(self, plans: Iterable[Plan]) -> dict[str, Result]:
        """Results by labels."""
        self._store.sweep()
        # not `asyncio.run`, which keeps Ctrl-C from a job in this process
        loop = asyncio.new_event_loop()
        try:
            loop.run_until_complete(self._all(plans))
        except asyncio.CancelledError:
            assert self._error is not None
            raise self._error from self._error.__cause__
        finally:
            self._engine.close()
            waiting = asyncio.all_tasks(loop)
            for coroutine in waiting:
                coroutine.cancel()
            loop.run_until_complete(self._ended(waiting))
            loop.close()
            if self._name:
                note_keys(self._store, self._name, self._keys.values())
        return self._results

    async def _all(self, plans: Iterable[Plan]) -> None:
        await asyncio.gather(*map(self._follow, plans))

    async def _ended(self, waiting: Iterable[asyncio.Task[Any]]) -> None:
        """Come to the end of all coroutines, whatever they raise."""
        await asyncio.gather(*waiting, *self._jobs.values(), return_exceptions=True)

    async def _follow(self, plan: Plan) -> None:
        """Do what a plan asks for and send it the results, until it asks for
        nothing.
        """
        results: dict[str, Result] | None = None
        while True:
            try:
                wanted = plan.send(results)
            except StopIteration:
                return
            jobs = {label: self._job(job) for label, job in wanted.items()}
            results = dict(zip(jobs, await asyncio.gather(*jobs.values()), strict=True))
            self._results.update(results)

    def _job(self, job: Job) -> asyncio.Task[Result]:
        """The coroutine of a job, begun with those of all before it if the job is
        new.
        """
        if job.identity not in self._jobs:
            before = [(needed, self._job(needed)) for needed in job.before]
            self._jobs[job.identity] = asyncio.get_running_loop().create_task(
                self._done(job, before)
            )
        return self._jobs[job.identity]

    async def _done(
        self, job: Job, before: Iterable[tuple[Job, asyncio.Task[Result]]]
    ) -> Result:
        """The result of a job; what reads a failed one has failed as well."""
        finished: dict[str, Done] = {}
        for needed, coroutine in before:
            result = await coroutine
            if isinstance(result, str):
                name = " ".join(
                    [needed.kind, self._keys.get(needed.identity, "")]
                ).strip()
                return f"not tried, as it reads {name}, which has failed"
            finished[needed.identity] = result
        task = task_for(job, self._store, finished)
        self._keys[job.identity] = task.key
        if self._store.has(task.key):
            self._engine.on_event(task.event("kept"))
            return self._store.existing(task.key)
        outcome = await self._outcome(task)
        if outcome.state == "failed":
            return outcome.text
        if outcome.state == "stopped":
            raise EngineError(outcome.text)
        return await self._shared(task.key)

    async def _outcome(self, task: Task) -> Outcome:
        """How a task ended, tried until it is done or has failed for good."""
        while True:
            await self._free.acquire()
            outcome = await self._attempt(task)
            self._free.release()  # after an error, nothing else is to begin
            if outcome.state not in ("again", "held"):
                return outcome
            if outcome.state == "held":
                await asyncio.sleep(_POLL)

    async def _attempt(self, task: Task) -> Outcome:
        """How a try of a task ended; an error of the engine ends all coroutines first,
        and then the run.
        """
        try:
            return await self._engine.attempt(task)
        except BaseException as error:
            self._error = self._error or error
            raise asyncio.CancelledError from error

    async def _shared(self, key: str) -> Done:
        """A finished job, once this machine sees what another one has written."""
        end = time.monotonic() + _VISIBLE
        while not self._store.has(key) and time.monotonic() < end:
            await asyncio.sleep(_POLL)
        return self._store.existing(key)
