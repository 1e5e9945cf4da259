"""Serves the page: its images follow the camera of each browser window."""

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
from functools import partial
from typing import Any

from mi_splat.cameras.lens import angle_of
from mi_splat.errors import InvalidValueError, MiSplatError, install, message
from mi_splat.render.tile.frozen import PictureInterruptedError, interrupted_by
from mi_splat.viewer.boxes import dragged
from mi_splat.viewer.guard import Guard, guarding
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import Painter, Painting
from mi_splat.viewer.panel import Remark, ViewPanel
from mi_splat.viewer.picking import Click, clicked
from mi_splat.viewer.selecting import SelectionPanel, SharedSelection
from mi_splat.viewer.session import Session, Step, ViewState, display_modes

JPEG_QUALITY = {Step.COARSE: 75, Step.HALF: 85, Step.FULL: 92, Step.INSPECTED: 92}
SETTLING = 1.0
"""Seconds after a control was moved in which reports of the browser's camera, which
follows late, are ignored.
"""
# poses that a browser was sent and may report later, as if the mouse had moved its
# camera there
ECHOES = 128
HOST = "127.0.0.1"
LONGEST_SIDE = 8192  # pixels of the largest window that is believed


class Client:
    """One browser window."""

    def __init__(
        self, handle: Any, shared: SharedSelection, wake: Callable[[], None]
    ) -> None:
        self._handle = handle
        self._shared = shared
        self._painter = shared.painter
        self._wake = wake
        self._lock = threading.Lock()
        self._settled = 0.0
        self._sent: deque[Orbit] = deque(maxlen=ECHOES)
        content = self._painter.content
        canvas = _canvas(handle.camera)
        mode = display_modes(content.names)[0]
        first = ViewState(
            orbit=content.start, mode=mode, canvas=canvas, revision=shared.revision
        )
        self._session = Session(state=first, changed=time.monotonic())
        tabs = handle.gui.add_tab_group()
        inspector = self._painter.inspector is not None
        with tabs.add_tab("View"):
            self._panel = ViewPanel(
                handle.gui, content, first, inspector=inspector, change=self._change
            )
        with tabs.add_tab("Tools"):
            download = partial(handle.send_file_download, save_immediately=True)
            self._selection_panel = SelectionPanel(
                handle.gui,
                shared,
                orbit=lambda: self._session.state.orbit,
                download=download,
                wake=wake,
            )
        # The pose before the browser has read where to begin is not a move of its user.
        self._sent.append(
            first.orbit.moved(handle.camera.position, handle.camera.look_at)
        )
        self._send_camera(first.orbit)
        handle.camera.on_update(self._camera_moved)
        handle.scene.on_click()(self._clicked)
        handle.scene.on_click(modifier="shift")(self._clicked)
        handle.scene.on_rect_select(modifier="cmd/ctrl")(self._dragged)

    def follow(self) -> None:
        """Show what the windows share as it is now."""
        self._change(lambda state: replace(state, revision=self._shared.revision))
        self._selection_panel.follow()

    def due(self) -> Step | None:
        """The image to make now."""
        return self._session.due(
            time.monotonic(), inspector=self._painter.inspector is not None
        )

    def paint(self, step: Step, urgent: Callable[[], bool]) -> None:
        """Make an image and send it, unless something is urgent meanwhile."""
        with self._lock:
            state = self._session.state
            pace = self._session.pace
        started = time.perf_counter()
        try:
            with interrupted_by(urgent):
                painting = self._painter.paint(state, step, pace)
                quality = JPEG_QUALITY[step]
                self._handle.scene.set_background_image(
                    painting.pixels, format="jpeg", jpeg_quality=quality
                )
                if step in (Step.FULL, Step.INSPECTED):
                    self._panel.describe(
                        self._remarks(state, painting),
                        self._painter.commands(state.orbit),
                    )
        except PictureInterruptedError:
            return
        except MiSplatError as error:  # of this image; the next one may succeed
            self._panel.describe([("", str(error))], {})
        self._handle.flush()
        with self._lock:
            self._session = self._session.done(
                step, state, time.perf_counter() - started
            )

    def _remarks(self, state: ViewState, painting: Painting) -> Iterator[Remark]:
        """What is known of an image."""
        content = self._painter.content
        for line in (
            *content.describe(state.orbit.camera(content.size)),
            self._painter.comparison(state.orbit),
        ):
            if line:
                yield "", line
        for name, inspection in painting.inspections.items():
            yield name, inspection.text

    async def _clicked(self, event: Any) -> None:
        """Select what a point of the page shows."""
        state = self._session.state
        hit = clicked(
            event.screen_pos,
            self._painter.layout(state),
            state.mode,
            self._painter.content,
            state.orbit,
        )
        if hit is not None:
            click = Click(
                splat=hit[0],
                pixel=hit[1],
                orbit=state.orbit,
                adds=event.modifier is not None,
            )
            self._shared.later(lambda: self._shared.pick(click))
            self._wake()

    async def _dragged(self, event: Any) -> None:
        """Add a box around an object, from the present camera."""
        state = self._session.state
        drag = dragged(
            (event.screen_min, event.screen_max),
            self._painter.layout(state),
            state.mode,
            self._painter.content,
            state.orbit,
        )
        if drag is not None:
            self._shared.later(lambda: self._shared.drag(drag))
            self._wake()

    def _change(self, changed: Callable[[ViewState], ViewState]) -> None:
        """Change the state by a control."""
        with self._lock:
            before = self._session.state
            after = changed(before)
            # A browser may send anything.
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
            now = time.monotonic()
            state = self._session.state
            pose = (camera.position, camera.look_at)
            after = replace(state, canvas=_canvas(camera))
            if now >= self._settled and not any(
                orbit.is_at(*pose) for orbit in (state.orbit, *self._sent)
            ):
                after = replace(after, orbit=state.orbit.moved(*pose))
                self._sent.clear()
            self._session = self._session.change(after, now)
            if after.orbit != state.orbit:
                self._panel.follow(after)
        self._wake()


