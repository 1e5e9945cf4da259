"""The controls of the page, for one visitor: they change the state, and they follow it."""

import html
import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from mi_splat.errors import InvalidValueError
from mi_splat.viewer.composition import SPLIT, ways_of_showing
from mi_splat.viewer.exhibit import Exhibit
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.session import ViewState

FREE = "(free)"
"""Name of a camera that is none of those to choose from; in more parentheses if one of those has it."""

Remark = tuple[str, str]
"""What it is about, which may be nothing, and what is said of it: plain text, whatever stands in it."""

Change = Callable[[Callable[[ViewState], ViewState]], None]
"""Takes what makes the wished state of the present one."""


class Panel:
    """Controls in the browser of one visitor.

    Args:
        gui: viser's interface for this visitor.
        exhibit: What is shown.
        state: What is seen at first.
        inspector: Whether somebody looks at the pictures.
        change: Called with each wish.
    """

    def __init__(self, gui: Any, exhibit: Exhibit, state: ViewState, *, inspector: bool, change: Change) -> None:
        self._exhibit, self._change, orbit = exhibit, change, state.orbit
        gui.add_html(as_html([("", exhibit.title)]))
        if len(exhibit.names) > 1:
            self._show = gui.add_dropdown("Show", ways_of_showing(exhibit.names), initial_value=state.show)
            self._split = gui.add_slider("Split", 0.0, 1.0, 0.01, state.split, visible=state.show == SPLIT)
            self._wish(self._show, lambda s, value: replace(s, show=value))
            self._wish(self._split, lambda s, value: replace(s, split=_fraction(value, s.split)))
        self._free = FREE
        while self._free in exhibit.cameras:
            self._free = f"({self._free})"
        with gui.add_folder("Camera"):
            if exhibit.cameras:
                name = self._camera_name(orbit)
                self._camera = gui.add_dropdown("From", (self._free, *exhibit.cameras), initial_value=name)
                self._wish(self._camera, lambda s, value: replace(s, orbit=exhibit.cameras.get(value, s.orbit)))
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
                self._wish(slider, lambda s, value, name=attribute: replace(s, orbit=_turned(s.orbit, name, value)))
        self._add_drawings(gui, state, inspector)
        with gui.add_folder("This picture"):
            self._findings = gui.add_html("")
        with gui.add_folder("As a command"):
            self._commands = {
                name: gui.add_text(name, "", multiline=True, hint="Copy it to make this picture as a PNG")
                for name in (splat.name for splat in exhibit.splats)
            }

    def follow(self, state: ViewState) -> None:
        """Show the state in the controls."""
        for name, slider in self._sliders.items():
            slider.value = _clipped(getattr(state.orbit, name), slider.min, slider.max)
        if self._exhibit.cameras:
            self._camera.value = self._camera_name(state.orbit)
        if len(self._exhibit.names) > 1:
            self._split.visible = state.show == SPLIT

    def tell(self, remarks: Iterable[Remark], commands: dict[str, str]) -> None:
        """Show what is known of the picture, and the commands that make it."""
        self._findings.content = as_html(remarks)
        for name, command in commands.items():
            self._commands[name].value = command

    def _add_drawings(self, gui: Any, state: ViewState, inspector: bool) -> None:
        """A checkbox for each thing that is drawn into pictures."""
        if not (inspector or self._exhibit.lines):
            return
        with gui.add_folder("Draw"):
            if inspector:
                box = gui.add_checkbox("Detections", state.inspected)
                self._wish(box, lambda s, value: replace(s, inspected=bool(value)))
            for name in self._exhibit.lines:
                box = gui.add_checkbox(name, name in state.lines)
                self._wish(box, lambda s, on, name=name: replace(s, lines=s.lines | {name} if on else s.lines - {name}))

    def _wish(self, handle: Any, wished: Callable[..., ViewState]) -> None:
        """Let a control that the visitor moves change the state."""

        # A coroutine, which viser runs before it hears anything else: in another thread, the value could be the next.
        @handle.on_update  # type: ignore[untyped-decorator]
        async def _(event: Any) -> None:
            if event.client is not None:  # else it was `follow`
                value = event.target.value
                self._change(lambda state: wished(state, value))

    def _camera_name(self, orbit: Orbit) -> str:
        """Name of the camera to choose that this is."""
        return self._exhibit.camera_name(orbit) or self._free


def as_html(remarks: Iterable[Remark]) -> str:
    """Remarks below each other.

    Of all that viser gets, this alone is markup: labels, names to choose from and commands it shows as plain text. Its
    Markdown is no way to show a name, since HTML in it stays HTML, and pictures in it are files of this machine.
    """
    shown = [
        (f"<strong>{html.escape(about)}</strong>: " if about else "") + html.escape(remark) for about, remark in remarks
    ]
    style = "padding: 0 0.75rem 0.5rem; font-size: 0.875rem; white-space: pre-wrap; overflow-wrap: anywhere"
    text = "\n".join(shown).encode("utf-8", "replace").decode()  # JSON may hold what is no Unicode
    return f'<div style="{style}">{text}</div>'


def _fraction(value: Any, otherwise: float) -> float:
    """A number in [0, 1], if it is one: what comes from a browser may be anything."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return otherwise
    return number if 0 <= number <= 1 else otherwise


def _turned(orbit: Orbit, attribute: str, value: Any) -> Orbit:
    """The camera with one number changed; the same camera if it cannot be."""
    try:
        changes: dict[str, Any] = {attribute: float(value)}
        return orbit.changed(**changes)
    except (InvalidValueError, TypeError, ValueError):
        return orbit


def _clipped(value: float, low: float, high: float) -> float:
    """A number as a slider can show it: in its range, with two decimals."""
    return min(max(round(value, 2), low), high)
