"""One browser window on the page: what it is shown, and what its visitor does."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from mi_splat.errors import MiSplatError
from mi_splat.viewer.bench import Bench
from mi_splat.viewer.composition import ways_of_showing
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import Painting
from mi_splat.viewer.panel import Panel, Remark
from mi_splat.viewer.picking import Click, clicked
from mi_splat.viewer.session import Session, Step, ViewState

LOOK = "Look"
"""Name of the tab with the controls of what is shown."""
JPEG_QUALITY = {Step.COARSE: 75, Step.FULL: 92, Step.INSPECTED: 92}
DEAF = 1.0
"""Seconds after a control was moved in which the browser's camera, which follows it late, is not listened to."""
ECHOES = 128
"""Poses that a browser was told and may report later, as if somebody had moved its camera there."""
LONGEST_SIDE = 8192
"""Pixels of the largest window that is believed."""


class Visitor:
    """One browser window.

    What the browser says is heard in the thread of the server, one thing after the other; pictures are made in another.

    Args:
        client: viser's handle of it.
        bench: Has what makes its pictures, and what is done beside.
        wake: Called when something changed.
    """

    def __init__(self, client: Any, bench: Bench, wake: Callable[[], None]) -> None:
        self.client, self._bench, self._painter, self._wake = client, bench, bench.painter, wake
        self._lock, self._deaf_until = threading.Lock(), 0.0
        self._sent: deque[Orbit] = deque(maxlen=ECHOES)  # the browser says late where it was told to be
        first = self._first_state(self._painter.exhibit.start, _canvas(client.camera))
        self._session = Session(state=first, changed=time.monotonic())
        tabs, names = client.gui.add_tab_group(), (LOOK, bench.tab)
        added = {name: tabs.add_tab(name) for name in (reversed(names) if bench.leads else names)}
        self._look = added[LOOK]
        self._add_panel()
        with added[bench.tab]:
            self._bench_panel = bench.panel(client.gui, self, wake)
        # What it shows before it has read where to begin is nobody's wish.
        self._sent.append(first.orbit.moved(client.camera.position, client.camera.look_at))
        self._set_camera(first.orbit)
        client.camera.on_update(self._change_by_camera)
        client.scene.on_click()(self._click)
        client.scene.on_click(modifier="shift")(self._click)

    @property
    def orbit(self) -> Orbit:
        """The camera."""
        return self._session.state.orbit

    def follow(self) -> None:
        """Show what has become of the work, and what is shown now."""
        if self._painter is not self._bench.painter:
            with self._lock:  # what the browser says meanwhile is for the new controls
                self._painter, state = self._bench.painter, self._session.state
                self._session = Session(state=self._first_state(state.orbit, state.canvas), changed=time.monotonic())
                for control in tuple(self._look._children.values()):
                    control.remove()
                self._add_panel()
        self._change_by_control(lambda state: replace(state, tint=self._bench.tints))
        self._bench_panel.follow()

    def fly(self, orbit: Orbit) -> None:
        """Take the camera somewhere else."""
        self._change_by_control(lambda state: replace(state, orbit=orbit))

    def download(self, name: str, content: bytes) -> None:
        """Give the visitor a file."""
        self.client.send_file_download(name, content, save_immediately=True)

    def pick_middle(self) -> None:
        """Pick what is in the middle of the first picture."""
        state = self._session.state
        layout = self._painter.layout(state)
        (left, top), (width, height) = layout.corners[0], layout.size
        self._pick(((left + width / 2) / layout.canvas[0], (top + height / 2) / layout.canvas[1]), adds=False)

    def due(self) -> Step | None:
        """The picture to make now."""
        return self._session.due(time.monotonic(), inspector=self._painter.inspector is not None)

    def paint(self, step: Step) -> None:
        """Make a picture and send it."""
        with self._lock:
            state, pace = self._session.state, self._session.pace
        begun, every = time.perf_counter(), 1
        try:
            painting = self._painter.paint(state, step, pace)
            scene, every = self.client.scene, painting.every
            scene.set_background_image(painting.pixels, format="jpeg", jpeg_quality=JPEG_QUALITY[step])
            if step is not Step.COARSE:
                self._panel.tell(self._remarks(state, painting), self._painter.commands(state.orbit))
                self._bench_panel.tell()
        except MiSplatError as error:  # of this picture; the next one may do
            self._panel.tell([("", str(error))], {})
        self.client.flush()
        with self._lock:
            self._session = self._session.done(step, state, time.perf_counter() - begun, every=every)

    def _remarks(self, state: ViewState, painting: Painting) -> Iterator[Remark]:
        """What is known of the picture."""
        exhibit = self._painter.exhibit
        for line in exhibit.describe(state.orbit.camera(exhibit.size)):
            yield "", line
        if alike := self._painter.comparison(state.orbit):
            yield "", alike
        for name, inspection in painting.inspections.items():
            yield name, inspection.text

    def _first_state(self, orbit: Orbit, canvas: tuple[int, int]) -> ViewState:
        """What is seen of an exhibit at first."""
        show = ways_of_showing(self._painter.exhibit.names)[0]
        return ViewState(orbit=orbit, show=show, canvas=canvas, tint=self._bench.tints)

    def _add_panel(self) -> None:
        """The controls of what is shown."""
        inspector, exhibit, state = self._painter.inspector is not None, self._painter.exhibit, self._session.state
        with self._look:
            self._panel = Panel(self.client.gui, exhibit, state, inspector=inspector, change=self._change_by_control)

    async def _click(self, event: Any) -> None:
        self._pick(event.screen_pos, adds=event.modifier is not None)

    def _pick(self, at: tuple[float, float], *, adds: bool) -> None:
        """Pick what a point of the page shows."""
        state = self._session.state
        hit = clicked(
            at, self._painter.layout(state), state.show, self._painter.exhibit, state.orbit, split=state.split
        )
        if hit is not None:
            click = Click(splat=hit[0], pixel=hit[1], orbit=state.orbit, adds=adds)
            self._bench.later(lambda: self._bench.pick(click))
            self._wake()

    def _change_by_control(self, wished: Any) -> None:
        with self._lock:
            before = self._session.state
            after = wished(before)
            # What comes from a browser may be anything, and of controls that are gone.
            if after.show not in ways_of_showing(self._painter.exhibit.names):
                after = replace(after, show=before.show)
            self._session = self._session.change(after, time.monotonic())
            self._panel.follow(after)
        if after.orbit != before.orbit:
            self._set_camera(after.orbit)
        self._wake()

    def _set_camera(self, orbit: Orbit) -> None:
        """Tell the browser where its camera is."""
        with self._lock:
            self._deaf_until = time.monotonic() + DEAF
            self._sent.append(orbit)
        with self.client.atomic():
            self.client.camera.position = orbit.position
            self.client.camera.look_at = orbit.target

    async def _change_by_camera(self, camera: Any) -> None:
        with self._lock:
            now, state, pose = time.monotonic(), self._session.state, (camera.position, camera.look_at)
            after = replace(state, canvas=_canvas(camera))
            if now >= self._deaf_until and not any(orbit.is_at(*pose) for orbit in (state.orbit, *self._sent)):
                after = replace(after, orbit=state.orbit.moved(*pose))
                self._sent.clear()
            self._session = self._session.change(after, now)
            if after.orbit != state.orbit:
                self._panel.follow(after)
        self._wake()


def _canvas(camera: Any) -> tuple[int, int]:
    """Width and height in pixels of a visitor's place for pictures, as far as they can be believed."""
    width, height = (min(max(int(side), 16), LONGEST_SIDE) for side in (camera.image_width, camera.image_height))
    return width, height
