"""Tasks on many machines, by Dask distributed (`pip install -e '.[cluster]'`).

Each thread of a Dask worker watches a child process, as on one machine: no job can end a worker, and signals and limits
are told by name. All machines see the store at the same path, and have the same code.
"""

import contextlib
import importlib
import itertools
import threading
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from mi_splat.errors import install
from mi_splat.ledger.engines import Child, Limits, environment, free_cache
from mi_splat.ledger.job import EngineError, Event, OnEvent, Outcome, Task, nobody
from mi_splat.ledger.store import Store

_WINDOW = 64  # most tasks that the scheduler knows at a time
_LOST_WORKERS = 3  # how many workers may be lost with the same task before it is given up


class Cluster:
    """Runs tasks on the workers of a Dask scheduler."""

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
            raise EngineError.of("distributed", "Dask", "none", install("cluster")) from error
        self._folder, self._limits, self._numbers = str(folder.absolute()), limits or Limits(), itertools.count()
        try:
            self._client = dask.Client(scheduler, timeout=timeout, set_as_default=False)
            self._client.run_on_scheduler(_set_up)
        except (OSError, TimeoutError) as error:
            raise EngineError.of(scheduler, "a Dask scheduler", error, "start one, or mend the address") from error
        self._futures: dict[str, Any] = {}
        self._on_event = on_event

    def submit(self, task: Task) -> Future[Outcome]:
        """Run a task on a worker of Dask's choice."""
        name = f"{task.key}-{next(self._numbers)}"  # a task that is tried again is another one to Dask
        options: dict[str, Any] = {"key": name, "pure": False}
        outcome: Future[Outcome] = Future()
        # Dask forgets a task whose future nobody has
        self._futures[name] = self._client.submit(run_in_child, self._folder, task, self._limits, **options)
        self._futures[name].add_done_callback(lambda ended: self._end(name, task, ended, outcome))
        return outcome

    def _end(self, name: str, task: Task, ended: Any, outcome: Future[Outcome]) -> None:
        """Say how a task ended; the scheduler forgets it."""
        self._futures.pop(name, None)
        error = ended.exception() if ended.status == "error" else None
        if ended.status == "finished":
            result: Outcome = ended.result()
            ended.release()
            self._on_event(Event(state=result.state, key=task.key, kind=task.kind, text=result.text))
            outcome.set_result(result)
        elif type(error).__name__ == "KilledWorker":
            text = f"KilledWorker: {error}"
            Store(Path(self._folder)).note_failure(task, text, 0.0)
            outcome.set_result(Outcome(state="failed", text=text))
        else:
            outcome.set_exception(error or EngineError(f"{ended.status} at Dask"))

    def close(self) -> None:
        """Make the scheduler forget what no worker has begun; the cluster stays."""
        self._futures.clear()
        self._client.close()


async def _set_up(dask_scheduler: Any) -> None:
    """Tasks wait at the scheduler until a worker is free, and none takes another's."""
    dask_scheduler.WORKER_SATURATION = 1.0
    dask_scheduler.allowed_failures = _LOST_WORKERS
    if (stealing := dask_scheduler.extensions.get("stealing")) is not None:
        await stealing.stop()


_CHILDREN = threading.local()  # the child process of each thread of a worker


def run_in_child(folder: str, task: Task, limits: Limits) -> Outcome:
    """Run a task in the child process of this thread."""
    kept = _CHILDREN.__dict__
    if (child := kept.get(f"{folder} {limits}")) is None:
        held = kept.setdefault("held", contextlib.ExitStack())
        kernels = free_cache(Path(folder), itertools.count(), held)
        child = kept[f"{folder} {limits}"] = Child(Path(folder), limits=limits, environment=environment(kernels))
    outcome: Outcome = child.run(task)
    return outcome
