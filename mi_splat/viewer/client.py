"""One browser window of a page: what it shows, and what its user does."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from mi_splat.errors import MiSplatError
from mi_splat.viewer.layout import display_modes
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import Painting
from mi_splat.viewer.panel import Remark, ViewPanel
from mi_splat.viewer.picking import Click, clicked
from mi_splat.viewer.runner import JobRunner
from mi_splat.viewer.session import Session, Step, ViewState

VIEW = "View"
"""Name of the tab with the controls of what is shown."""
JPEG_QUALITY = {Step.COARSE: 75, Step.FULL: 92, Step.INSPECTED: 92}
SETTLING = 1.0
"""Seconds after a control was moved in which reports of the browser's camera, which follows late, are ignored."""
ECHOES = 128
"""Poses that a browser was sent and may report later, as if the mouse had moved its camera there."""
LONGEST_SIDE = 8192
"""Pixels of the largest window that is believed."""


class Client:
    """One browser window.

    The server's thread handles its messages, one after the other; another thread renders its pictures.
    """

    def __init__(self, handle: Any, runner: JobRunner, wake: Callable[[], None]) -> None:
        self._handle, self._runner, self._painter, self._wake = handle, runner, runner.painter, wake
        self._lock, self._settled = threading.Lock(), 0.0
        self._sent: deque[Orbit] = deque(maxlen=ECHOES)
        first = self._first_state(self._painter.content.start, _canvas(handle.camera))
        self._session = Session(state=first, changed=time.monotonic())
        tabs, names = handle.gui.add_tab_group(), (VIEW, runner.tab)
        added = {name: tabs.add_tab(name) for name in (reversed(names) if runner.leads else names)}
        self._view = added[VIEW]
        self._add_panel()
        with added[runner.tab]:
            self._shared_panel = runner.panel(handle.gui, self, wake)
        # The pose before the browser has read where to begin is not a move of its user.
        self._sent.append(first.orbit.moved(handle.camera.position, handle.camera.look_at))
        self._send_camera(first.orbit)
        handle.camera.on_update(self._camera_moved)
        handle.scene.on_click()(self._clicked)
        handle.scene.on_click(modifier="shift")(self._clicked)

    @property
    def orbit(self) -> Orbit:
        """The camera."""
        return self._session.state.orbit

    def follow(self) -> None:
        """Show what the windows share as it is now."""
        if self._painter is not self._runner.painter:
            with self._lock:  # messages that arrive meanwhile are for the new controls
                self._painter, state = self._runner.painter, self._session.state
                self._session = Session(state=self._first_state(state.orbit, state.canvas), changed=time.monotonic())
                for control in tuple(self._view._children.values()):
                    control.remove()
                self._add_panel()
        self._change(lambda state: replace(state, revision=self._runner.revision))
        self._shared_panel.follow()

    def download(self, name: str, content: bytes) -> None:
        """Send a file to the user."""
        self._handle.send_file_download(name, content, save_immediately=True)

    def pick_middle(self) -> None:
        """Select what is in the middle of the first picture."""
        layout = self._painter.layout(self._session.state)
        (left, top), (width, height) = layout.corners[0], layout.size
        self._pick(((left + width / 2) / layout.canvas[0], (top + height / 2) / layout.canvas[1]), adds=False)

    def due(self) -> Step | None:
        """The picture to make now."""
        return self._session.due(time.monotonic(), inspector=self._painter.inspector is not None)

    def paint(self, step: Step) -> None:
        """Make a picture and send it."""
        with self._lock:
            state, pace = self._session.state, self._session.pace
        started = time.perf_counter()
        try:
            painting, quality = self._painter.paint(state, step, pace), JPEG_QUALITY[step]
            self._handle.scene.set_background_image(painting.pixels, format="jpeg", jpeg_quality=quality)
            if step is not Step.COARSE:
                self._panel.describe(self._remarks(state, painting), self._painter.commands(state.orbit))
                self._shared_panel.follow_camera()
        except MiSplatError as error:  # of this picture; the next one may succeed
            self._panel.describe([("", str(error))], {})
        self._handle.flush()
        with self._lock:
            self._session = self._session.done(step, state, time.perf_counter() - started)

    def _remarks(self, state: ViewState, painting: Painting) -> Iterator[Remark]:
        """What is known of a picture."""
        content = self._painter.content
        for line in (*content.describe(state.orbit.camera(content.size)), self._painter.comparison(state.orbit)):
            if line:
                yield "", line
        for name, inspection in painting.inspections.items():
            yield name, inspection.text

    def _first_state(self, orbit: Orbit, canvas: tuple[int, int]) -> ViewState:
        mode = display_modes(self._painter.content.names)[0]
        return ViewState(orbit=orbit, mode=mode, canvas=canvas, revision=self._runner.revision)

    def _add_panel(self) -> None:
        inspector, content, state = self._painter.inspector is not None, self._painter.content, self._session.state
        with self._view:
            self._panel = ViewPanel(self._handle.gui, content, state, inspector=inspector, change=self._change)

    async def _clicked(self, event: Any) -> None:
        self._pick(event.screen_pos, adds=event.modifier is not None)

    def _pick(self, at: tuple[float, float], *, adds: bool) -> None:
        """Select what a point of the page shows."""
        state = self._session.state
        hit = clicked(at, self._painter.layout(state), state.mode, self._painter.content, state.orbit)
        if hit is not None:
            click = Click(splat=hit[0], pixel=hit[1], orbit=state.orbit, adds=adds)
            self._runner.later(lambda: self._runner.pick(click))
            self._wake()

    def _change(self, changed: Callable[[ViewState], ViewState]) -> None:
        """Change the state by a control."""
        with self._lock:
            before = self._session.state
            after = changed(before)
            # A browser may send anything, and values of controls that were removed.
            if after.mode not in display_modes(self._painter.content.names):
                after = replace(after, mode=before.mode)
            self._session = self._session.change(after, time.monotonic())
            self._panel.follow(after)
        if after.orbit != before.orbit:
            self._send_camera(after.orbit)
        self._wake()

    def _send_camera(self, orbit: Orbit) -> None:
        """Move the browser's camera."""
        with self._lock:
            self._settled = time.monotonic() + SETTLING
            self._sent.append(orbit)
        with self._handle.atomic():
            self._handle.camera.position = orbit.position
            self._handle.camera.look_at = orbit.target

    async def _camera_moved(self, camera: Any) -> None:
        with self._lock:
            now, state, pose = time.monotonic(), self._session.state, (camera.position, camera.look_at)
            after = replace(state, canvas=_canvas(camera))
            if now >= self._settled and not any(orbit.is_at(*pose) for orbit in (state.orbit, *self._sent)):
                after = replace(after, orbit=state.orbit.moved(*pose))
                self._sent.clear()
            self._session = self._session.change(after, now)
            if after.orbit != state.orbit:
                self._panel.follow(after)
        self._wake()


def _canvas(camera: Any) -> tuple[int, int]:
    """Width and height in pixels of a window, as far as they can be believed."""
    width, height = (min(max(int(side), 16), LONGEST_SIDE) for side in (camera.image_width, camera.image_height))
    return width, height
