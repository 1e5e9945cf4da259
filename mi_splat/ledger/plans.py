"""Plans: which jobs there are, those among them that depend on the results of others,
and what drives them.
"""

import asyncio
import time
from collections.abc import Generator, Iterable, Mapping
from typing import Any

from mi_splat.ledger.engines import Engine
from mi_splat.ledger.job import Done, EngineError, Job, Outcome, Task
from mi_splat.ledger.running import task_for
from mi_splat.ledger.states import note_keys

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
