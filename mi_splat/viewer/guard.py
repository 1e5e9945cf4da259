"""Who may see the page: whoever knows its token, from a page of its own, under a name that was expected.

A server on this machine alone is still within reach of other users of it and of any web page that is open in a browser
on it. So every request needs a secret: first the token in the address, then a cookie. A request that another page makes
is refused by its Origin, and one that came by a foreign name (DNS rebinding) by its Host.

A browser sends a cookie to every port of a host, whoever listens there. Only its path can limit that: the page moves to
a path that cannot be guessed, and its cookie goes nowhere else. Who listens on another port gets it only if the browser
asks that port for this very path.
"""

import asyncio
import hmac
import html
import ipaddress
import logging
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, parse_qsl, urlencode, urlsplit

from mi_splat.errors import InvalidValueError, MiSplatError, message
from mi_splat.viewer.policy import NAMING, script_hash, viser_policy

_LOG = logging.getLogger(__name__)
LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
COOKIE = "mi-splat-view"
MOST_WINDOWS = 8
"""Browser windows that are served at the same time."""
LARGEST_MESSAGE = 2**20
"""Bytes of the largest message that a browser may send."""


def is_loopback(host: str) -> bool:
    """Whether a name stands for this machine alone."""
    if host in LOOPBACK_NAMES:
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def checked_host(host: str, *, allow_remote: bool) -> str:
    """The host, if the page may be served on it."""
    if not is_loopback(host) and not allow_remote:
        do = (
            "leave it out and open an SSH tunnel (ssh -L 8080:127.0.0.1:8080 HOST), or add --allow-remote, which sends "
            "everything over the network without encryption"
        )
        raise InvalidValueError(message("host", "127.0.0.1 or another name of this machine alone", host, do))
    return host


@dataclass(frozen=True, slots=True, kw_only=True)
class Guard:
    """What a request has to know.

    Attributes:
        names: Names under which the page may be asked for; None is any.
        scripts: Hashes of the scripts that may run in the page, beside the one that is added to it.
        token: What the address has to hold.
        secret_path: Path of the page, without its first slash.
        cookie: What the cookie has to hold.
    """

    names: frozenset[str] | None = LOOPBACK_NAMES
    scripts: tuple[str, ...] = ()
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    secret_path: str = field(default_factory=lambda: secrets.token_urlsafe(12))
    cookie: str = field(default_factory=lambda: secrets.token_urlsafe(24))

    def objection(self, path: str, headers: Mapping[str, str]) -> str | None:
        """Why a request is refused; None if it is not."""
        host = headers.get("Host", "")
        name, port = _name_and_port(host)
        if name is None or (self.names is not None and name not in self.names):
            return "this page is not served under that name"
        origin = headers.get("Origin")
        if origin is not None and origin != f"http://{host}":
            return "another page may not use this one"
        try:
            tokens = parse_qs(urlsplit(path).query).get("token", ())
        except ValueError:
            return "this is no address"
        cookies = _cookies(headers.get("Cookie", ""), f"{COOKIE}-{port}")
        if not (_any_is(tokens, self.token) or _any_is(cookies, self.cookie)):
            return "open the address that mi-splat has printed, with its token"
        return None

    def door(self, path: str) -> str | None:
        """For an address with the token, a page that leads on to the one without it; None for others.

        A redirect would fail behind a link of another site: the browser counts what it asks for then as asked by that
        site, and leaves the cookie out.
        """
        rest = parse_qsl(urlsplit(path).query, keep_blank_values=True)
        kept = [(key, value) for key, value in rest if key != "token"]
        if len(kept) == len(rest):
            return None
        target = html.escape(f"/{self.secret_path}/" + (f"?{urlencode(kept)}" if kept else ""))
        return (
            '<!doctype html><html lang="en"><meta charset="utf-8"><title>mi-splat</title>'
            f'<meta http-equiv="refresh" content="0; url={target}"><a href="{target}">Open the page</a></html>\n'
        )

    def inside(self, path: str) -> str:
        """The path as viser knows it, whose page is at "/"."""
        return path.removeprefix(f"/{self.secret_path}") or "/"

    def headers(self, host: str) -> dict[str, str]:
        """Headers of every answer: the cookie, and that the page shall ask nothing of anybody else."""
        # Paths keep the pages of one browser apart; the port tells who looks at the cookies which page each is of.
        name = f"{COOKIE}-{_name_and_port(host)[1]}"
        return {
            "Set-Cookie": f"{name}={self.cookie}; HttpOnly; SameSite=Strict; Path=/{self.secret_path}",
            "Content-Security-Policy": viser_policy((*self.scripts, script_hash(NAMING)), host),
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
        }


