"""A laboratory that does nothing, in threads in the place of processes, for the tests of the page."""

import multiprocessing.dummy
import threading
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from mi_splat.errors import InvalidValueError
from mi_splat.viewer.bench import Bench
from mi_splat.viewer.exhibit import Exhibit
from mi_splat.viewer.jobs import Choice, Field, News, Number, Outcome, Request, Tell, Values
from tests.fakes import blobs
from tests.viewer.exhibits import ABOVE, exhibit, painter


class Thread(multiprocessing.dummy.DummyProcess):
    """A thread in the place of a process, which is ended by an event."""

    exitcode = 0
    ended = threading.Event()

    def kill(self) -> None:
        self.ended.set()


PROCESSES = SimpleNamespace(Pipe=multiprocessing.dummy.Pipe, Process=lambda **given: Thread(**_plain(given)))


def _plain(given: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in given.items() if name != "daemon"}


def perform(words: Sequence[str], tell: Tell) -> None:
    """Says that it begins, waits until it is ended if it is to, and writes its words where its result is wanted."""
    ended = tell(News(text=f"beginning {words[0]}", share=0.5, picture=np.zeros((4, 4, 3), np.uint8)))
    while words[0] == "wait" and not ended:
        if Thread.ended.wait(0.01):
            return
        ended = tell(News(text="waiting", share=0.5))
    if words[0] == "fail":
        raise InvalidValueError("work: expected to be done, got this; look elsewhere")
    Path(words[-1]).write_text(" ".join(words))


class Works:
    """A laboratory that does nothing."""

    kinds, lasting = ("Work",), frozenset({"Work"})
    perform = staticmethod(perform)

    def form(self, kind: str, exhibit: Exhibit, values: Values) -> tuple[Field, ...]:
        return (
            Choice(name="verb", label="Verb", options=("do", "wait", "fail"), usual="do"),
            Number(name="eps", label="eps", low=0.5, high=20.0, step=0.5, usual=5.0),
        )

    def folder(self, kind: str) -> Path:
        return Path("out/work")

    def words(self, request: Request, *, mask: Path, out: Path) -> list[str]:
        if request.picked is None:
            raise InvalidValueError("Work: expected an object, got none; click on one")
        return [str(request.values["verb"]), f"--eps={request.values['eps']}", str(mask), str(out)]

    def opened(self, request: Request, out: Path) -> Outcome:
        mask = np.load(out.parent / "mask.npy")
        return Outcome(
            lines=(f"done to {mask.sum()}",), exhibit=exhibit(2), cameras={"from above": ABOVE}, picture=None
        )


def bench(**others: Any) -> Bench:
    """A bench with a laboratory that does nothing."""
    return Bench(painter(1), Works(), renderer=lambda settings: blobs, processes=PROCESSES, **others)
