"""What runs tasks: this process, or child processes that are watched.

`python -m mi_splat.ledger.engines STORE DESCRIPTOR` is such a process: it runs the
tasks that come through a socket. It ends with the first job that raises, so that the
next one has a new process, and at once when who watches it ends.
"""

import contextlib
import itertools
import os
import platform
import queue
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Protocol

from mi_splat.io.folders import LockedError, locked_folder
from mi_splat.ledger.job import (
    DiskFullError,
    EngineError,
    Event,
    HeldError,
    OnEvent,
    Outcome,
    Task,
    nobody,
)
from mi_splat.ledger.running import run_job
from mi_splat.ledger.store import Store
from mi_splat.process_group import (
    GroupEndedError,
    Limits,
    ProcessGroup,
    connection,
    inbox,
)
from mi_splat.processes import TERMINATED, sigterm_as_interrupt

# seconds in which a task that is alone waits for others, before it takes all cores
_OTHERS = 0.02
_GRACE = 8.0  # seconds that a stopped job has to write down how far it is
_BETWEEN = 0.1  # least seconds between two reports of progress


class Engine(Protocol):
    """Runs tasks of a store."""

    window: int

    def submit(self, task: Task) -> Future[Outcome]:
        """Run a task some time; the future raises what is the engine's own error, and
        none of a job's.
        """
        ...

    def close(self) -> None:
        """End all that it has started, at once."""
        ...


