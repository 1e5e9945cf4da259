"""What the visitors of a page do together beside looking: pick an object, have work done on it, and see the result.

All of it happens in the thread that makes the pictures, where `turn` is called again and again; what a browser asks for
is put in a queue.
"""

import shlex
import tempfile
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from mi_splat.cameras import RenderFn
from mi_splat.errors import InvalidValueError, MiSplatError, message
from mi_splat.io.documents import save_bytes
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.viewer.bench_panel import BenchPanel, Controls, Visit
from mi_splat.viewer.exhibit import Exhibit
from mi_splat.viewer.jobs import Field, Job, Laboratory, News, Outcome, Request, Value
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.picking import MASK, Click, Picked, pick

MOST_TASKS = 100
"""Wishes that wait; more are dropped."""
MOST_SHOWN = 4
"""Last results that are kept beside what was shown first, each with its Gaussians in memory."""
MOST_UNDONE = 50
"""Picks that can be undone."""


class Bench:
    """The work on an exhibit.

    Args:
        painter: Makes the first pictures.
        laboratory: Does the work; without one, objects can be picked.
        renderer: Makes the renderer of what work leads to.
        processes: Starts processes, as `multiprocessing` does.

    Attributes:
        painters: What was shown, as far as it is kept; the last one is shown now.
        tints: Counts the changes of the tint.
        lines: What there is to say.
        news: Of running work.
        ending: Whether that was asked to end with what it has.
        outcome: Of the last work.
    """

    def __init__(
        self,
        painter: Painter,
        laboratory: Laboratory | None = None,
        *,
        renderer: Callable[[RenderSettings], RenderFn] = Renderer,
        processes: Any = None,
    ) -> None:
        self.painters, self.laboratory, self._renderer, self._processes = [painter], laboratory, renderer, processes
        self.tints, self.tinted = 0, True
        self.lines: tuple[str, ...] = ()
        self.news: News | None = None
        self.ending = False
        self.outcome: Outcome | None = None
        self._values = dict[str, Value]()
        self._picks: deque[Picked | None] = deque([None], maxlen=MOST_UNDONE)
        self._tasks: deque[Callable[[], None]] = deque(maxlen=MOST_TASKS)
        self._job: tuple[Job, Request, Path] | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._begun, self._called = 0, dict[str, str]()

    label, tab, leads = "mi-splat view", "Tools", False
    """What the page is called, the name of the tab with the controls, and whether that is the first."""

    def panel(self, gui: Any, visit: Visit, wake: Callable[[], None]) -> Controls:
        """Add the controls for a visitor."""
        return BenchPanel(gui, self, visit, wake)

    @property
    def painter(self) -> Painter:
        """What makes the pictures of the present exhibit."""
        return self.painters[-1]

    @property
    def exhibit(self) -> Exhibit:
        """What is shown now."""
        return self.painter.exhibit

    @property
    def picked(self) -> Picked | None:
        """The object; None if none is picked, or what is shown has no such Gaussians."""
        picked = self._picks[-1]
        fits = [splat.name for splat in self.exhibit.splats if picked is not None and picked.fits(splat.scene)]
        if picked is None or not fits or picked.splat in fits:
            return picked if fits else None
        return replace(picked, splat=fits[0])

    @property
    def running(self) -> str:
        """Which work is being done; empty for none."""
        return "" if self._job is None else self._job[1].kind

    def later(self, task: Callable[[], None]) -> None:
        """Run an action in the thread of the pictures; from any thread."""
        self._tasks.append(task)

    def turn(self) -> bool:
        """Do what waits, and show what running work has printed. What is asked for meanwhile waits."""
        waiting = len(self._tasks)
        for _ in range(waiting):
            task = self._tasks.popleft()
            try:
                task()
            except (MiSplatError, OSError) as error:
                self.lines = (str(error),)
        return self._listen() or waiting > 0

    def pick(self, click: Click) -> None:
        """Pick what is at a pixel."""
        if all(click.splat != splat.name for splat in self.exhibit.splats):  # shown no longer
            return
        self._picks.append(pick(click, self.exhibit, self.painter.render, self.picked))
        self.lines = ()
        self.tint(True)

    def trim(self, axis: int, part: object) -> None:
        """Keep of the object a part of its box along an axis (0, 1, 2); what is no part of [0, 1] changes nothing."""
        picked = self.picked
        match part:
            case (int() | float() as low, int() | float() as high) if picked and 0 <= low <= high <= 1:
                scene = self.exhibit.splat(picked.splat).scene
                self._picks[-1] = picked.within(scene, axis, (float(low), float(high)))
                self.lines = ()
                self.tint(True)

    def undo(self) -> None:
        """Take the last pick back."""
        if len(self._picks) > 1:
            self._picks.pop()
        self.tint(self.tinted)

    def tint(self, on: bool) -> None:
        """Show the object in another colour, or no longer."""
        self.tinted, self.tints = on, self.tints + 1
        self.painter.tint(self.picked if on else None)

    def form(self, kind: str) -> tuple[Field, ...]:
        """The fields of a kind of work."""
        return () if self.laboratory is None else self.laboratory.form(kind, self.exhibit, self._values)

    def values(self, kind: str) -> dict[str, Value]:
        """What is chosen in a form."""
        return {field.name: field.taken(self._values.get(field.name)) for field in self.form(kind)}

    def choose(self, kind: str, name: str, value: object) -> None:
        """Choose something in a form, and in all that have the field; what cannot be chosen changes nothing."""
        for field in self.form(kind):
            if field.name == name and field.taken(value) == value:
                self._values[name] = field.taken(value)

    def command(self, kind: str, orbit: Orbit) -> str:
        """The command that does the work, or why there is none."""
        assert self.laboratory is not None
        try:
            words = self.laboratory.words(self._request(kind, orbit), mask=Path(MASK), out=self._free(kind))
        except MiSplatError as error:
            return f"# {error}"
        for folder, called in tuple(self._called.items()):  # of this page, which the user would have made elsewhere
            words = [word.replace(folder, called) for word in words]
        return shlex.join(["mi-splat", *words])

    def start(self, kind: str, orbit: Orbit) -> None:
        """Begin work."""
        if self.laboratory is None or kind not in self.laboratory.kinds:
            return
        if self._job is not None:
            raise InvalidValueError(message(kind, "one work at a time", f"{self.running} that runs", "stop it first"))
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="mi-splat-view-")
        folder, request = Path(self._folder.name) / str(self._begun), self._request(kind, orbit)
        out = folder / "result"
        words = self.laboratory.words(request, mask=folder / MASK, out=out)
        folder.mkdir()
        self._begun, self._called[str(out)] = self._begun + 1, str(self._free(kind))
        if request.picked is not None:
            save_bytes(request.picked.file, folder / MASK)
        self._values |= request.values
        self._job = (Job(self.laboratory.perform, words, processes=self._processes), request, out)
        self.lines, self.outcome, self.news, self.ending = (), None, News(text="starting"), False

    def stop(self) -> None:
        """Ask running work to end with what it has; stop it at once where it cannot, or is asked again."""
        if self._job is None or self.laboratory is None:
            return
        job, request, out = self._job
        if request.kind in self.laboratory.lasting and not self.ending:
            self.ending = True
            job.end()
            self.lines = ("It ends after this step with the best so far. Stop again ends it now, and keeps nothing.",)
            return
        job.stop()
        del self._called[str(out)]
        remark = f"{self.running} was stopped; nothing of it is kept. Its command begins from the start."
        self.lines, self._job, self.news = (remark,), None, None

    def back(self) -> None:
        """Show what was shown before."""
        if len(self.painters) > 1:
            self.painters.pop()
            self.outcome, self.lines = None, ()
            self.tint(self.tinted)

    def close(self) -> None:
        """End work and delete what it left."""
        if self._job is not None:
            self._job[0].stop()
            self._job, self.news = None, None
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _free(self, kind: str) -> Path:
        """What a user would call the next result of a kind of work: no folder that is there, or of another result."""
        assert self.laboratory is not None
        folder, number = self.laboratory.folder(kind), 1
        path = folder
        while str(path) in self._called.values() or path.exists():
            number += 1
            path = folder.with_name(f"{folder.name}-{number}")
        return path

    def _request(self, kind: str, orbit: Orbit) -> Request:
        return Request(kind=kind, exhibit=self.exhibit, orbit=orbit, values=self.values(kind), picked=self.picked)

    def _listen(self) -> bool:
        """Hear what work says, and open its result where it is done; whether there was anything."""
        if self._job is None:
            return False
        job, request, out = self._job
        heard = job.heard()
        if isinstance(heard, News):
            self.news = heard
        elif heard is not None:
            job.stop()
            self._job, self.news = None, None
            self._finish(request, out, heard)
        return heard is not None

    def _finish(self, request: Request, out: Path, failure: str) -> None:
        """Show what work has led to."""
        if failure or self.laboratory is None:
            self.lines = (f"{request.kind} failed: {failure}",)
            del self._called[str(out)]
            return
        try:
            self.outcome = self.laboratory.opened(request, out)
        except (MiSplatError, OSError) as error:
            self.lines = (f"{request.kind}: {error}",)
            return
        self.lines = self.outcome.lines
        exhibit, inspector = self.outcome.exhibit, self.outcome.inspector or self.painter.inspector
        if exhibit is not None:
            self.painters.append(Painter(exhibit, self._renderer(exhibit.settings), inspector))
            del self.painters[1:-MOST_SHOWN]
            self.tint(False)
