"""What the windows of a page share: the selected object, the running job and its result, and their controls.

All of it happens in the thread that renders, where `turn` is called again and again; requests of browsers are queued.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import tempfile
from collections import deque
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_splat.cameras import RenderFn
from mi_splat.errors import InvalidValueError, MiSplatError, message, printable
from mi_splat.io.documents import save_bytes
from mi_splat.processes import python_command
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.viewer.content import Content, Inspector
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.panel import as_html
from mi_splat.viewer.picking import MASK, Click, Picked, one_gaussian, pick

if TYPE_CHECKING:
    from mi_splat.viewer.server import Client

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
        return value if isinstance(value, int | float) and self.low <= value <= self.high else self.default


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


HOW_TO_SELECT = "Click on an object in the picture; hold Shift to add to the selection."
NOTHING_TO_SELECT = "Only splats have objects to select."
MOST_QUEUED = 100  # requests that wait; more are dropped
MI_SPLAT = partial(python_command, "attacks")  # runs a command of the command line in another process


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
        program: Callable[..., list[str]] = MI_SPLAT,
    ) -> None:
        self.painter, self.kinds, self._renderer, self._program = painter, tuple(kinds), renderer, program
        self.revision, self.lines = 0, tuple[str, ...]()
        self._first = painter
        self._picked: Picked | None = None
        self.requests: deque[Callable[[], None]] = deque(maxlen=MOST_QUEUED)
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
        self.requests.append(task)

    def turn(self) -> bool:
        """Do what is queued, and look after the job; whether anything has changed."""
        waiting = len(self.requests)  # what is queued meanwhile waits, so that pictures are made
        for _ in range(waiting):
            task = self.requests.popleft()
            try:
                task()
            except (MiSplatError, OSError) as error:
                self.lines = (str(error),)
        return self._poll() or waiting > 0

    def pick(self, click: Click) -> None:
        """Select what is at a pixel."""
        if any(click.splat == splat.name for splat in self.content.splats):  # else it is shown no longer
            self.select(pick(click, self.content, self.painter.render, self.picked))

    def select(self, picked: Picked | None) -> None:
        """Select an object, or nothing."""
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


class JobPanel:
    """The controls of the selection and of the jobs."""

    def __init__(self, gui: Any, runner: JobRunner, client: Client, wake: Callable[[], None]) -> None:
        self._gui, self._runner, self._client, self._wake = gui, runner, client, wake
        self._forms = list[tuple[JobKind, dict[str, Any], Any, Any]]()
        self._result = gui.add_folder("Result", visible=False)
        with self._result:
            self._lines = gui.add_html("")
            self._stop = self._button("Stop", runner.stop)
            self._back = self._button("Back to what was shown before", runner.back)
        with gui.add_folder("Object"):
            self._object = gui.add_html("")
            self._clear = self._button("Clear", lambda: runner.select(None))
            self._save = self._button(f"Save {MASK}", self._download)
            self._select = gui.add_text("command", "", multiline=True, hint="Copy it to select the same Gaussians")
        for kind in runner.kinds:
            self._add_form(kind)
        self.follow()

    def follow(self) -> None:
        """Show the present state."""
        runner, picked = self._runner, self._runner.picked
        how = HOW_TO_SELECT if runner.content.splats else NOTHING_TO_SELECT
        self._object.content = as_html([("", how if picked is None else picked.text)])
        if picked is not None and picked.row is not None:
            scene = runner.content.splat(picked.splat).scene
            self._object.content += one_gaussian(scene, picked.row, self._client.orbit)
        self._select.value = "" if picked is None else picked.command
        self._select.visible = bool(self._select.value)
        self._clear.disabled = self._save.disabled = picked is None
        self._lines.content = as_html([("", f"{line}\n") for line in runner.lines])
        self._stop.visible, self._back.visible = bool(runner.running), runner.has_result
        self._result.visible = bool(runner.lines) or runner.has_result
        for _, _, start, _ in self._forms:
            start.disabled = bool(runner.running)
        self.follow_camera()

    def follow_camera(self) -> None:
        """Show the commands of the jobs from this camera."""
        for kind, handles, _, command in self._forms:
            command.value = self._runner.command(kind, self._client.orbit, _values(kind, handles))

    def _add_form(self, kind: JobKind) -> None:
        """The fields of a kind of job, the button that starts it, and its command."""
        gui, handles = self._gui, dict[str, Any]()
        with gui.add_folder(kind.name, expand_by_default=False):
            for field in kind.fields:
                if isinstance(field, Choice):
                    handle = gui.add_dropdown(field.label, field.options, initial_value=field.default)
                else:
                    handle = gui.add_number(field.label, field.default, min=field.low, max=field.high, step=field.step)
                handles[field.name] = handle
                handle.on_update(self._queued(self.follow_camera))
            start = self._button(
                kind.name, lambda: self._runner.start(kind, self._client.orbit, _values(kind, handles))
            )
            self._forms.append((kind, handles, start, gui.add_text("command", "", multiline=True)))

    def _download(self) -> None:
        if self._runner.picked is not None:
            self._client.download(MASK, self._runner.picked.file)

    def _button(self, label: str, act: Callable[[], None]) -> Any:
        button = self._gui.add_button(label)
        button.on_click(self._queued(act))
        return button

    def _queued(self, act: Callable[[], None]) -> Callable[[Any], Coroutine[Any, Any, None]]:
        """Queues an action for the thread that renders."""

        async def queue(event: Any) -> None:
            if event.client is not None:  # else it was `follow`
                self._runner.later(act)
                self._wake()

        return queue


def _values(kind: JobKind, handles: dict[str, Any]) -> dict[str, Value]:
    """The valid values of a form."""
    return {field.name: field.valid(handles[field.name].value) for field in kind.fields}
