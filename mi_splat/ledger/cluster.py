"""Tasks on many machines, by Dask distributed (`pip install -e '.[cluster]'`).

Each thread of a Dask worker watches a child process, as on one machine: no job can end a worker, and signals and limits
are told by name. All machines see the store at the same path, and have the same code.
"""

from __future__ import annotations

import contextlib
import importlib
import itertools
import threading
from pathlib import Path
from typing import Any

from mi_splat.errors import install, message
from mi_splat.ledger.engines import environment, free_cache
from mi_splat.ledger.job import Event, OnEvent, Task, nobody
from mi_splat.ledger.store import Store
from mi_splat.ledger.watching import Child, EngineError, Limits, Outcome, Report

_WINDOW = 64
"""Most tasks that the scheduler knows at a time."""
_LOST_WORKERS = 3
"""How many workers may be lost with the same task before it is given up."""


class Cluster:
    """Runs tasks on the workers of a Dask scheduler.

    Args:
        folder: The store, as all machines see it.
        scheduler: Address of the scheduler, as `tcp://host:8786`.
        limits: Of each task.
        timeout: Seconds to wait for the scheduler.
        on_event: Told of the end of each task.

    Raises:
        EngineError: Dask is not installed, or there is no such scheduler.
    """

    window = _WINDOW

    def __init__(
        self,
        folder: Path,
        scheduler: str,
        *,
        limits: Limits | None = None,
        timeout: float = 30.0,
        on_event: OnEvent = nobody,
    ) -> None:
        try:
            dask: Any = importlib.import_module("distributed")
        except ImportError as error:
            raise EngineError(message("distributed", "Dask", "none", install("cluster"))) from error
        self._folder, self._limits, self._numbers = str(folder.absolute()), limits or Limits(), itertools.count()
        try:
            self._client = dask.Client(scheduler, timeout=timeout, set_as_default=False)
            self._client.run_on_scheduler(_set_up)
        except (OSError, TimeoutError) as error:
            raise EngineError(
                message(scheduler, "a Dask scheduler", error, "start one, or mend the address")
            ) from error
        self._futures: dict[str, Any] = {}
        self._on_event = on_event

    def submit(self, task: Task, report: Report) -> None:
        """Run a task on some worker."""
        name = f"{task.key}-{next(self._numbers)}"  # a task that is tried again is another one to Dask
        options: dict[str, Any] = {"key": name, "pure": False}
        future = self._client.submit(run_in_child, self._folder, task, self._limits, **options)
        self._futures[name] = future  # Dask forgets a task whose future nobody has
        future.add_done_callback(lambda ended: report(self._outcome(name, task, ended)))

    def _outcome(self, name: str, task: Task, ended: Any) -> Outcome:
        """How a task ended; the scheduler forgets it."""
        self._futures.pop(name, None)
        if ended.status == "finished":
            outcome: Outcome = ended.result()
            ended.release()
            self._on_event(Event(state=outcome.state, key=task.key, kind=task.kind, text=outcome.text))
            return outcome
        error = ended.exception() if ended.status == "error" else None
        text = f"{ended.status} at Dask" if error is None else f"{type(error).__name__}: {error}"
        if type(error).__name__ == "KilledWorker":
            Store(Path(self._folder)).note_failure(task, text, 0.0)
            return Outcome(key=task.key, state="failed", text=text)
        return Outcome(key=task.key, state="stopped", text=text, error=error)

    def close(self) -> None:
        """Have the scheduler forget what no worker has begun; the cluster stays."""
        self._futures.clear()
        self._client.close()


async def _set_up(dask_scheduler: Any) -> None:
    """Tasks wait at the scheduler until a worker is free, and none takes another's."""
    dask_scheduler.WORKER_SATURATION = 1.0
    dask_scheduler.allowed_failures = _LOST_WORKERS
    if (stealing := dask_scheduler.extensions.get("stealing")) is not None:
        await stealing.stop()


_CHILDREN = threading.local()
"""The child process of each thread of a worker."""


def run_in_child(folder: str, task: Task, limits: Limits) -> Outcome:
    """Run a task in the child process of this thread."""
    kept = _CHILDREN.__dict__
    if (child := kept.get(f"{folder} {limits}")) is None:
        held = kept.setdefault("held", contextlib.ExitStack())
        kernels = free_cache(Path(folder), itertools.count(), held)
        child = kept[f"{folder} {limits}"] = Child(Path(folder), limits=limits, environment=environment(kernels))
    outcome: Outcome = child.run(task)
    return outcome
