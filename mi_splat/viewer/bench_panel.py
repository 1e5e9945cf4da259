"""The controls of the page that do something: pick an object, and have work done on it; for one visitor."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

from mi_splat.viewer.jobs import Choice, Field
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.panel import as_html
from mi_splat.viewer.picking import MASK, WHOLE

if TYPE_CHECKING:
    from mi_splat.viewer.bench import Bench

HOW_TO_PICK = "Click on an object in the picture; with Shift held, it joins those that are picked."

LAST = 1e9
"""Place of what stands below all that is added later."""
NOTHING_TO_PICK = "Photographs have no objects to pick; a splat has."


class Visit(Protocol):
    """What the controls ask of the visitor."""

    @property
    def orbit(self) -> Orbit:
        """The camera."""
        ...

    def fly(self, orbit: Orbit) -> None:
        """Take the camera somewhere else."""
        ...

    def pick_middle(self) -> None:
        """Pick what is in the middle of the picture."""
        ...

    def download(self, name: str, content: bytes) -> None:
        """Give the visitor a file."""
        ...


class Controls(Protocol):
    """What the page asks of a visitor's controls."""

    def follow(self) -> None:
        """Show what there is now."""
        ...

    def tell(self) -> None:
        """Show what belongs to the present camera."""
        ...


