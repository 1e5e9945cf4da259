"""The page: a server on this machine whose pictures follow each visitor's camera."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import socket
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mi_splat.errors import InvalidValueError, MiSplatError, install, message
from mi_splat.viewer.bench import Bench
from mi_splat.viewer.guard import LOOPBACK_NAMES, Guard, guarding, is_loopback
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.policy import viser_scripts
from mi_splat.viewer.visitor import Visitor


def need_viser() -> None:
    """Raise if pages cannot be served."""
    if importlib.util.find_spec("viser") is None:
        do = f"{install('view')}, or write a page with --export"
        raise InvalidValueError(message("viser", "the package, for pages", "not installed", do))


def check_port(host: str, port: int) -> None:
    """Raise unless the page can be served there."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise InvalidValueError(message(f"{host}, port {port}", "a free port", reason, "try --port 0")) from error


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
        """Do what is to be done, and make one picture for each visitor who is to have one."""
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
        _hear_values_only(client)
        visitor = Visitor(client, self._bench, self._wake)
        with self._news:
            self._visitors[client.client_id] = visitor
        self._bench.later(lambda: None)  # so that it follows what has changed while its controls were made
        self._wake()

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


def _hear_values_only(client: Any) -> None:
    """Let a browser say what a control is set to, and no more.

    viser would let it change whatever is kept of a control, its being there included, and send files without an end.
    """
    from viser import _messages

    gui, heard = client.gui, client.gui._websock_interface
    for kind in (_messages.GuiUpdateMessage, _messages.FileTransferStartUpload, _messages.FileTransferPart):
        heard.unregister_handler(kind)

    async def update(number: int, message: Any) -> None:
        if set(message.updates) == {"value"}:
            await gui._handle_gui_updates(number, message)

    heard.register_handler(_messages.GuiUpdateMessage, update)


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