def _name_and_port(host: str) -> tuple[str | None, int]:
    """What a Host header says; no name if it is none."""
    try:
        parts = urlsplit(f"//{host}")
        return parts.hostname, parts.port or 80
    except ValueError:
        return None, 0


def _cookies(header: str, name: str) -> list[str]:
    """Every value that a Cookie header has for a name: whoever listens on another port may have added one."""
    pairs = (pair.strip().partition("=") for pair in header.split(";"))
    return [value for key, _, value in pairs if key == name]


def _any_is(given: Iterable[str], secret: str) -> bool:
    """Whether a secret is among what was given, without telling by the time how much of it is right."""
    return any(hmac.compare_digest(value.encode("utf-8", "replace"), secret.encode()) for value in given)


@contextmanager
def guarding(guard: Guard, websockets_server: Any) -> Iterator[None]:
    """Servers that `websockets` begins to serve in this block answer only requests that the guard lets pass.

    viser has no hook for it, so its call of `serve` is led through here.
    """
    plain, guarded = websockets_server.serve, []

    def serve(handler: Any, *arguments: Any, **options: Any) -> Any:
        answer: Callable[[Any, Any], Any] | None = options.get("process_request")
        if answer is None:
            raise MiSplatError("viser: expected a server of pages, got another; install the version that is asked for")

        def process_request(connection: Any, request: Any) -> Any:
            objection = guard.objection(request.path, request.headers)
            if objection is not None:
                return connection.respond(HTTPStatus.FORBIDDEN, f"{objection}\n")
            door = guard.door(request.path)
            request.path = guard.inside(request.path)
            request.headers.pop("Accept-Encoding", None)  # what is packed has no place for the script
            response = answer(connection, request)
            if response is None:  # a websocket
                return None
            if response.headers.get("Content-Type", "").startswith("text/html"):
                response.body += f"<script>{NAMING}</script>".encode()
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
            if door is not None:
                response = connection.respond(HTTPStatus.OK, door)
                del response.headers["Content-Type"]  # of plain text
                response.headers["Content-Type"] = "text/html; charset=utf-8"
            for name, value in guard.headers(request.headers["Host"]).items():
                response.headers[name] = value
            return response

        guarded.append(True)
        quiet = logging.getLogger(f"{__name__}.connections")
        quiet.setLevel(logging.CRITICAL)  # it would print what others send
        options |= {"process_request": process_request, "max_size": LARGEST_MESSAGE, "logger": quiet}
        return plain(_bounded(handler), *arguments, **options)

    websockets_server.serve = serve
    try:
        yield
    finally:
        websockets_server.serve = plain
    if not guarded:
        raise MiSplatError("viser: expected a server to guard, got none; install the version that is asked for")


def _bounded(handler: Any) -> Any:
    """A handler of websockets for a few windows, which reports each kind of invalid message once, in one line."""
    windows, told = set[Any](), set[str]()

    def tell(error: BaseException | None) -> None:
        kind = type(error).__name__
        if kind not in told:
            told.add(kind)
            _LOG.warning("The page ignored a message of a browser (%s).", kind)
            _LOG.debug("", exc_info=error)

    async def handle(connection: Any) -> None:
        import viser

        if connection.subprotocol != f"viser-v{viser.__version__}":  # viser would print the other's
            await connection.close(1002, f"expected viser {viser.__version__}")
            return
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: tell(context.get("exception")))
        if len(windows) >= MOST_WINDOWS:
            await connection.close(1013, f"{MOST_WINDOWS} windows are open already")
            return
        windows.add(connection)
        try:
            await handler(connection)
        finally:
            windows.discard(connection)

    return handle