class BenchPanel:
    """Controls in the browser of one visitor.

    Args:
        gui: viser's interface for this visitor.
        bench: What they are for.
        visit: The visitor.
        wake: Called when something was asked for.
    """

    def __init__(self, gui: Any, bench: Bench, visit: Visit, wake: Callable[[], None]) -> None:
        self._gui, self._bench, self._visit, self._wake = gui, bench, visit, wake
        self._cameras: list[Any] = []
        self._fields = dict[str, dict[str, Any]]()
        self._commands, self._starts = dict[str, Any](), dict[str, Any]()
        self._seen: object = None
        self._work = gui.add_folder("Result", visible=False)
        with self._work:
            self._headline = gui.add_html("")
            self._details = gui.add_html("", order=LAST)
            self._bar = gui.add_progress_bar(0.0, animated=True, visible=False)
            self._stop = self._button("Stop", bench.stop)
            self._picture: Any = None
            self._back = self._button("Back to what was shown before", bench.back)
        self._add_object()
        for kind in () if bench.laboratory is None else bench.laboratory.kinds:
            self._add_kind(kind)
        self.follow()

    def follow(self) -> None:
        """Show what there is now."""
        bench, news, outcome = self._bench, self._bench.news, self._bench.outcome
        picked = bench.picked
        how = HOW_TO_PICK if bench.exhibit.splats else NOTHING_TO_PICK
        self._object.content = as_html([("", how if picked is None else picked.text)])
        self._select.value = "" if picked is None else picked.command
        self._select.visible = picked is not None and bool(picked.command)
        self._undo.disabled = self._save.disabled = picked is None
        if self._tint.value != bench.tinted:
            self._tint.value = bench.tinted
        for handle, part in zip(self._parts, WHOLE if picked is None else picked.parts, strict=True):
            handle.visible = picked is not None
            if handle.value != part:
                handle.value = part
        for kind, handles in self._fields.items():
            values = bench.values(kind)
            for field in bench.form(kind):
                _show(handles[field.name], field, values[field.name])
        for kind, start in self._starts.items():
            start.label = news.text if news is not None and bench.running == kind else kind
            start.disabled = news is not None
        self.tell()
        lines = bench.lines if news is None else (news.text, *bench.lines)
        self._headline.content = as_html([("", line) for line in lines[:1]])
        self._details.content = as_html([("", f"{line}\n") for line in lines[1:]])
        self._bar.visible = self._stop.visible = news is not None
        self._stop.label = "Stop now" if bench.ending else "Stop"
        self._bar.value = 0.0 if news is None or news.share is None else 100 * min(max(news.share, 0.0), 1.0)
        self._back.visible = len(bench.painters) > 1
        self._show_picture(news.picture if news is not None else outcome and outcome.picture)
        self._show_cameras()
        self._work.visible = bool(lines) or news is not None or self._back.visible

    def tell(self) -> None:
        """Show the commands that do from this camera what is chosen."""
        for kind, handle in self._commands.items():
            handle.value = self._bench.command(kind, self._visit.orbit)

    def _add_object(self) -> None:
        gui, bench = self._gui, self._bench
        with gui.add_folder("Object"):
            self._object = gui.add_html("")
            self._button("Pick what is in the middle", self._visit.pick_middle)
            self._undo = self._button("Undo", bench.undo)
            self._tint = gui.add_checkbox("Another colour", bench.tinted)
            self._on(self._tint, lambda value: bench.tint(bool(value)))
            hint = "Keeps what lies between two faces of the box"
            self._parts = [
                gui.add_multi_slider(f"Box, {axis}", 0.0, 1.0, 0.01, whole, visible=False, hint=hint)
                for axis, whole in zip("xyz", WHOLE, strict=True)
            ]
            for axis, handle in enumerate(self._parts):
                self._on(handle, partial(bench.trim, axis))
            self._save = self._button(f"Save {MASK}", self._download)
            self._select = gui.add_text("select", "", multiline=True, hint="Copy it to pick the same", visible=False)

    def _add_kind(self, kind: str) -> None:
        """The form of a kind of work."""
        gui, bench, values = self._gui, self._bench, self._bench.values(kind)
        with gui.add_folder(kind, expand_by_default=False):
            handles = self._fields[kind] = dict[str, Any]()
            for field in bench.form(kind):
                value = values[field.name]
                if isinstance(field, Choice):
                    handle = gui.add_dropdown(field.label, field.options, initial_value=value)
                else:
                    handle = gui.add_number(field.label, value, min=field.low, max=field.high, step=field.step)
                handles[field.name] = handle
                self._on(handle, partial(bench.choose, kind, field.name))
            self._starts[kind] = self._button(kind, lambda: bench.start(kind, self._visit.orbit))
            self._commands[kind] = gui.add_text("command", "", multiline=True, hint="Copy it to do the same")

    def _show_picture(self, pixels: Any) -> None:
        """Show a picture, or none."""
        if self._picture is None and pixels is not None:
            with self._work:
                self._picture = self._gui.add_image(pixels, format="png")
        elif self._picture is not None and pixels is not None:
            self._picture.image = pixels
        elif self._picture is not None:
            self._picture.remove()
            self._picture = None

    def _show_cameras(self) -> None:
        """A button for each camera that is worth a look."""
        outcome = self._bench.outcome
        if outcome is self._seen:
            return
        self._seen = outcome
        while self._cameras:
            self._cameras.pop().remove()
        with self._work:
            for name, orbit in (outcome.cameras if outcome is not None else {}).items():
                self._cameras.append(self._button(name, partial(self._visit.fly, orbit)))

    def _download(self) -> None:
        if self._bench.picked is not None:
            self._visit.download(MASK, self._bench.picked.file)

    def _button(self, label: str, act: Callable[[], None]) -> Any:
        button = self._gui.add_button(label)
        button.on_click(self._asks(lambda value: act()))
        return button

    def _on(self, handle: Any, act: Callable[[Any], None]) -> None:
        handle.on_update(self._asks(act))

    def _asks(self, act: Callable[[Any], None]) -> Callable[[Any], Coroutine[Any, Any, None]]:
        """What a visitor asks for is done in the thread of the pictures, one thing after the other."""

        async def heard(event: Any) -> None:
            if event.client is not None:  # else it was `follow`
                value = event.target.value
                self._bench.later(lambda: act(value))
                self._wake()

        return heard


def _show(handle: Any, field: Field, value: Any) -> None:
    """Show a field as it is now."""
    if isinstance(field, Choice) and tuple(handle.options) != field.options:
        handle.options = field.options
    if handle.value != value:
        handle.value = value
