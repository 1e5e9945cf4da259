"""The ledger in one process: `do(job)` does what is not done, the job's inputs first."""

from __future__ import annotations

import time
from pathlib import Path

from mi_splat.ledger.job import Done, Event, HeldError, Job, OnEvent, by_depth, nobody
from mi_splat.ledger.running import run_job, task_for
from mi_splat.ledger.store import TRIES, Store

_POLL = 0.2


class Ledger:
    """A store of results and what does jobs in this process.

    Attributes:
        store: The folder of results.
    """

    def __init__(self, folder: Path, *, on_event: OnEvent = nobody) -> None:
        self.store, self._on_event = Store(folder), on_event
        self._done: dict[str, Done] = {}

    def do(self, job: Job) -> Done:
        """The result of a job, and before it those of all that it reads; only what is not there is done.

        What another process does now is waited for. Earlier failures do not count.

        Raises:
            InvalidValueError: A file of a job or an input was changed.
            Exception: Whatever a kind raises.
        """
        for level in by_depth([job]):
            for needed in level:
                self._done[needed.identity] = self._do(needed)
        return self._done[job.identity]

    def _do(self, job: Job) -> Done:
        """The result of a job whose inputs are done."""
        task = task_for(job, self.store, self._done)
        if len(self.store.failures(task.key)) >= TRIES:
            self.store.forgive(task.key)
        told = False
        while True:
            try:
                return run_job(self.store, task, self._on_event)
            except HeldError as error:
                if not told:
                    self._on_event(Event(state="held", key=task.key, kind=task.kind, text=str(error)))
                told = True
                time.sleep(_POLL)
