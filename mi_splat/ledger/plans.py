"""Plans: which jobs there are, those among them that depend on the results of others, and what drives them."""

import asyncio
import contextlib
import functools
import json
import statistics
import time
from collections import Counter
from collections.abc import Generator, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_splat.errors import InvalidValueError
from mi_splat.import_closure import code_digest
from mi_splat.io.documents import save_text
from mi_splat.io.parsing import DocumentReader
from mi_splat.ledger.engines import Engine
from mi_splat.ledger.job import Done, EngineError, Event, Job, OnEvent, Outcome, Task, nobody
from mi_splat.ledger.running import looked_up, task_for
from mi_splat.ledger.store import TRIES, Store, checked_key

STATES = ("waiting", "ready", "running", "done", "failed")
"""For others before it; for an engine; for its end; for nothing; for somebody who mends it."""
_OFTEN = 5.0  # least seconds between two writings of a list of jobs that grows
_MEASURED = 200  # most finished jobs that tell how long one takes
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


Result = Done | str  # how a job of a plan ended: what it left, or why it has failed
Plan = Generator[Mapping[str, Job], Mapping[str, Result] | None, None]
"""Yields jobs by their labels, and is sent their results once all of them have ended; ends when it wants no more."""
_POLL = 0.5  # seconds between two looks at a job that another process does


def grid(jobs: Mapping[str, Job]) -> Plan:
    """The plan of jobs that are all known."""
    yield jobs


class Driver:
    """Gives the jobs of plans to an engine, the ones before the others, until all have ended.

    Each job is a coroutine that waits for those which it reads, and then for a free place of the engine.
    """

    def __init__(self, folder: Path, engine: Engine, *, name: str = "", on_event: OnEvent = nobody) -> None:
        self._store, self._engine, self._on_event = Store(folder), engine, on_event
        self._index = Index(self._store, name) if name else None
        self._results: dict[str, Result] = {}
        self._jobs: dict[str, asyncio.Task[Result]] = {}
        self._keys: dict[str, str] = {}
        self._running: set[str] = set()
        self._error: BaseException | None = None
        self._free = asyncio.Semaphore(engine.window)

    def run(self, plans: Iterable[Plan]) -> dict[str, Result]:
        """Results by labels."""
        self._store.sweep()
        loop = asyncio.new_event_loop()  # not `asyncio.run`, which keeps Ctrl-C from a job in this process
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
            if self._index is not None:
                self._index.write()
        return self._results

    async def _all(self, plans: Iterable[Plan]) -> None:
        await asyncio.gather(*map(self._follow, plans))

    async def _ended(self, waiting: Iterable[asyncio.Task[Any]]) -> None:
        """Come to the end of all coroutines, whatever they raise."""
        await asyncio.gather(*waiting, *self._jobs.values(), return_exceptions=True)

    async def _follow(self, plan: Plan) -> None:
        """Do what a plan asks for and send it the results, until it asks for nothing."""
        results: dict[str, Result] | None = None
        while True:
            try:
                asked = plan.send(results)
            except StopIteration:
                return
            jobs = {label: self._job(job, label) for label, job in asked.items()}
            results = dict(zip(jobs, await asyncio.gather(*jobs.values()), strict=True))
            self._results.update(results)

    def _job(self, job: Job, label: str = "") -> asyncio.Task[Result]:
        """The coroutine of a job, begun with those of all before it if the job is new."""
        if job.identity not in self._jobs:
            before = [(needed, self._job(needed)) for needed in job.before]
            if self._index is not None:  # after those before it: whenever the index is read, it is whole
                self._index.add(job)
            self._jobs[job.identity] = asyncio.get_running_loop().create_task(self._done(job, before))
        if label and self._index is not None:
            self._index.add(job, label)
        return self._jobs[job.identity]

    async def _done(self, job: Job, before: Iterable[tuple[Job, asyncio.Task[Result]]]) -> Result:
        """The result of a job; what reads a failed one has failed as well."""
        finished: dict[str, Done] = {}
        for needed, coroutine in before:
            result = await coroutine
            if isinstance(result, str):
                name = " ".join([needed.kind, self._keys.get(needed.identity, "")]).strip()
                return f"not tried, as it reads {name}, which has failed"
            finished[needed.identity] = result
        task = task_for(job, self._store, finished)
        self._keys[job.identity] = task.key
        if self._index is not None:
            self._index.set_key(job, task)
        while (ended := await self._tried(task)) is None:
            await asyncio.sleep(_POLL)
        return ended

    async def _tried(self, task: Task) -> Result | None:
        """The result of a task, tried until it has failed for good; None while another process does it."""
        async with self._free:
            if self._error is not None:
                raise asyncio.CancelledError
            if self._store.has(task.key):
                self._on_event(Event(state="kept", key=task.key, kind=task.kind))
                return self._store.existing(task.key)
            while len(tries := self._store.failures(task.key)) < TRIES:
                if task.key in self._running or self._store.is_held(task.key):
                    return None
                self._running.add(task.key)
                outcome = await self._outcome(task)
                self._running.discard(task.key)
                if outcome.state == "done":
                    return self._store.existing(task.key)
                if outcome.state == "held":
                    return None
                if outcome.state == "stopped":
                    raise EngineError(outcome.text)
            why: str = tries[-1]["error"]
            return why

    async def _outcome(self, task: Task) -> Outcome:
        """How the engine's try of a task ended; what it raises ends all coroutines first, and then the run."""
        try:
            return await asyncio.wrap_future(self._engine.submit(task))
        except BaseException as error:
            self._error = self._error or error
            raise asyncio.CancelledError from error
