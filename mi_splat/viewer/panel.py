"""The controls of what a window shows."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from mi_splat.errors import InvalidValueError
from mi_splat.viewer.content import Content
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.session import ViewState, display_modes

# name of a camera that is not listed; in more parentheses if a listed one is called so
FREE = "(free)"

# what it is about, which may be nothing, and plain text from anywhere
Remark = tuple[str, str]
# changes the state of a window
Change = Callable[[Callable[[ViewState], ViewState]], None]


class ViewPanel:
    """The controls of what a window shows."""

    def __init__(
        self,
        gui: Any,
        content: Content,
        state: ViewState,
        *,
        inspector: bool,
        change: Change,
    ) -> None:
        self._content = content
        self._change = change
        orbit = state.orbit
        gui.add_html(as_html([("", content.title)]))
        if len(content.names) > 1:
            modes = gui.add_dropdown(
                "Show", display_modes(content.names), initial_value=state.mode
            )
            self._connect(modes, lambda s, value: replace(s, mode=value))
        self._free = FREE
        while self._free in content.cameras:
            self._free = f"({self._free})"
        with gui.add_folder("Camera"):
            if content.cameras:
                name = content.camera_name(orbit) or self._free
                self._camera = gui.add_dropdown(
                    "From", (self._free, *content.cameras), initial_value=name
                )
                self._connect(
                    self._camera,
                    lambda s, value: replace(
                        s, orbit=content.cameras.get(value, s.orbit)
                    ),
                )
            step = 10 ** math.floor(math.log10(orbit.distance)) / 20
            ranges = {
                "elevation": ("Elevation", -90.0, 90.0, 1.0),
                "azimuth": ("Azimuth", 0.0, 359.0, 1.0),
                "distance": (
                    "Distance",
                    step,
                    step * math.ceil(4 * orbit.distance / step),
                    step,
                ),
                "fov": ("Field of view", 5.0, 120.0, 1.0),
                "roll": ("Roll", -180.0, 180.0, 1.0),
            }
            self._sliders = {
                name: gui.add_slider(
                    label, low, high, by, _clipped(getattr(orbit, name), low, high)
                )
                for name, (label, low, high, by) in ranges.items()
            }
            for attribute, slider in self._sliders.items():
                self._connect(
                    slider,
                    lambda s, value, name=attribute: replace(
                        s, orbit=_changed(s.orbit, name, value)
                    ),
                )
        if inspector:
            box = gui.add_checkbox("Detections", state.inspected)
            self._connect(box, lambda s, value: replace(s, inspected=bool(value)))
        with gui.add_folder("This image"):
            self._remarks = gui.add_html("")
        with gui.add_folder("As a command"):
            self._commands = {
                name: gui.add_text(
                    name,
                    "",
                    multiline=True,
                    hint="Copy it to make this image as a PNG",
                )
                for name in (splat.name for splat in content.splats)
            }

    def follow(self, state: ViewState) -> None:
        """Show the state in the controls."""
        for name, slider in self._sliders.items():
            slider.value = _clipped(getattr(state.orbit, name), slider.min, slider.max)
        if self._content.cameras:
            self._camera.value = self._content.camera_name(state.orbit) or self._free

    def describe(self, remarks: Iterable[Remark], commands: dict[str, str]) -> None:
        """Show what is known of the image, and the commands that make it."""
        self._remarks.content = as_html(remarks)
        for name, command in commands.items():
            self._commands[name].value = command

    def _connect(self, handle: Any, changed: Callable[..., ViewState]) -> None:
        """Let a control change the state."""

        # viser runs a coroutine before it hears anything else; in another thread, the
        # value could be the next one.
        @handle.on_update  # type: ignore[untyped-decorator]
        async def _(event: Any) -> None:
            if event.client is not None:  # else it was `follow`
                value = event.target.value
                self._change(lambda state: changed(state, value))


def as_html(remarks: Iterable[Remark]) -> str:
    """Remarks below each other.

    This is the only markup that viser gets: it shows labels, options and commands as
    plain text. Its Markdown cannot hold foreign names, because HTML in it stays HTML,
    and images in it are files of this machine.
    """
    shown = [
        (f"<strong>{html.escape(about)}</strong>: " if about else "")
        + html.escape(remark)
        for about, remark in remarks
    ]
    style = (
        "padding: 0 0.75rem 0.5rem; font-size: 0.875rem; white-space: pre-wrap;"
        " overflow-wrap: anywhere"
    )
    # JSON may hold what is no Unicode
    text = "\n".join(shown).encode("utf-8", "replace").decode()
    return f'<div style="{style}">{text}</div>'


def _changed(orbit: Orbit, attribute: str, value: Any) -> Orbit:
    """The camera with one number changed; the same camera if a browser sent an invalid
    one.
    """
    try:
        changes: dict[str, Any] = {attribute: float(value)}
        return orbit.changed(**changes)
    except (InvalidValueError, TypeError, ValueError):
        return orbit


def _clipped(value: float, low: float, high: float) -> float:
    """A number as a slider can show it: in its range, with two decimals."""
    return min(max(round(value, 2), low), high)
