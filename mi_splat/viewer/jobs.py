"""Commands that a page runs in processes of their own: their forms, requests and results."""

import math
import os
import signal
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mi_splat.errors import printable
from mi_splat.viewer.content import Content, Inspector
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.picking import Picked

Value = str | float


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """A field of a form: one of some words."""

    name: str
    label: str
    options: tuple[str, ...]
    default: str

    def valid(self, value: object) -> Value:
        """The value if it is an option, else the default: a browser may send anything."""
        return value if isinstance(value, str) and value in self.options else self.default


@dataclass(frozen=True, slots=True, kw_only=True)
class Number:
    """A field of a form: a number in a range."""

    name: str
    label: str
    low: float
    high: float
    step: float
    default: float

    def valid(self, value: object) -> Value:
        """The value if it is a number in the range, else the default."""
        fits = isinstance(value, int | float) and math.isfinite(value) and self.low <= value <= self.high
        return value if fits and isinstance(value, int | float) else self.default


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class JobRequest:
    """A job on what is shown, from the camera of a window, with the values of its form and the selected object."""

    content: Content
    orbit: Orbit
    values: Mapping[str, Value]
    picked: Picked | None


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class JobResult:
    """The result of a job in words; `content`, if any, is shown from then on."""

    lines: tuple[str, ...]
    content: Content | None = None
    inspector: Inspector | None = None


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class JobKind:
    """A kind of job: its form, the arguments of its command, and how its folder is opened."""

    name: str
    fields: tuple[Choice | Number, ...]
    out: Path
    arguments: Callable[[JobRequest, Path, Path], list[str]]
    """Of a request, the file of the mask and the folder of the result."""
    opened: Callable[[JobRequest, Path], JobResult]


class Job:
    """A command in a process, whose output is kept in a file next to its result."""

    def __init__(self, arguments: Sequence[str], log: Path) -> None:
        self._log = log
        with log.open("wb") as output:
            self._process = subprocess.Popen(
                arguments,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, "MI_SPLAT_PROGRESS_SECONDS": "1"},
                start_new_session=True,  # Ctrl-C is for the page, which ends this process
            )

    @property
    def status(self) -> int | None:
        """Exit status of the process; None while it runs."""
        return self._process.poll()

    @property
    def last_line(self) -> str:
        """What the command said last."""
        lines = self._log.read_bytes().decode("utf-8", "replace").splitlines()
        return printable(lines[-1].removeprefix("mi-splat: ")) if lines else ""

    def stop(self, number: signal.Signals) -> None:
        """Send a signal to the process and to all that it has started, if it still runs."""
        if self.status is None:
            os.killpg(self._process.pid, number)
            if number == signal.SIGKILL:
                self._process.wait()
