"""Plans: which jobs there are, those among them that depend on the results of others, and what drives them."""

from __future__ import annotations

import queue
import time
from collections import deque
from collections.abc import Generator, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from mi_splat.ledger.engines import Engine
from mi_splat.ledger.index import Index
from mi_splat.ledger.job import Done, Event, Job, OnEvent, Task, nobody
from mi_splat.ledger.running import task_for
from mi_splat.ledger.store import TRIES, Store
from mi_splat.ledger.watching import EngineError, Outcome

Result = Done | str
"""How a job of a plan ended: what it left, or why it has failed."""
Plan = Generator[Mapping[str, Job], Mapping[str, Result] | None, None]
"""Yields jobs by their labels, and is sent their results once all of them have ended; ends when it wants no more."""
_POLL = 0.5
"""Seconds between two looks at the jobs that other processes do."""


def grid(jobs: Mapping[str, Job]) -> Plan:
    """The plan of jobs that are all known."""
    yield jobs


@dataclass(kw_only=True, eq=False)
class _Node:
    """A job of the graph."""

    job: Job
    missing: int = 0
    after: list[_Node] = field(default_factory=list)
    batches: list[_Batch] = field(default_factory=list)
    task: Task | None = None
    result: Result | None = None


@dataclass(kw_only=True, eq=False)
class _Batch:
    """What a plan has asked for and not got yet."""

    plan: Plan
    nodes: dict[str, _Node]
    missing: int = 0

    def results(self) -> dict[str, Result]:
        """How its jobs have ended."""
        return {label: node.result for label, node in self.nodes.items() if node.result is not None}


class Driver:
    """Gives the jobs of plans to an engine, the ones before the others, until all have ended.

    Args:
        folder: The store.
        engine: What runs them.
        name: Of the index that keeps labels, keys and states; empty for none.
        on_event: Told of jobs that were done before, or have failed for good.
    """

    def __init__(self, folder: Path, engine: Engine, *, name: str = "", on_event: OnEvent = nobody) -> None:
        self._store, self._engine, self._on_event = Store(folder), engine, on_event
        self._index = Index(folder, name) if name else None
        self._results: dict[str, Result] = {}
        self._nodes: dict[str, _Node] = {}
        self._ready: deque[_Node] = deque()
        self._running: dict[str, _Node] = {}
        self._held: deque[tuple[float, _Node]] = deque()
        self._outcomes: queue.SimpleQueue[Outcome] = queue.SimpleQueue()

    def run(self, plans: Iterable[Plan]) -> dict[str, Result]:
        """Results by labels.

        Raises:
            EngineError: The engine does not work.
            MiSplatError: A disk is full, or a finished job was changed.
        """
        self._store.sweep()
        try:
            for plan in plans:
                self._ask(plan, None)
            while self._ready or self._running or self._held:
                self._submit()
                self._collect()
        finally:
            self._engine.close()
            if self._index is not None:
                self._index.write()
        return self._results

    def _ask(self, plan: Plan, results: Mapping[str, Result] | None) -> None:
        """Send a plan what it has waited for, and take in what it asks for next."""
        while True:
            self._results.update(results or {})
            try:
                jobs = plan.send(results)
            except StopIteration:
                return
            batch = _Batch(plan=plan, nodes={label: self._node(job, label) for label, job in jobs.items()})
            unfinished = {id(node): node for node in batch.nodes.values() if node.result is None}
            for node in unfinished.values():
                node.batches.append(batch)
            batch.missing = len(unfinished)
            if unfinished:
                return
            results = batch.results()

    def _node(self, job: Job, label: str = "") -> _Node:
        """A job's place in the graph, made with all before it if it is new."""
        node = self._nodes.get(job.identity)
        if self._index is not None and (node is None or label):
            self._index.add(job, label)
        if node is None:
            node = self._nodes[job.identity] = _Node(job=job)
            before = [self._node(needed) for needed in {needed.identity: needed for needed in job.before}.values()]
            failed = [needed for needed in before if isinstance(needed.result, str)]
            for needed in (needed for needed in before if needed.result is None):
                needed.after.append(node)
                node.missing += 1
            if failed:
                node.result = _blocked(failed[0])
            elif not node.missing:
                self._ready.append(node)
        return node

    def _submit(self) -> None:
        """Give ready jobs to the engine, as many as it takes; those that are done need none."""
        now = time.monotonic()
        while self._held and self._held[0][0] <= now:
            self._ready.appendleft(self._held.popleft()[1])
        while self._ready and len(self._running) < self._engine.window:
            node = self._ready.popleft()
            task = node.task = node.task or self._task(node.job)
            tries = self._store.failures(task.key)
            if self._store.has(task.key):
                self._on_event(Event(state="kept", key=task.key, kind=task.kind))
                self._end(node, self._store.existing(task.key))
            elif len(tries) >= TRIES:
                self._end(node, tries[-1]["error"])
            elif task.key in self._running or not self._store.leases.free(task.key):
                self._held.append((now + _POLL, node))
            else:
                self._running[task.key] = node
                self._engine.submit(task, self._outcomes.put)

    def _task(self, job: Job) -> Task:
        before = {needed.identity: self._nodes[needed.identity].result for needed in job.before}
        task = task_for(job, self._store, {name: done for name, done in before.items() if isinstance(done, Done)})
        if self._index is not None:
            self._index.set_key(job, task.code, task.key)
        return task

    def _collect(self) -> None:
        """Wait for the end of a task, or until it is time to look at those of other processes."""
        if not self._running:
            if self._held and not self._ready:
                time.sleep(max(0.0, self._held[0][0] - time.monotonic()))
            return
        try:
            outcome = self._outcomes.get(timeout=_POLL if self._held else None)
        except queue.Empty:
            return
        node = self._running.pop(outcome.key)
        if outcome.state == "stopped":
            raise EngineError(outcome.text) from outcome.error
        if outcome.state == "done":
            self._end(node, self._store.existing(outcome.key))
        elif outcome.state == "held":
            self._held.append((time.monotonic() + _POLL, node))
        else:
            self._ready.appendleft(node)  # and there, it is found to have failed for good, or tried again

    def _end(self, node: _Node, result: Result) -> None:
        """A job has ended, and with it perhaps what waits for it; what reads a failed one has failed as well."""
        ended = [(node, result)]
        batches: list[_Batch] = []
        while ended:
            node, result = ended.pop()
            if node.result is not None:
                continue
            node.result = result
            for batch in node.batches:
                batch.missing -= 1
                batches += [] if batch.missing else [batch]
            for after in node.after:
                after.missing -= 1
                if isinstance(result, str):
                    ended.append((after, _blocked(node)))
                elif not after.missing and after.result is None:
                    self._ready.append(after)
        for batch in batches:
            self._ask(batch.plan, batch.results())


def _blocked(before: _Node) -> str:
    """Why a job that reads a failed one has failed."""
    name = before.job.kind if before.task is None else f"{before.job.kind} {before.task.key}"
    return f"not tried, as it reads {name}, which has failed"
