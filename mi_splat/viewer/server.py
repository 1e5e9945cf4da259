"""Serves the page: its pictures follow the camera of each browser window."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import socket
import threading
import warnings
from typing import Any

from mi_splat.errors import InvalidValueError, MiSplatError, install, message
from mi_splat.viewer.client import Client
from mi_splat.viewer.guard import LOOPBACK_NAMES, Guard, guarding, is_loopback
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.runner import JobRunner


def check_port(host: str, port: int) -> None:
    """Raise unless pages can be served there."""
    if importlib.util.find_spec("viser") is None:
        raise InvalidValueError(message("viser", "the package, for pages", "not installed", install("view")))
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise InvalidValueError(message(f"{host}, port {port}", "a free port", reason, "try --port 0")) from error


class Page:
    """Serves the content of a painter, or of a runner with jobs, until it is closed.

    Pictures are rendered in the thread that calls `run`. Port 0 is any free one.
    """

    def __init__(self, shown: Painter | JobRunner, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        self._runner = shown if isinstance(shown, JobRunner) else JobRunner(shown)
        self._changed, self._clients = threading.Condition(), dict[int, Client]()
        self._guard = Guard(names=LOOPBACK_NAMES | {host} if is_loopback(host) else None)
        self._host, self._server = host, _serve(self._guard, host, port, self._runner.label)
        self._closed = False
        content = self._runner.content
        self._server.scene.set_up_direction("+z")
        first = self._server.initial_camera
        first.position, first.look_at, first.up = content.start.position, content.start.target, (0.0, 0.0, 1.0)
        first.fov = content.start.vertical_fov(content.size)
        self._server.on_client_connect(self._enter)
        self._server.on_client_disconnect(self._leave)
        if port not in (0, self._server.get_port()):
            self.close()
            raise InvalidValueError(message(f"{host}, port {port}", "a free port", "one in use", "try --port 0"))

    @property
    def address(self) -> str:
        """The address to open in a browser of this machine; whoever knows it may see the page."""
        here = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self._host, self._host)
        host = f"[{here}]" if ":" in here else here
        return f"http://{host}:{self._server.get_port()}/?token={self._guard.token}"

    def run(self, stop: threading.Event | None = None) -> None:
        """Make pictures until `stop` is set, or until Ctrl-C."""
        while stop is None or not stop.is_set():
            self.turn(stop)

    def turn(self, stop: threading.Event | None = None, *, wait: float = 0.05) -> None:
        """Do what is queued, and make one picture for each window where one is due."""
        changed = self._runner.turn()
        with self._changed:
            clients = list(self._clients.values())
            due = [(client, step) for client in clients if (step := client.due()) is not None]
            if not (due or changed):
                self._changed.wait(wait)
        for client in clients if changed else ():
            client.follow()
        for client, step in due:
            if stop is None or not stop.is_set():
                client.paint(step)

    def close(self) -> None:
        """Close every window's connection and free the port."""
        if not self._closed:
            self._closed = True
            self._runner.close()
            with contextlib.redirect_stdout(io.StringIO()):  # viser says that it stopped
                self._server.stop()

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *failure: object) -> None:
        self.close()

    async def _enter(self, handle: Any) -> None:
        _accept_values_only(handle)
        client = Client(handle, self._runner, self._wake)
        with self._changed:
            self._clients[handle.client_id] = client
        self._runner.later(lambda: None)  # so that it follows what has changed while its controls were made
        self._wake()

    async def _leave(self, handle: Any) -> None:
        with self._changed:
            self._clients.pop(handle.client_id, None)

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify()


def _serve(guard: Guard, host: str, port: int, label: str) -> Any:
    """A viser server that connects to nobody and answers only requests that the guard lets pass."""
    import viser
    from viser import _messages
    from viser.infra import _infra

    # A window may be closed while its picture is made.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)
    # On stdout viser says its address, without the token that is needed.
    with guarding(guard, _infra.websockets.asyncio.server), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    try:
        # Any browser could request it, and it opens the page to the internet.
        server._websock_server.unregister_handler(_messages.ShareUrlRequest)
    except (AssertionError, AttributeError) as error:
        server.stop()
        raise MiSplatError("viser: expected a way to turn sharing off, got none; install another version") from error
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    return server


def _accept_values_only(handle: Any) -> None:
    """Let a browser set the values of controls, and nothing else.

    viser would let it change every property of a control, or remove it, and upload files of any size.
    """
    from viser import _messages

    gui, messages = handle.gui, handle.gui._websock_interface
    for kind in (_messages.GuiUpdateMessage, _messages.FileTransferStartUpload, _messages.FileTransferPart):
        messages.unregister_handler(kind)

    async def update(number: int, message: Any) -> None:
        if set(message.updates) == {"value"}:
            await gui._handle_gui_updates(number, message)

    messages.register_handler(_messages.GuiUpdateMessage, update)
