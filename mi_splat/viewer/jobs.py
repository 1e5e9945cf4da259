"""Long work beside the page: a command in a process of its own, what it says meanwhile, and what it leaves behind.

The renderer is for one thread. So whatever takes longer than a picture runs in another process, which can be stopped.
"""

import contextlib
import io
import math
import os
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from mi_splat.errors import MiSplatError
from mi_splat.processes import spawn_context
from mi_splat.viewer.composition import Pixels
from mi_splat.viewer.exhibit import Exhibit, Inspector
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.picking import Picked

Value = str | float
Values = Mapping[str, Value]
"""What was chosen in a form, by the name of the field."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """A field of a form: one of some words.

    Attributes:
        name: Of the field.
        label: What it is called on the page.
        options: The words; at least one.
        usual: The one that is chosen at first.
    """

    name: str
    label: str
    options: tuple[str, ...]
    usual: str

    def taken(self, value: object) -> Value:
        """The value if it can be chosen, else the usual one: what comes from a browser may be anything."""
        return value if isinstance(value, str) and value in self.options else self.usual


@dataclass(frozen=True, slots=True, kw_only=True)
class Number:
    """A field of a form: a number in a range.

    Attributes:
        name: Of the field.
        label: What it is called on the page.
        low: Smallest.
        high: Largest.
        step: Between two.
        usual: What it is at first.
    """

    name: str
    label: str
    low: float
    high: float
    step: float
    usual: float

    def taken(self, value: object) -> Value:
        """The value if it is a number in the range, else the usual one."""
        fits = isinstance(value, int | float) and math.isfinite(value) and self.low <= value <= self.high
        return value if fits and isinstance(value, int | float) else self.usual


Field = Choice | Number


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Request:
    """What a visitor asks for.

    Attributes:
        kind: Which work.
        exhibit: What is shown.
        orbit: The visitor's camera.
        values: Of every field of the form.
        picked: The object; None if none was picked.
    """

    kind: str
    exhibit: Exhibit
    orbit: Orbit
    values: Values
    picked: Picked | None


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Outcome:
    """What work has led to.

    Attributes:
        lines: It in words; plain text.
        exhibit: To be shown in place of what is shown; None leaves that.
        inspector: Looks at its pictures.
        cameras: Cameras that are worth a look, by what is to be seen there.
        picture: (H, W, 3) a picture beside the words.
    """

    lines: tuple[str, ...]
    exhibit: Exhibit | None = None
    inspector: Inspector | None = None
    cameras: Mapping[str, Orbit] = field(default_factory=dict)
    picture: Pixels | None = None


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class News:
    """What running work says.

    Attributes:
        text: In a line.
        share: Part of it that is done, in [0, 1]; None where that is not known.
        picture: (H, W, 3) what it looks at.
    """

    text: str
    share: float | None = None
    picture: Pixels | None = None


Tell = Callable[[News], bool | None]
"""Told what work does; says whether it is to end with what it has."""
Perform = Callable[[Sequence[str], Tell], None]
"""Runs the words of a command; a function of a module, as another process imports it. Raises what ends it."""


class Laboratory(Protocol):
    """What can be done with an exhibit beside looking at it; all of it is commands.

    Attributes:
        kinds: Kinds of work, in the order of the page.
        lasting: Those that can end before their time, with what they have.
        perform: Runs a command.
    """

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of work, in the order of the page."""
        ...

    @property
    def lasting(self) -> frozenset[str]:
        """Kinds of work that can end before their time, with what they have."""
        ...

    @property
    def perform(self) -> Perform:
        """Runs the words of a command."""
        ...

    def form(self, kind: str, exhibit: Exhibit, values: Values) -> tuple[Field, ...]:
        """What a kind of work asks for."""
        ...

    def folder(self, kind: str) -> Path:
        """What a user would call the folder of a result."""
        ...

    def words(self, request: Request, *, mask: Path, out: Path) -> list[str]:
        """The words of the command that does the work, after the program's name."""
        ...

    def opened(self, request: Request, out: Path) -> Outcome:
        """The result in a folder."""
        ...


class Job:
    """A command in a process of its own.

    Args:
        perform: Runs it.
        words: Its words.
        processes: Starts it; `multiprocessing` by default.
    """

    def __init__(self, perform: Perform, words: Sequence[str], *, processes: Any = None) -> None:
        processes = processes or spawn_context()
        self._pipe, end = processes.Pipe()
        self._process = processes.Process(target=_run, args=(perform, list(words), end), daemon=True)
        self._process.start()
        end.close()

    def heard(self) -> News | str | None:
        """What the work has printed since the last call; how it ended (empty: well) as text; None for nothing new."""
        last: News | str | None = None
        try:
            while not isinstance(last, str) and self._pipe.poll():
                last = self._pipe.recv()
        except (EOFError, OSError):
            self._process.join()
            last = f"it ended with status {self._process.exitcode}"
        return last

    def end(self) -> None:
        """Ask the work to end with what it has, as far as its kind can."""
        with contextlib.suppress(OSError):  # it has ended itself meanwhile
            self._pipe.send(True)

    def stop(self) -> None:
        """End the work, if it still runs."""
        self._process.kill()
        self._process.join()
        self._pipe.close()


def _run(perform: Perform, words: Sequence[str], pipe: Any) -> None:
    """What the process does: says what happens, and last how it ended."""
    if threading.current_thread() is threading.main_thread():
        os.nice(5)  # pictures come first
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the page, which ends this process
    log, ending = io.StringIO(), False

    def tell(news: News) -> bool:
        nonlocal ending
        pipe.send(news)
        ending = ending or bool(pipe.poll())
        return ending

    try:
        with contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
            perform(words, tell)
    except (MiSplatError, OSError) as error:
        pipe.send(" ".join(str(error).split()) or type(error).__name__)
    else:
        pipe.send("")
    finally:
        pipe.close()
