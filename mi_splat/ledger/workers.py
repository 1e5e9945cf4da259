"""What a worker of a Dask cluster does with a task, and how it keeps to its limits."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import os
import platform
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from distributed import Worker, get_worker

from mi_splat.ledger.job import DiskFullError, EngineError, Event, Outcome, Task
from mi_splat.ledger.running import note_failure, run_job
from mi_splat.ledger.store import Store
from mi_splat.process_group import GROUP_FOLDER, Limits
from mi_splat.processes import keep_to, share_of_cores

EVENT = "event"  # key of an event in what is sent; Dask puts others beside it
_BETWEEN = 0.1  # least seconds between two reports of progress
_FLUSH = 0.3  # seconds in which a last event leaves a process that is ended
_OVERTIME = 3  # exit status of a process whose job took too long

_OURS = "MI_SPLAT_"
_ONE_JOB = threading.Lock()  # Mitsuba's variant is one of the process
_WORN = threading.Event()
_STOPPED: set[str] = set()
_FOR_GOOD = contextlib.ExitStack()


@dataclass(frozen=True, kw_only=True)
class Terms:
    """How the workers of a run do its tasks.

    Attributes:
        store: Absolute path of the store, which all workers share.
        folder: Working directory of the command, for relative paths.
        run: Name of the run, and of the topic of its events.
        limits: What a job may use.
        variables: Those of the environment that are this program's.
        cores: Cores of this machine that the workers share; none leaves the choice to
            whoever has started a worker.
        sharing: How many workers share them.
    """

    store: str
    folder: str
    run: str
    limits: Limits
    variables: Mapping[str, str]
    cores: Sequence[int] = ()
    sharing: int = 1


def attempt(task: Task, terms: Terms) -> Outcome:
    """Try a task once, in a worker."""
    store = Store(Path(terms.store))
    if not store.folder.is_dir():
        expected = "a folder that every worker can write"
        got = f"no folder on {platform.node()}"
        do = "put the store on a disk that all machines share, under the same path"
        raise EngineError.of(terms.store, expected, got, do)
    with _ONE_JOB:
        worker = get_worker()
        if _WORN.is_set() and worker.nanny is not None:
            # What a process keeps of one job must not count against the next, which
            # has not begun here, and goes to a new process.
            os._exit(0)
        _take_variables(terms.variables)
        with contextlib.suppress(OSError):  # then only absolute paths can be read
            os.chdir(terms.folder)
        _keep_kernels(store.folder)
        if terms.cores:
            keep_to(share_of_cores(terms.cores, worker.name, terms.sharing))
        reporter = _Reporter(worker, store, task, terms)
        is_worn = False
        try:
            outcome = run_job(store, task, reporter.tell)
        except KeyboardInterrupt:
            outcome = Outcome(state="stopped", text="it was interrupted")
        except DiskFullError as error:
            outcome = Outcome(state="stopped", text=str(error))
        except Exception:  # noqa: BLE001  # it is noted, and the job is tried again
            outcome = Outcome(state="again")
            is_worn = True
        finally:
            reporter.close()
        if is_worn or _is_heavy(worker, terms):
            _WORN.set()
    return outcome


def stop(run: str) -> None:
    """End the jobs of a run in this worker, each at its next report of progress."""
    _STOPPED.add(run)


class _Reporter:
    """Sends the events of a task, and ends this process if the task takes too long."""

    def __init__(self, worker: Worker, store: Store, task: Task, terms: Terms) -> None:
        self._worker = worker
        self._store = store
        self._task = task
        self._terms = terms
        self._last = 0.0
        self._timer = threading.Timer(terms.limits.seconds or 0.0, self._expire)
        self._timer.daemon = True

    def tell(self, event: Event) -> None:
        """Send an event; raises where the run was interrupted."""
        if self._terms.run in _STOPPED:
            raise KeyboardInterrupt
        if event.state == "running" and self._terms.limits.seconds is not None:
            self._timer.start()  # what was imported before is not the task's
        now = time.monotonic()
        if event.state == "progress" and now - self._last < _BETWEEN:
            return
        self._last = now
        self._send(event)

    def _send(self, event: Event) -> None:
        self._worker.log_event(self._terms.run, {EVENT: dataclasses.asdict(event)})

    def _expire(self) -> None:
        seconds = self._terms.limits.seconds or 0.0
        text = f"ran longer than {seconds:g} s"
        event = note_failure(self._store, self._task, text, seconds)
        self._send(event)
        self._store.release(self._task.key)  # so that its end is not counted again
        time.sleep(_FLUSH)
        os._exit(_OVERTIME)

    def close(self) -> None:
        """The task has ended."""
        self._timer.cancel()


def _is_heavy(worker: Worker, terms: Terms) -> bool:
    most = terms.limits.megabytes
    return most is not None and worker.monitor.get_process_memory() > most / 2 * 1e6


@functools.cache
def _keep_kernels(store: Path) -> None:
    """Have Dr.Jit keep its compiled kernels where no other process does."""
    kernels = Store(store).free_kernels(itertools.count(), _FOR_GOOD)
    os.environ["DRJIT_CACHE_DIR"] = str(kernels)


def own_variables() -> dict[str, str]:
    """What the environment says to this program, such as which weights to take."""
    return {
        name: value
        for name, value in os.environ.items()
        if name.startswith(_OURS) and name != GROUP_FOLDER
    }


def _take_variables(variables: Mapping[str, str]) -> None:
    """Have the variables that whoever runs the jobs has, and none of an earlier run."""
    for name in own_variables().keys() - variables.keys():
        del os.environ[name]
    os.environ.update(variables)
