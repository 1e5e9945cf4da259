"""A process that runs one task after the other, for the one that watches it: `python -m mi_splat.ledger.child STORE`.

Tasks come as lines of JSON; what happens goes back in the same form. The process ends with the first job that raises,
so that the next one has a new process, and at once when who watches it ends.
"""

from __future__ import annotations

import dataclasses
import json
import os
import queue
import sys
import threading
import time
from pathlib import Path
from typing import Any

from mi_splat.ledger.job import DiskFullError, Event, HeldError, Task
from mi_splat.ledger.running import run_job
from mi_splat.ledger.store import Store

_BETWEEN = 0.1
"""Least seconds between two reports of progress."""


def main(store: Store) -> None:
    """Run the tasks that come."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what a job prints is no answer
    tasks: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(tasks,), daemon=True).start()
    last = 0.0

    def say(**values: Any) -> None:
        answers.write(json.dumps(values) + "\n")

    def tell(event: Event) -> None:
        nonlocal last
        if event.state != "progress" or time.monotonic() - last > _BETWEEN:
            last = time.monotonic()
            say(event=dataclasses.asdict(event))

    say(ready=True)
    while True:
        values = json.loads(tasks.get())
        values.pop("key")
        try:
            run_job(store, Task(**values), tell)
        except HeldError as error:
            say(ended="held", text=str(error))
        except DiskFullError as error:
            say(ended="stopped", text=str(error))
        else:
            say(ended="done", text="")


def _listen(tasks: queue.SimpleQueue[str]) -> None:
    for line in sys.stdin:
        tasks.put(line)
    os._exit(1)  # nobody watches any more


if __name__ == "__main__":
    main(Store(Path(sys.argv[1])))
