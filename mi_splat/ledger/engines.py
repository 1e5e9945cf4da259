"""What runs tasks on one machine: this process, or child processes that are watched."""

import contextlib
import itertools
import os
import platform
import queue
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Protocol

from mi_splat.io.errors import SplatFileError
from mi_splat.io.locks import locked_folder
from mi_splat.ledger.child import Child, Limits
from mi_splat.ledger.job import Event, HeldError, OnEvent, Outcome, Task, nobody
from mi_splat.ledger.running import run_job
from mi_splat.ledger.store import Store

_OTHERS = 0.02
"""Seconds in which a task that is alone waits for others, before it takes all cores."""


class Engine(Protocol):
    """Runs tasks of a store."""

    window: int

    def submit(self, task: Task) -> Future[Outcome]:
        """Run a task some time; the future raises what is the engine's own error, and none of a job's."""
        ...

    def close(self) -> None:
        """End all that it has started, at once."""
        ...


class InProcess:
    """Runs each task in this process, at once; what a job raises ends the plan."""

    window = 1

    def __init__(self, folder: Path, *, on_event: OnEvent = nobody) -> None:
        self._store, self._on_event = Store(folder), on_event

    def submit(self, task: Task) -> Future[Outcome]:
        """Run a task now."""
        outcome: Future[Outcome] = Future()
        try:
            run_job(self._store, task, self._on_event)
            outcome.set_result(Outcome(state="done"))
        except HeldError as error:
            outcome.set_result(Outcome(state="held", text=str(error)))
        return outcome

    def close(self) -> None:
        """Nothing is left."""


class Processes:
    """Runs tasks in child processes, each watched by a thread.

    torch has one thread in each of them; Dr.Jit has the task's share of the processor's cores, which is all of them
    while no other task is there, and a cache of kernels of its own in the store, so that no two write into the same
    one.
    """

    def __init__(self, folder: Path, *, workers: int, limits: Limits | None = None, on_event: OnEvent = nobody) -> None:
        self.window = workers
        self._told, self._on_event, self._caches = threading.Lock(), on_event, contextlib.ExitStack()
        self._idle: queue.SimpleQueue[Child] = queue.SimpleQueue()
        numbers = itertools.count()
        self._children = [
            Child(folder, limits=limits, environment=environment(free_cache(folder, numbers, self._caches)))
            for _ in range(workers)
        ]
        for child in self._children:
            self._idle.put(child)
        self._threads = ThreadPoolExecutor(workers)
        self._counted, self._given, self._shares = threading.Lock(), 0, set[int]()

    def submit(self, task: Task) -> Future[Outcome]:
        """Run a task as soon as a child process is free."""
        with self._counted:
            self._given += 1
        return self._threads.submit(self._run, task)

    def _run(self, task: Task) -> Outcome:
        child = self._idle.get()
        if self._given == 1:
            time.sleep(_OTHERS)
        with self._counted:
            share = min(set(range(self.window)) - self._shares)
            self._shares.add(share)
            cores = share_of_cores(share, min(self._given, self.window))
        try:
            return child.run(task, self._tell, cores=cores)
        finally:
            with self._counted:
                self._given -= 1
                self._shares.remove(share)
            self._idle.put(child)

    def _tell(self, event: Event) -> None:
        with self._told:
            self._on_event(event)

    def close(self) -> None:
        """End the child processes; what they were at counts as no try."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        for child in self._children:
            child.stop()
        self._threads.shutdown()
        for child in self._children:
            child.close()
        self._caches.close()


def environment(kernels: Path) -> dict[str, str]:
    """Variables of a child process."""
    return {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "DRJIT_CACHE_DIR": str(kernels.absolute())}


def share_of_cores(worker: int, workers: int) -> list[int]:
    """Numbers of the cores that one of some workers may use; none, which is all, where the system cannot say."""
    if not hasattr(os, "sched_getaffinity"):
        return []
    cores = sorted(os.sched_getaffinity(0))
    return cores[worker % len(cores) :: workers]


def free_cache(folder: Path, numbers: Iterator[int], held: contextlib.ExitStack) -> Path:
    """The first folder for compiled kernels that no other process of this machine uses."""
    for number in numbers:
        cache = folder / "kernels" / f"{platform.node()}-{number}"
        with contextlib.suppress(SplatFileError):
            held.enter_context(locked_folder(cache))
            return cache
    raise AssertionError("numbers do not end")
