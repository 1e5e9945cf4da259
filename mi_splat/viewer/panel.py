"""The controls of one window: of the view, and of the selected object and the jobs on it."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Coroutine, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from mi_splat.errors import InvalidValueError
from mi_splat.viewer.content import Content
from mi_splat.viewer.jobs import Choice, JobKind, Value
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.picking import MASK
from mi_splat.viewer.session import ViewState, display_modes

if TYPE_CHECKING:
    from mi_splat.viewer.runner import JobRunner
    from mi_splat.viewer.server import Client

FREE = "(free)"  # name of a camera that is not listed; in more parentheses if a listed one is called so
HOW_TO_SELECT = "Click on an object in the picture; hold Shift to add to the selection."
NOTHING_TO_SELECT = "Only splats have objects to select."

Remark = tuple[str, str]  # what it is about, which may be nothing, and plain text from anywhere
Change = Callable[[Callable[[ViewState], ViewState]], None]  # changes the state of a window


class ViewPanel:
    """The controls of what a window shows."""

    def __init__(self, gui: Any, content: Content, state: ViewState, *, inspector: bool, change: Change) -> None:
        self._content, self._change, orbit = content, change, state.orbit
        gui.add_html(as_html([("", content.title)]))
        if len(content.names) > 1:
            modes = gui.add_dropdown("Show", display_modes(content.names), initial_value=state.mode)
            self._connect(modes, lambda s, value: replace(s, mode=value))
        self._free = FREE
        while self._free in content.cameras:
            self._free = f"({self._free})"
        with gui.add_folder("Camera"):
            if content.cameras:
                name = content.camera_name(orbit) or self._free
                self._camera = gui.add_dropdown("From", (self._free, *content.cameras), initial_value=name)
                self._connect(self._camera, lambda s, value: replace(s, orbit=content.cameras.get(value, s.orbit)))
            step = 10 ** math.floor(math.log10(orbit.distance)) / 20
            ranges = {
                "elevation": ("Elevation", -90.0, 90.0, 1.0),
                "azimuth": ("Azimuth", 0.0, 359.0, 1.0),
                "distance": ("Distance", step, step * math.ceil(4 * orbit.distance / step), step),
                "fov": ("Field of view", 5.0, 120.0, 1.0),
                "roll": ("Roll", -180.0, 180.0, 1.0),
            }
            self._sliders = {
                name: gui.add_slider(label, low, high, by, _clipped(getattr(orbit, name), low, high))
                for name, (label, low, high, by) in ranges.items()
            }
            for attribute, slider in self._sliders.items():
                self._connect(slider, lambda s, value, name=attribute: replace(s, orbit=_changed(s.orbit, name, value)))
        if inspector:
            box = gui.add_checkbox("Detections", state.inspected)
            self._connect(box, lambda s, value: replace(s, inspected=bool(value)))
        with gui.add_folder("This picture"):
            self._remarks = gui.add_html("")
        with gui.add_folder("As a command"):
            self._commands = {
                name: gui.add_text(name, "", multiline=True, hint="Copy it to make this picture as a PNG")
                for name in (splat.name for splat in content.splats)
            }

    def follow(self, state: ViewState) -> None:
        """Show the state in the controls."""
        for name, slider in self._sliders.items():
            slider.value = _clipped(getattr(state.orbit, name), slider.min, slider.max)
        if self._content.cameras:
            self._camera.value = self._content.camera_name(state.orbit) or self._free

    def describe(self, remarks: Iterable[Remark], commands: dict[str, str]) -> None:
        """Show what is known of the picture, and the commands that make it."""
        self._remarks.content = as_html(remarks)
        for name, command in commands.items():
            self._commands[name].value = command

    def _connect(self, handle: Any, changed: Callable[..., ViewState]) -> None:
        """Let a control change the state."""

        # viser runs a coroutine before it hears anything else; in another thread, the value could be the next one.
        @handle.on_update  # type: ignore[untyped-decorator]
        async def _(event: Any) -> None:
            if event.client is not None:  # else it was `follow`
                value = event.target.value
                self._change(lambda state: changed(state, value))


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
            self._button("Select what is in the middle", client.pick_middle)
            self._clear = self._button("Clear", runner.clear)
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


def as_html(remarks: Iterable[Remark]) -> str:
    """Remarks below each other.

    This is the only markup that viser gets: it shows labels, options and commands as plain text. Its Markdown cannot
    hold foreign names, because HTML in it stays HTML, and pictures in it are files of this machine.
    """
    shown = [
        (f"<strong>{html.escape(about)}</strong>: " if about else "") + html.escape(remark) for about, remark in remarks
    ]
    style = "padding: 0 0.75rem 0.5rem; font-size: 0.875rem; white-space: pre-wrap; overflow-wrap: anywhere"
    text = "\n".join(shown).encode("utf-8", "replace").decode()  # JSON may hold what is no Unicode
    return f'<div style="{style}">{text}</div>'


def _changed(orbit: Orbit, attribute: str, value: Any) -> Orbit:
    """The camera with one number changed; the same camera if a browser sent an invalid one."""
    try:
        changes: dict[str, Any] = {attribute: float(value)}
        return orbit.changed(**changes)
    except (InvalidValueError, TypeError, ValueError):
        return orbit


def _clipped(value: float, low: float, high: float) -> float:
    """A number as a slider can show it: in its range, with two decimals."""
    return min(max(round(value, 2), low), high)
