"""The page: a server on this machine whose pictures follow each visitor's camera."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import socket
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from mi_splat.errors import InvalidValueError, MiSplatError, install, message
from mi_splat.viewer.bench import Bench
from mi_splat.viewer.composition import ways_of_showing
from mi_splat.viewer.guard import LOOPBACK_NAMES, Guard, guarding, is_loopback
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import Painter, Painting
from mi_splat.viewer.panel import Panel, Remark
from mi_splat.viewer.picking import Click, clicked
from mi_splat.viewer.policy import viser_scripts
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


def need_viser() -> None:
    """Raise if pages cannot be served.

    Raises:
        InvalidValueError: viser is not installed.
    """
    if importlib.util.find_spec("viser") is None:
        do = f"{install('view')}, or write a page with --export"
        raise InvalidValueError(message("viser", "the package, for pages", "not installed", do))


def check_port(host: str, port: int) -> None:
    """Raise unless the page can be served there.

    Raises:
        InvalidValueError: The port is taken or out of range, or the host is not of this machine.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise InvalidValueError(message(f"{host}, port {port}", "a free port", reason, "try --port 0")) from error


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
        self._place_camera(first.orbit)
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
            with self._lock:
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
            self._session = self._session.change(after, time.monotonic())
            moved = after.orbit != before.orbit
        if moved:
            self._place_camera(after.orbit)
        self._panel.follow(after)
        self._wake()

    def _place_camera(self, orbit: Orbit) -> None:
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


class Page:
    """Serves an exhibit until it is closed; pictures are made in the thread that calls `run`.

    Args:
        painter: Makes the pictures, or a bench with it.
        host: Name or address to serve on.
        port: Port; 0 is any free one.

    Raises:
        InvalidValueError: viser is not installed, or the port is taken.
    """

    def __init__(self, painter: Painter | Bench, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        need_viser()
        check_port(host, port)
        self._bench = painter if isinstance(painter, Bench) else Bench(painter)
        self._news, self._visitors = threading.Condition(), dict[int, Visitor]()
        self._guard = Guard(names=LOOPBACK_NAMES | {host} if is_loopback(host) else None, scripts=_scripts())
        self._host, self._server = host, _serve(self._guard, host, port, self._bench.label)
        self._closed = False
        exhibit = self._bench.exhibit
        start = exhibit.start
        self._server.scene.set_up_direction("+z")
        first = self._server.initial_camera
        first.position, first.look_at, first.up = start.position, start.target, (0.0, 0.0, 1.0)
        first.fov = start.vertical_fov(exhibit.size)
        self._server.on_client_connect(self._enter)
        self._server.on_client_disconnect(self._leave)
        if port not in (0, self._server.get_port()):
            self.close()
            raise InvalidValueError(message(f"{host}, port {port}", "a free port", "one in use", "try --port 0"))

    @property
    def address(self) -> str:
        """What to open in a browser of this machine; whoever knows it may see the page."""
        here = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self._host, self._host)
        host = f"[{here}]" if ":" in here else here
        return f"http://{host}:{self._server.get_port()}/?token={self._guard.token}"

    def run(self, stop: threading.Event) -> None:
        """Make pictures until `stop` is set."""
        while not stop.is_set():
            self.turn(stop)

    def turn(self, stop: threading.Event | None = None, *, wait: float = 0.05) -> None:
        """Do what is to be done, and make one picture for each visitor who is to have one.

        Args:
            stop: Where it is set, no picture is begun any more.
            wait: Seconds to wait for something to do where there is nothing.
        """
        changed = self._bench.turn()
        with self._news:
            visitors = list(self._visitors.values())
            due = [(visitor, step) for visitor in visitors if (step := visitor.due()) is not None]
            if not (due or changed):
                self._news.wait(wait)
        for visitor in visitors if changed else ():
            visitor.follow()
        for visitor, step in due:
            if stop is None or not stop.is_set():
                visitor.paint(step)

    def close(self) -> None:
        """Close every window's connection and free the port."""
        if not self._closed:
            self._closed = True
            self._bench.close()
            with contextlib.redirect_stdout(io.StringIO()):  # viser says that it stopped
                self._server.stop()

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *failure: object) -> None:
        self.close()

    async def _enter(self, client: Any) -> None:
        visitor = Visitor(client, self._bench, self._wake)
        with self._news:
            self._visitors[client.client_id] = visitor
            self._news.notify()

    async def _leave(self, client: Any) -> None:
        with self._news:
            self._visitors.pop(client.client_id, None)

    def _wake(self) -> None:
        with self._news:
            self._news.notify()


def _scripts() -> tuple[str, ...]:
    """Hashes of the scripts of viser's page."""
    import viser

    return viser_scripts((Path(viser.__file__).parent / "client" / "build" / "index.html").read_text("utf-8"))


def _serve(guard: Guard, host: str, port: int, label: str) -> Any:
    """A viser server that asks nothing of the network and answers only whom the guard lets pass."""
    import viser
    from viser import _messages
    from viser.infra import _infra

    # A window that is closed while its picture is made is no news.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)
    # On stdout viser says its address, without the token that is needed.
    with guarding(guard, _infra.websockets.asyncio.server), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    try:
        # Any visitor could ask for it, and it would lead the whole world here.
        server._websock_server.unregister_handler(_messages.ShareUrlRequest)
    except (AssertionError, AttributeError) as error:
        server.stop()
        raise MiSplatError("viser: expected a way to turn sharing off, got none; install another version") from error
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    return server


@contextlib.contextmanager
def stopping(stop: threading.Event) -> Iterator[None]:
    """Ctrl-C and SIGTERM set `stop` while the block runs; in the main thread only."""
    import signal

    def handle(number: int, frame: Any) -> None:
        stop.set()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _canvas(camera: Any) -> tuple[int, int]:
    """Width and height in pixels of a visitor's place for pictures, as far as they can be believed."""
    width, height = (min(max(int(side), 16), LONGEST_SIDE) for side in (camera.image_width, camera.image_height))
    return width, height