def _canvas(camera: Any) -> tuple[int, int]:
    """Width and height in pixels of a window, as far as they can be believed."""
    width, height = (
        min(max(int(side), 16), LONGEST_SIDE)
        for side in (camera.image_width, camera.image_height)
    )
    return width, height


def check_port(port: int) -> None:
    """Raise unless pages can be served there, to this machine alone."""
    if importlib.util.find_spec("viser") is None:
        raise InvalidValueError(
            message("viser", "the package, for pages", "not installed", install("view"))
        )
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise InvalidValueError(
                message(f"port {port}", "a free port", reason, "try --port 0")
            ) from error


class Page(contextlib.AbstractContextManager["Page"]):
    """Serves the content of a painter until it is closed."""

    def __init__(self, painter: Painter, *, port: int = 8080) -> None:
        check_port(port)  # viser would take another one
        self._shared = SharedSelection(painter)
        self._changed, self._clients = threading.Condition(), dict[int, Client]()
        self._guard = Guard()
        self._closed = False
        self._server = _serve(self._guard, port)
        content = painter.content
        self._server.scene.set_up_direction("+z")
        first = self._server.initial_camera
        first.position = content.start.position
        first.look_at = content.start.target
        first.up = (0.0, 0.0, 1.0)
        camera = content.start.camera(content.size)
        first.fov = angle_of(camera.fy, camera.height)
        self._server.on_client_connect(self._enter)
        self._server.on_client_disconnect(self._leave)

    @property
    def address(self) -> str:
        """The address to open in a browser of this machine; whoever knows it may see
        the page.
        """
        return f"http://{HOST}:{self._server.get_port()}/?token={self._guard.token}"

    def run(self, stop: threading.Event | None = None) -> None:
        """Make images until `stop` is set, or until Ctrl-C."""
        while stop is None or not stop.is_set():
            self._turn(stop)

    def _turn(self, stop: threading.Event | None) -> None:
        """Do what is queued, and make one image for each window where one is due,
        coarse ones first.
        """
        changed = self._shared.turn()
        with self._changed:
            clients = list(self._clients.values())
            due = [
                (client, step)
                for client in clients
                if (step := client.due()) is not None
            ]
            if not (due or changed):
                self._changed.wait(0.05)
        for client in clients if changed else ():
            client.follow()
        coarse = [(client, step) for client, step in due if step is Step.COARSE]
        for client, step in coarse or due:
            if stop is None or not stop.is_set():
                client.paint(step, (lambda: False) if coarse else self._is_urgent)

    def _is_urgent(self) -> bool:
        """Whether a window waits for a reaction."""
        with self._changed:
            clients = list(self._clients.values())
        return bool(self._shared.requests) or any(
            client.due() is Step.COARSE for client in clients
        )

    def close(self) -> None:
        """Close every window's connection and free the port."""
        if not self._closed:
            self._closed = True
            # viser says that it stopped
            with contextlib.redirect_stdout(io.StringIO()):
                self._server.stop()

    def __exit__(self, *failure: object) -> None:
        self.close()

    async def _enter(self, handle: Any) -> None:
        _accept_values_only(handle)
        client = Client(handle, self._shared, self._wake)
        with self._changed:
            self._clients[handle.client_id] = client
        # so that it follows what has changed while its controls were made
        self._shared.later(lambda: None)
        self._wake()

    async def _leave(self, handle: Any) -> None:
        with self._changed:
            self._clients.pop(handle.client_id, None)

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify()


def _serve(guard: Guard, port: int) -> Any:
    """A viser server that connects to nobody and answers only requests that the guard
    lets pass.
    """
    import viser
    from viser import _messages
    from viser.infra import _infra

    # A window may be closed while its image is made.
    warnings.filterwarnings(
        "ignore", message="Queued a .* on a closed connection", category=UserWarning
    )
    # On stdout viser says its address, without the token that is needed.
    with (
        guarding(guard, _infra.websockets.asyncio.server),
        contextlib.redirect_stdout(io.StringIO()),
    ):
        server = viser.ViserServer(
            host=HOST, port=port, label="mi-splat view", verbose=False
        )
    try:
        # Any browser could request it, and it opens the page to the internet.
        server._websock_server.unregister_handler(_messages.ShareUrlRequest)
    except (AssertionError, AttributeError) as error:
        server.stop()
        raise MiSplatError(
            "viser: expected a way to turn sharing off, got none; install another"
            " version"
        ) from error
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    return server


def _accept_values_only(handle: Any) -> None:
    """Let a browser set the values of controls; viser lets it change or remove all of
    them, and upload any file.
    """
    from viser import _messages

    gui, messages = handle.gui, handle.gui._websock_interface
    for kind in (
        _messages.GuiUpdateMessage,
        _messages.FileTransferStartUpload,
        _messages.FileTransferPart,
    ):
        messages.unregister_handler(kind)

    async def update(number: int, message: Any) -> None:
        if set(message.updates) == {"value"}:
            await gui._handle_gui_updates(number, message)

    messages.register_handler(_messages.GuiUpdateMessage, update)
