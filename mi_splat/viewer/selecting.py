"""The object that is selected on a page, which its windows share, and the controls of
it in each window.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.viewer.boxes import FEWEST, FILE, Drag, file_of, pick_in_boxes
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.panel import as_html
from mi_splat.viewer.picking import MASK, Click, Picked, one_gaussian, pick

HOW_TO_SELECT = (
    "Click on an object in the image; hold Shift to add to the selection. Or hold"
    " Ctrl and drag a box around it, from two sides or more."
)
ANOTHER_BOX = "One box: turn the image, and draw another around the same object."
NOTHING_TO_SELECT = "Only splats have objects to select."
MOST_QUEUED = 100  # requests that wait; more are dropped
MOST_BOXES = 16  # boxes of an object; older ones are dropped


class SharedSelection:
    """What a painter shows, and the object that is selected in it.

    Requests of browsers are queued. `turn` carries them out; it is called again and
    again in the thread that renders.
    """

    def __init__(self, painter: Painter) -> None:
        self.painter = painter
        self.revision = 0
        self.error = ""
        self.picked: Picked | None = None
        self.drags: list[Drag] = []
        self.requests: deque[Callable[[], None]] = deque(maxlen=MOST_QUEUED)

    def later(self, task: Callable[[], None]) -> None:
        """Run an action in the thread that renders; from any thread."""
        self.requests.append(task)

    def turn(self) -> bool:
        """Do what is queued; whether there was anything."""
        # what is queued meanwhile waits, so that images are made
        waiting = len(self.requests)
        for _ in range(waiting):
            task = self.requests.popleft()
            self.error = ""
            try:
                task()
            except MiSplatError as error:
                self.error = str(error)
        return waiting > 0

    def pick(self, click: Click) -> None:
        """Select what is at a pixel."""
        self.select(pick(click, self.painter.content, self.painter.render, self.picked))

    def drag(self, drag: Drag) -> None:
        """Add a box around an object, and select it once there are enough."""
        if any(other.splat != drag.splat for other in self.drags):
            self.drags = []
        drags = [*self.drags, drag][-MOST_BOXES:]
        if len(drags) < FEWEST:
            self.drags = drags
            self.revision = self.revision + 1
            return
        picked = pick_in_boxes(drags, self.painter.content, self.painter.render)
        if not bool(picked.mask.any()):
            self.drags = []
            raise InvalidValueError.of(
                "boxes", "one object in all of them", "none", "draw them again"
            )
        self.select(picked)
        self.drags = drags

    def select(self, picked: Picked | None) -> None:
        """Select an object, or nothing."""
        self.drags = []
        self.picked = picked
        self.revision = self.revision + 1
        self.painter.tint(picked)


class SelectionPanel:
    """The controls of the selection in one window."""

    def __init__(
        self,
        gui: Any,
        shared: SharedSelection,
        *,
        orbit: Callable[[], Orbit],
        download: Callable[[str, bytes], None],
        wake: Callable[[], None],
    ) -> None:
        self._gui = gui
        self._shared = shared
        self._orbit = orbit
        self._send = download
        self._wake = wake
        with gui.add_folder("Object"):
            self._object = gui.add_html("")
            self._clear = self._button("Clear", lambda: shared.select(None))
            self._save = self._button(f"Save {MASK}", self._download)
            self._save_boxes = self._button(f"Save {FILE}", self._download_boxes)
            self._command = gui.add_text(
                "command",
                "",
                multiline=True,
                hint="Copy it to select the same Gaussians",
            )
        self.follow()

    def follow(self) -> None:
        """Show the present state."""
        picked = self._shared.picked
        content = self._shared.painter.content
        how = HOW_TO_SELECT if content.splats else NOTHING_TO_SELECT
        text = how if picked is None else picked.text
        drags = self._shared.drags
        if drags:
            boxes = f"{len(drags)} boxes" if len(drags) > 1 else ANOTHER_BOX
            text = boxes if len(drags) < FEWEST else f"{text}, in {boxes}"
        self._object.content = as_html([("", self._shared.error or text)])
        if picked is not None and picked.row is not None:
            self._object.content += one_gaussian(
                content.splat(picked.splat).scene, picked.row, self._orbit()
            )
        self._command.value = "" if picked is None else picked.command
        self._command.visible = bool(self._command.value)
        self._save.disabled = picked is None
        self._save_boxes.disabled = len(drags) < FEWEST
        self._clear.disabled = picked is None and not drags

    def _download(self) -> None:
        if self._shared.picked is not None:
            self._send(MASK, self._shared.picked.file)

    def _download_boxes(self) -> None:
        drags = self._shared.drags
        if drags:
            self._send(FILE, file_of(drags, self._shared.painter.content))

    def _button(self, label: str, act: Callable[[], None]) -> Any:
        """A button whose action the thread that renders carries out."""
        button = self._gui.add_button(label)

        @button.on_click  # type: ignore[untyped-decorator]
        async def _(event: Any) -> None:
            if event.client is not None:  # else it was `follow`
                self._shared.later(act)
                self._wake()

        return button
