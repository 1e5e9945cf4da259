"""What the commands show: results on stdout, as text or as one JSON document, and
progress on stderr.

Text goes through `printable` on its way, since names out of files are in it; a JSON
document is exact.
"""

import gc
import importlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Protocol

from mi_splat.errors import MiSplatError, printable

PROGRAM = "mi-splat"
LINE_SECONDS = 10.0
"""Time between two lines of progress where there is no terminal."""


class UsageError(MiSplatError):
    """An option that makes no sense; the command line prints it and exits with status
    2.
    """


class Advance(Protocol):
    """Reports progress."""

    def __call__(self, text: str | None = None, units: int = 1) -> None:
        """Count so many units of work as done, and show `text` from now on."""
        ...


def limit_threads(most: int | None = None) -> None:
    """Leave cores to Dr.Jit, unless OMP_NUM_THREADS is set: it and torch each bring a
    pool of threads, and two fight.

    On two busy cores an attack was measured to take 17 times as long with two full
    pools.
    """
    if "OMP_NUM_THREADS" not in os.environ:
        import torch

        torch.set_num_threads(
            max(1, (os.cpu_count() or 1) // 2 if most is None else most)
        )


def import_at_once(package: str) -> None:
    """Import a large package in two thirds of the CPU time, unless it is there already.

    All that torch makes as it is imported stays to the end; Python would look for
    garbage in it a few hundred times.
    """
    if package not in sys.modules:
        gc.disable()
        try:
            importlib.import_module(package)
        finally:
            gc.freeze()
            gc.enable()


def warn(text: str) -> None:
    """A line for a human on stderr."""
    sys.stderr.write(f"{PROGRAM}: {printable(text)}\n")


_notes: list[str] = []


def note(text: str) -> None:
    """A line that a command which succeeds says on stderr at its end, once."""
    if text not in _notes:
        _notes.append(text)


def show_notes(*, succeeded: bool) -> None:
    """Say what was noted, of a command that succeeded; of one that failed the error is
    what counts.
    """
    for text in _notes if succeeded else ():
        warn(text)
    _notes.clear()


def show(text: str = "") -> None:
    """A line for a human on stdout."""
    sys.stdout.write(f"{printable(text)}\n")


def show_json(document: Mapping[str, object]) -> None:
    """The one JSON document of a command with --json, on stdout."""
    sys.stdout.write(json.dumps(document, indent=2, allow_nan=False) + "\n")


def show_result(document: Mapping[str, object], *lines: str, as_json: bool) -> None:
    """What a command has done, on stdout: lines for a human, or its one JSON document
    with --json.
    """
    if as_json:
        show_json(document)
        return
    for line in lines:
        show(line)


def show_table(rows: Iterable[tuple[str, str]]) -> None:
    """Names and values in two aligned columns on stdout."""
    pairs = [(printable(name), value) for name, value in rows]
    width = max(len(name) for name, _ in pairs)
    for name, value in pairs:
        show(f"{name:{width}}  {value}")


@contextmanager
def progress(text: str, total: int | None = None) -> Iterator[Advance]:
    """A progress bar on stderr while the block runs; where stderr is no terminal, a
    line every ten seconds.
    """
    if not sys.stderr.isatty():
        yield _Lines(text, total)
        return
    from tqdm import tqdm

    if total is None:
        form = "{desc} [{elapsed}]"
    else:
        form = "{desc} |{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}]"
    with tqdm(
        total=total,
        desc=printable(text),
        bar_format=form,
        leave=False,
        dynamic_ncols=True,
    ) as bar:

        def advance(text: str | None = None, units: int = 1) -> None:
            if text is not None:
                bar.set_description_str(printable(text), refresh=True)
            bar.update(units)

        yield advance


class _Lines:
    """Progress as plain lines on stderr, for logs: at most one every `LINE_SECONDS`, so
    none of what is quick.
    """

    def __init__(self, text: str, total: int | None) -> None:
        self._text = text
        self._total = total
        self._done = 0
        self._last = time.monotonic()

    def __call__(self, text: str | None = None, units: int = 1) -> None:
        self._text = self._text if text is None else text
        self._done += units
        now = time.monotonic()
        if now - self._last >= LINE_SECONDS:
            self._last = now
            warn(
                f"{self._done} of {self._total}: {self._text}"
                if self._total
                else self._text
            )


def follow(advance: Advance) -> Callable[[str, int, int], None]:
    """What shows work that has stages: a line for each new one, and how far it is."""
    shown = set[str]()

    def told(text: str, done: int, total: int) -> None:
        if text not in shown:
            shown.add(text)
            warn(text)
        advance(f"{text}, {done:,} of {total:,}")

    return told
