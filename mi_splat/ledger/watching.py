"""What watches a child process: limits of time and memory, and what to say of one that ended."""

from __future__ import annotations

import dataclasses
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_splat.errors import MiSplatError, message
from mi_splat.ledger.job import Event, OnEvent, Task, nobody
from mi_splat.ledger.store import Store

_LOOK = 0.25
"""Seconds between two looks at the time and the memory."""
_SHOWN = 2000
"""Characters of what a process said last."""


class EngineError(MiSplatError):
    """What runs jobs does not work itself."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a job may use; None is as much as it likes.

    Attributes:
        seconds: Time.
        megabytes: Resident memory.
    """

    seconds: float | None = None
    megabytes: float | None = None


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a task ended.

    Attributes:
        key: Of the task.
        state: "done", "held" (another process does it), "failed" (one try), or "stopped" (nothing can be done now).
        text: Why.
        error: What the engine raised, if it stopped for that.
    """

    key: str
    state: str
    text: str = ""
    error: BaseException | None = None


Report = Callable[[Outcome], None]


class Child:
    """A process that runs tasks one after the other, and a new one when that has ended.

    Args:
        folder: The store.
        limits: Of each task.
        environment: Variables that differ from those of this process.
        cores: Numbers of the processor's cores that it may use; empty for all.
    """

    def __init__(
        self,
        folder: Path,
        *,
        limits: Limits | None = None,
        environment: Mapping[str, str] | None = None,
        cores: Sequence[int] = (),
    ) -> None:
        self._store, self._limits = Store(folder), limits or Limits()
        self._environment, self._cores = dict(environment or {}), tuple(cores)
        self._process: subprocess.Popen[bytes] | None = None
        self._errors: Any = None
        self._rest = b""
        self._stopped = False

    def run(self, task: Task, on_event: OnEvent = nobody) -> Outcome:
        """Run a task, and write down what it could not write down itself: by what signal or limit it was ended.

        Raises:
            EngineError: No child process can be started.
        """
        process = self._started()
        if self._stopped:
            return Outcome(key=task.key, state="stopped", text="the engine was closed")
        begun, noted, told = time.monotonic(), list[str](), on_event

        def tell(event: Event) -> None:
            if event.state == "failed":
                noted.append(event.text)
            told(event)

        assert process.stdin is not None
        try:
            process.stdin.write(json.dumps(dataclasses.asdict(task)).encode() + b"\n")
            process.stdin.flush()
        except BrokenPipeError:  # it was killed while it had nothing to do
            self.close()
            return self.run(task, on_event)
        ended, broken = self._answer(process, self._limits, tell)
        if ended is not None:
            return Outcome(key=task.key, state=ended["ended"], text=ended["text"])
        text = broken or self._end(process)
        self.close()
        if self._stopped:
            return Outcome(key=task.key, state="stopped", text="the engine was closed")
        if not noted:
            seconds = round(time.monotonic() - begun, 3)
            tries = self._store.note_failure(task, text, seconds)
            noted = [f"try {tries}: {text}"]
            told(Event(state="failed", key=task.key, kind=task.kind, text=noted[0], seconds=seconds))
        return Outcome(key=task.key, state="failed", text=noted[0])

    def stop(self) -> None:
        """Have another thread's `run` come to its end now; what it did counts as no try."""
        self._stopped = True
        if (process := self._process) is not None:
            process.kill()

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            for pipe in (self._process.stdin, self._process.stdout, self._errors):
                if pipe is not None:
                    pipe.close()
            self._process, self._rest = None, b""

    def _started(self) -> subprocess.Popen[bytes]:
        if self._process is not None and self._process.poll() is None:
            return self._process
        self.close()
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        environment = {**os.environ, **self._environment, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        command = [sys.executable, "-m", "mi_splat.ledger.child", str(self._store.folder.absolute())]
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": self._errors}
        process = subprocess.Popen(command, env=environment, start_new_session=True, bufsize=0, **pipes)
        if self._cores and hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(process.pid, self._cores)
        self._process = process
        if self._answer(process, Limits(), nobody)[0] is None:
            text = self._end(process)
            self.close()
            raise EngineError(message("child process", "one that starts", text, "see what it says"))
        return process

    def _answer(
        self, process: subprocess.Popen[bytes], limits: Limits, tell: OnEvent
    ) -> tuple[dict[str, Any] | None, str]:
        """What the process says at the end of a task; or None, and which limit it broke, if it did."""
        assert process.stdout is not None
        begun = looked = time.monotonic()
        answers = select.poll()
        answers.register(process.stdout, select.POLLIN)
        while True:
            line, newline, rest = self._rest.partition(b"\n")
            if newline:
                self._rest = rest
                values = json.loads(line)
                if "event" not in values:
                    return values, ""
                tell(Event(**values["event"]))
                continue
            if answers.poll(1000 * _LOOK):
                part = os.read(process.stdout.fileno(), 1 << 16)
                if not part:
                    return None, ""
                self._rest += part
            if time.monotonic() - looked > _LOOK:
                looked = time.monotonic()
                if broken := _broken(limits, process.pid, looked - begun):
                    return None, broken

    def _end(self, process: subprocess.Popen[bytes]) -> str:
        """How a process ended, in words, and what it said last."""
        status = process.wait()
        how = f"ended by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
        self._errors.seek(max(0, self._errors.seek(0, os.SEEK_END) - _SHOWN))
        said = self._errors.read().decode("utf-8", "replace").strip()
        return f"{how}: {said}" if said else how


def _broken(limits: Limits, process: int, seconds: float) -> str:
    """Which limit a process broke, in words; empty for none."""
    if limits.seconds is not None and seconds > limits.seconds:
        return f"ran longer than {limits.seconds:g} s"
    if limits.megabytes is not None and (used := memory_of(process)) > limits.megabytes:
        return f"used {used:,.0f} MB of memory, more than {limits.megabytes:,.0f}"
    return ""


def memory_of(process: int) -> float:
    """Resident memory of a process in MB (1e6 bytes); 0 where it cannot be told."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:
        shown = subprocess.run(["ps", "-o", "rss=", "-p", str(process)], capture_output=True, text=True, check=False)
        return float(shown.stdout.strip() or 0) * 1024 / 1e6
