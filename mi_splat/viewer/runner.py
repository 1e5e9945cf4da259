"""What the windows of a page share: the selected object, the running job and its result.

All of it happens in the thread that renders, where `turn` is called again and again; requests of browsers are queued.
"""

from __future__ import annotations

import shlex
import signal
import tempfile
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_splat.cameras import RenderFn
from mi_splat.errors import InvalidValueError, MiSplatError, message
from mi_splat.io.documents import save_bytes
from mi_splat.processes import python_command
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.viewer.content import Content
from mi_splat.viewer.jobs import Job, JobKind, JobRequest, Value
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.panel import JobPanel
from mi_splat.viewer.picking import MASK, Click, Picked, pick

if TYPE_CHECKING:
    from mi_splat.viewer.server import Client

MOST_QUEUED = 100  # requests that wait; more are dropped


def mi_splat_command(*arguments: str) -> list[str]:
    """Runs a command of the command line in another process."""
    return python_command("attacks", *arguments)


class JobRunner:
    """The selection and the jobs on what a painter shows, and the last message."""

    label, tab, leads = "mi-splat view", "Tools", False
    """Title of the page, name of the tab with the controls, and whether that is the first."""

    def __init__(
        self,
        painter: Painter,
        kinds: Sequence[JobKind] = (),
        *,
        renderer: Callable[[RenderSettings], RenderFn] = Renderer,
        program: Callable[..., list[str]] = mi_splat_command,
    ) -> None:
        self.painter, self.kinds, self._renderer, self._program = painter, tuple(kinds), renderer, program
        self.revision, self.lines = 0, tuple[str, ...]()
        self._first = painter
        self._picked: Picked | None = None
        self._queue: deque[Callable[[], None]] = deque(maxlen=MOST_QUEUED)
        self._job: tuple[Job, JobKind, JobRequest, Path] | None = None
        self._stopped = False
        self._temporary: tempfile.TemporaryDirectory[str] | None = None
        self._started = 0

    def panel(self, gui: Any, client: Client, wake: Callable[[], None]) -> Any:
        """The controls for a window, with `follow` and `follow_camera`."""
        return JobPanel(gui, self, client, wake)

    @property
    def content(self) -> Content:
        """What is shown now."""
        return self.painter.content

    @property
    def has_result(self) -> bool:
        """Whether the result of a job is shown."""
        return self.painter is not self._first

    @property
    def running(self) -> str:
        """Name of the running job; empty for none."""
        return "" if self._job is None else self._job[1].name

    @property
    def picked(self) -> Picked | None:
        """The selected object; None if there is none, or what is shown has no such Gaussians."""
        picked = self._picked
        fits = [splat.name for splat in self.content.splats if picked is not None and picked.fits(splat.scene)]
        if picked is None or not fits:
            return None
        return picked if picked.splat in fits else replace(picked, splat=fits[0])

    def later(self, task: Callable[[], None]) -> None:
        """Run an action in the thread that renders; from any thread."""
        self._queue.append(task)

    def turn(self) -> bool:
        """Do what is queued, and look after the job; whether anything has changed."""
        waiting = len(self._queue)  # what is queued meanwhile waits, so that pictures are made
        for _ in range(waiting):
            task = self._queue.popleft()
            try:
                task()
            except (MiSplatError, OSError) as error:
                self.lines = (str(error),)
        return self._poll() or waiting > 0

    def pick(self, click: Click) -> None:
        """Select what is at a pixel."""
        if any(click.splat == splat.name for splat in self.content.splats):  # else it is shown no longer
            self._select(pick(click, self.content, self.painter.render, self.picked))

    def clear(self) -> None:
        """Select nothing."""
        self._select(None)

    def _select(self, picked: Picked | None) -> None:
        self._picked, self.revision = picked, self.revision + 1
        self.painter.tint(picked)

    def command(self, kind: JobKind, orbit: Orbit, values: dict[str, Value]) -> str:
        """The command of a job, or why there is none."""
        try:
            arguments = kind.arguments(self._request(orbit, values), Path(MASK), kind.out)
        except MiSplatError as error:
            return f"# {error}"
        return shlex.join(["mi-splat", *arguments])

    def start(self, kind: JobKind, orbit: Orbit, values: dict[str, Value]) -> None:
        """Start a job."""
        if self._job is not None:
            raise InvalidValueError(message(kind.name, "one job at a time", f"{self.running} running", "stop it first"))
        if self._temporary is None:
            self._temporary = tempfile.TemporaryDirectory(prefix="mi-splat-view-")
        folder, request = Path(self._temporary.name) / str(self._started), self._request(orbit, values)
        arguments = kind.arguments(request, folder / MASK, folder / "result")
        folder.mkdir()
        if request.picked is not None:
            save_bytes(request.picked.file, folder / MASK)
        self._started += 1
        self._job = Job(self._program(*arguments), folder / "log.txt"), kind, request, folder / "result"
        self._stopped, self.lines = False, (f"{kind.name} is starting",)

    def stop(self) -> None:
        """Interrupt the job, which an attack ends with the best so far; kill it the second time."""
        if self._job is not None:
            self._job[0].stop(signal.SIGKILL if self._stopped else signal.SIGINT)
            self._stopped = True

    def back(self) -> None:
        """Show what was shown first."""
        self.painter, self.lines = self._first, ()

    def close(self) -> None:
        """Kill the job and delete all results."""
        if self._job is not None:
            self._job[0].stop(signal.SIGKILL)
        if self._temporary is not None:
            self._temporary.cleanup()

    def _request(self, orbit: Orbit, values: dict[str, Value]) -> JobRequest:
        return JobRequest(content=self.content, orbit=orbit, values=values, picked=self.picked)

    def _poll(self) -> bool:
        """Read what the job says, and open its result at the end; whether anything has changed."""
        if self._job is None:
            return False
        (job, kind, request, out), before = self._job, self.lines
        if job.status is None:
            self.lines = (f"{kind.name}: {job.last_line or 'starting'}",)
            return self.lines != before
        self._job = None
        if job.status and not (self._stopped and out.exists()):  # an interrupted attack keeps the best so far
            self.lines = (f"{kind.name} {'was stopped' if self._stopped else 'failed'}: {job.last_line}",)
            return True
        try:
            result = kind.opened(request, out)
        except (MiSplatError, OSError) as error:
            self.lines = (f"{kind.name}: {error}",)
            return True
        self.lines = result.lines
        if result.content is not None:
            inspector = result.inspector or self.painter.inspector
            self.painter = Painter(result.content, self._renderer(result.content.settings), inspector)
        return True
