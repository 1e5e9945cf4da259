"""What runs tasks: this process, or the workers of a Dask cluster."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import logging
import os
import time
import uuid
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from mi_splat.errors import message, one_line
from mi_splat.ledger.job import (
    EngineError,
    EngineWarning,
    Event,
    OnEvent,
    Outcome,
    Task,
    nobody,
)
from mi_splat.ledger.running import run_job
from mi_splat.ledger.store import TRIES, Store
from mi_splat.process_group import GroupEndedError, Limits, ProcessGroup
from mi_splat.processes import own_cores

if TYPE_CHECKING:
    from distributed import Client, Security

    from mi_splat.ledger.workers import Terms

_GRACE = 8.0  # seconds that an interrupted job has to write down how far it is
_CONNECTING = 10.0  # seconds in which a scheduler has to answer
_STARTING = Limits(seconds=120.0)
_PLENTY = 1 << 20  # a scheduler decides itself how many tasks its workers can take


class Engine(Protocol):
    """Runs tasks of a store.

    Attributes:
        store: The store.
        on_event: Is called with what happens to jobs.
        window: How many tasks it may be given at a time.
    """

    store: Store
    on_event: OnEvent
    window: int

    async def attempt(self, task: Task) -> Outcome:
        """Try a task once; raises what is the engine's own error."""
        ...

    def close(self) -> None:
        """End all that it has started, at once."""
        ...


class InProcess:
    """Runs each task in this process, at once; what a job raises ends the plan."""

    window = 1

    def __init__(self, folder: Path, *, on_event: OnEvent = nobody) -> None:
        self.store = Store(folder)
        self.on_event = on_event

    async def attempt(self, task: Task) -> Outcome:
        """Run a task now."""
        return run_job(self.store, task, self.on_event)

    def close(self) -> None:
        """Nothing is left."""


def _check_keys(security: Security) -> None:
    """Raise unless there are keys for TLS, without which a client ends late."""
    if security.get_connection_args("client").get("ssl_context") is None:
        raise ValueError("no keys for TLS in the configuration of Dask")


def engine_for(
    folder: Path,
    *,
    workers: int,
    scheduler: str = "",
    limits: Limits | None = None,
    on_event: OnEvent = nobody,
) -> Engine:
    """An engine for a store: this process if there are 0 workers, else a cluster."""
    if workers == 0 and not scheduler:
        return InProcess(folder, on_event=on_event)
    return Cluster(
        folder, workers=workers, scheduler=scheduler, limits=limits, on_event=on_event
    )