class InProcess:
    """Runs each task in this process, at once; what a job raises ends the plan."""

    window = 1

    def __init__(self, folder: Path, *, on_event: OnEvent = nobody) -> None:
        self._store = Store(folder)
        self._on_event = on_event

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
    """Runs tasks in child processes, each watched by a thread and with its share of the
    processor's cores.
    """

    def __init__(
        self,
        folder: Path,
        *,
        workers: int,
        limits: Limits | None = None,
        on_event: OnEvent = nobody,
    ) -> None:
        self.window = workers
        self._reporting, self._on_event, self._caches = (
            threading.Lock(),
            on_event,
            contextlib.ExitStack(),
        )
        self._idle: queue.SimpleQueue[Child] = queue.SimpleQueue()
        numbers = itertools.count()
        self._children = [
            Child(
                folder,
                limits=limits,
                environment=environment(free_cache(folder, numbers, self._caches)),
            )
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
        with self._reporting:
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
    return {
        "OMP_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "DRJIT_CACHE_DIR": str(kernels.absolute()),
    }


def share_of_cores(worker: int, workers: int) -> list[int]:
    """Numbers of the cores that one of some workers may use; none, which is all, where
    the system cannot say.
    """
    if not hasattr(os, "sched_getaffinity"):
        return []
    cores = sorted(os.sched_getaffinity(0))
    return cores[worker % len(cores) :: workers]


def free_cache(
    folder: Path, numbers: Iterator[int], held: contextlib.ExitStack
) -> Path:
    """The first folder for compiled kernels that no other process of this machine
    uses.
    """
    for number in numbers:
        cache = folder / "kernels" / f"{platform.node()}-{number}"
        # any other error is one of the disk, and comes again
        with contextlib.suppress(LockedError):
            held.enter_context(locked_folder(cache))
            return cache
    raise AssertionError("numbers do not end")


class Child:
    """A process that runs tasks one after the other, and a new one when that has
    ended.
    """

    def __init__(
        self,
        folder: Path,
        *,
        limits: Limits | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._store, self._limits = Store(folder), limits or Limits()
        self._environment = dict(environment or {})
        self._group: ProcessGroup | None = None
        self._stopped = False

    def run(
        self, task: Task, on_event: OnEvent = nobody, *, cores: Sequence[int] = ()
    ) -> Outcome:
        """Run a task, and write down what it could not write down itself: by what
        signal or limit it was ended.
        """
        group = self._started()
        if self._stopped:
            return Outcome(state="stopped", text="the engine was closed")
        failures = list[str]()

        def tell(event: Event) -> None:
            if event.state == "failed":
                failures.append(event.text)
            on_event(event)

        started = time.monotonic()
        try:
            group.pipe.send((task, tuple(cores)))
        except OSError:  # it was killed while it had nothing to do
            self.close()
            return self.run(task, on_event, cores=cores)
        try:
            answer = _answer(group, self._limits, tell)
        except GroupEndedError as error:
            why = str(error)
        else:
            # What a process keeps of one task must not count against the next.
            most = self._limits.megabytes
            if most is not None and group.megabytes() > most / 2:
                self.close()
            return answer
        self.close()
        if self._stopped:
            return Outcome(state="stopped", text="the engine was closed")
        if not failures:
            seconds = round(time.monotonic() - started, 3)
            tries = self._store.note_failure(task, why, seconds)
            text = f"try {tries}: {why}"
            tell(
                Event(
                    state="failed",
                    key=task.key,
                    kind=task.kind,
                    text=text,
                    seconds=seconds,
                )
            )
        return Outcome(state="failed", text=failures[0])

    def stop(self) -> None:
        """End the `run` of another thread, which may write down first how far it is; it
        counts as no try.
        """
        self._stopped = True
        group = self._group
        if group is not None:
            group.terminate()
            timer = threading.Timer(_GRACE, group.kill)
            timer.daemon = True
            timer.start()

    def close(self) -> None:
        """End the process, and all that it has started."""
        if self._group is not None:
            self._group.close()
            self._group = None

    def _started(self) -> ProcessGroup:
        if self._group is not None and self._group.is_running:
            return self._group
        self.close()
        group = ProcessGroup(
            __name__, str(self._store.folder.absolute()), environment=self._environment
        )
        self._group = group
        try:
            _answer(group, Limits(), nobody)
        except GroupEndedError as error:
            self.close()
            raise EngineError.of(
                "child process", "one that starts", str(error), "see what it says"
            ) from error
        return group


def _answer(group: ProcessGroup, limits: Limits, tell: OnEvent) -> Outcome:
    """What a process says at the end of a task; `GroupEndedError` if it ended, or broke
    a limit.
    """
    since = time.monotonic()
    while True:
        group.wait(limits, since)
        try:
            answer: Event | Outcome = group.pipe.recv()
        except (EOFError, OSError) as error:
            raise group.ended() from error
        if isinstance(answer, Outcome):
            return answer
        tell(answer)
        # what the process imported before is not the task's
        if answer.state == "running":
            since = time.monotonic()


def serve(store: Store, pipe: Connection) -> None:
    """Run the tasks that come through a pipe, and say what happens."""
    tasks: queue.SimpleQueue[tuple[Task, Sequence[int]]] = inbox(pipe.recv)
    last = 0.0

    def tell(event: Event) -> None:
        nonlocal last
        if event.state != "progress" or time.monotonic() - last > _BETWEEN:
            last = time.monotonic()
            pipe.send(event)

    pipe.send(Outcome(state="ready"))
    while True:
        try:
            task, cores = tasks.get()
            keep_to(cores)
            run_job(store, task, tell)
            pipe.send(Outcome(state="done"))
        except HeldError as error:
            pipe.send(Outcome(state="held", text=str(error)))
        except DiskFullError as error:
            pipe.send(Outcome(state="stopped", text=str(error)))


def keep_to(cores: Sequence[int]) -> None:
    """Keep every thread of this process to some cores, and Dr.Jit to as many threads.

    Two threads of Dr.Jit on one core take twice the time of one: they wait for each
    other without sleeping.
    """
    if not cores:
        return
    for thread in os.listdir("/proc/self/task"):
        with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
            os.sched_setaffinity(int(thread), cores)
    # else it counts the cores when it is imported
    drjit = sys.modules.get("drjit")
    if drjit is not None:
        drjit.set_thread_count(len(cores))


def main() -> int:
    """Serve until the pipe is closed or SIGTERM comes, which ends a job as Ctrl-C
    would.
    """
    pipe = connection(sys.argv[2])
    with sigterm_as_interrupt():
        try:
            serve(Store(Path(sys.argv[1])), pipe)
        except KeyboardInterrupt:
            pipe.send(Outcome(state="stopped", text="it was terminated"))
    return TERMINATED


if __name__ == "__main__":
    sys.exit(main())