class Cluster:
    """Runs tasks on the workers of a Dask cluster.

    Without the address of a scheduler, a cluster of this machine starts with the first
    task, and ends with the engine.
    """

    def __init__(
        self,
        folder: Path,
        *,
        workers: int = 1,
        scheduler: str = "",
        limits: Limits | None = None,
        on_event: OnEvent = nobody,
    ) -> None:
        self.window = _PLENTY if scheduler else workers
        self.store = Store(folder)
        self.on_event = on_event
        self._scheduler = scheduler
        self._limits = limits or Limits()
        self._run = f"mi-splat-{uuid.uuid4().hex}"
        self._cores = () if scheduler else tuple(own_cores())
        self._given = 0
        self._open: set[concurrent.futures.Future[Outcome]] = set()
        self._group: ProcessGroup | None = None
        self._client: Client | None = None

    async def attempt(self, task: Task) -> Outcome:
        """Try a task once, in a worker."""
        self._given += 1
        try:
            await asyncio.sleep(0)  # others that are ready now are given as well
            client = self._client or self._connected()
            return await self._attempted(client, task)
        finally:
            self._given -= 1

    async def _attempted(self, client: Client, task: Task) -> Outcome:
        """How a try of a task ended; a worker that has died with it tries it again."""
        from distributed import KilledWorker

        killed = ""
        for _ in range(TRIES):
            waiting = self._submitted(client, task)
            self._open.add(waiting)
            try:
                return await asyncio.wrap_future(waiting)
            except KilledWorker as error:
                killed = one_line(str(error), 300)
            except EngineError:
                raise
            except (Exception, asyncio.CancelledError) as error:
                if client.status != "running":
                    raise self._lost() from error
                if isinstance(error, asyncio.CancelledError):
                    raise
                got = f"{type(error).__name__}: {one_line(str(error), 300)}"
                do = "install the same packages on all machines"
                expected = "one that can run jobs"
                raise EngineError.of("Dask worker", expected, got, do) from error
            finally:
                self._open.discard(waiting)
        do = "see the logs of the workers"
        raise EngineError.of("Dask workers", "some that stay", killed, do)

    def _submitted(
        self, client: Client, task: Task
    ) -> concurrent.futures.Future[Outcome]:
        from mi_splat.ledger.workers import attempt

        name = f"{task.kind}-{task.key}-{uuid.uuid4().hex}"
        future = client.submit(attempt, task, self._terms(), key=name)
        gathered = client.gather(future, asynchronous=True)
        return asyncio.run_coroutine_threadsafe(gathered, client.loop.asyncio_loop)

    def _terms(self) -> Terms:
        from mi_splat.ledger.workers import Terms, own_variables

        return Terms(
            store=str(self.store.folder.absolute()),
            folder=os.getcwd(),
            run=self._run,
            limits=self._limits,
            variables=own_variables(),
            cores=self._cores,
            sharing=1 if self._given == 1 else self.window,
        )

    def _lost(self) -> EngineError:
        name = self._scheduler or "Dask scheduler of this machine"
        do = "start it again if need be, then repeat the command: it resumes"
        return EngineError.of(name, "a scheduler that answers", "none any more", do)

    def _connected(self) -> Client:
        """A client of the scheduler, which is started if there is none."""
        from distributed import Client, Security

        from mi_splat.ledger.workers import EVENT

        # What it says of lost connections is said in our errors.
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL + 1)
        self.store.folder.mkdir(parents=True, exist_ok=True)
        address = self._scheduler
        security = None
        if not address:
            address, security = self._started()
        keys = security or Security()
        try:
            if address.startswith("tls"):
                _check_keys(keys)
            client = Client(
                address, security=keys, set_as_default=False, timeout=_CONNECTING
            )
        except (OSError, ValueError, TypeError, RuntimeError) as error:
            do = "start one with the command dask scheduler, or check the address"
            got = one_line(str(error), 300)
            expected = "the address of a Dask scheduler that answers"
            raise EngineError.of(f"scheduler {address}", expected, got, do) from error
        loop = asyncio.get_running_loop()

        def tell(event: tuple[float, Mapping[str, Any]]) -> None:
            loop.call_soon_threadsafe(self.on_event, Event(**event[1][EVENT]))

        client.subscribe_topic(self._run, tell)
        if self._scheduler and not client.scheduler_info()["workers"]:
            expected = "a scheduler with workers"
            do = f"start some with dask worker {address}; jobs wait until one comes"
            text = message(f"scheduler {address}", expected, "none yet", do)
            warnings.warn(text, EngineWarning, stacklevel=2)
        self._client = client
        return client

    def _started(self) -> tuple[str, Any]:
        """Address of the scheduler of a new cluster, and the keys to it."""
        megabytes = self._limits.megabytes or 0.0
        module = "mi_splat.ledger.local_cluster"
        self._group = ProcessGroup(module, str(self.window), str(megabytes))
        try:
            self._group.wait(_STARTING, time.monotonic())
            address, security = self._group.pipe.recv()
        except (GroupEndedError, EOFError, OSError) as error:
            why = str(self._group.ended() if isinstance(error, EOFError) else error)
            do = "see what it says"
            expected = "one that starts"
            raise EngineError.of("Dask cluster", expected, why, do) from error
        return address, security

    def close(self) -> None:
        """End all that it has started; what was interrupted counts as no try."""
        client = self._client
        self._client = None
        try:
            if client is not None and client.status == "running" and self._open:
                self._interrupt(client)
        finally:
            if client is not None:
                client.close(timeout=1)
            if self._group is not None:
                self._group.close()

    def _interrupt(self, client: Client) -> None:
        """Let jobs write down how far they are."""
        from mi_splat.ledger.workers import stop

        with contextlib.suppress(Exception):  # workers may be gone, too
            client.run(stop, self._run)
        concurrent.futures.wait(list(self._open), _GRACE)
