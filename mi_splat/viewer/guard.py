"""Access to the page: a token and then a cookie, the Origin and the Host of requests,
and the scripts that may run.

A server on this machine is still within reach of its other users and of any web page in
a browser on it. Therefore every request needs a secret, one from another page is
refused by its Origin, and one under a foreign name (DNS rebinding) by its Host.

A browser sends a cookie to every port of a host. Only its path can limit that: the page
moves to a path that cannot be guessed, and its cookie goes nowhere else.
"""

import asyncio
import hmac
import html
import logging
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, parse_qsl, urlencode, urlsplit

from mi_splat.errors import MiSplatError

_LOG = logging.getLogger(__name__)
LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
COOKIE = "mi-splat-view"
MOST_WINDOWS = 8  # browser windows that are served at the same time
LARGEST_MESSAGE = 2**20  # bytes of the largest message that a browser may send
NAMING = """
new MutationObserver(() => {
  for (const label of document.querySelectorAll("label[for]"))
    for (const control of label.closest(".mantine-Flex-root")
      ?.querySelectorAll("[role=slider], input, textarea") ?? [])
      if (!control.labels?.length && control.ariaLabel !== label.textContent)
      control.ariaLabel = label.textContent;
}).observe(document, {childList: true, subtree: true});
"""
"""Script that gives controls of viser without a name the text of the label next to
them, for screen readers.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Guard:
    """The token of a page's address, its path and its cookie."""

    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    secret_path: str = field(default_factory=lambda: secrets.token_urlsafe(12))
    cookie: str = field(default_factory=lambda: secrets.token_urlsafe(24))

    def objection(self, path: str, headers: Mapping[str, str]) -> str | None:
        """Why a request is refused; None if it is not."""
        host = headers.get("Host", "")
        name, port = _name_and_port(host)
        if name not in LOOPBACK_NAMES:
            return "this page is not served under that name"
        origin = headers.get("Origin")
        if origin is not None and origin != f"http://{host}":
            return "another page may not use this one"
        try:
            tokens = parse_qs(urlsplit(path).query).get("token", ())
        except ValueError:
            return "this is no address"
        # A server on another port may have added a cookie of this name, so all of them
        # count.
        pairs = (
            pair.strip().partition("=") for pair in headers.get("Cookie", "").split(";")
        )
        cookies = [value for key, _, value in pairs if key == f"{COOKIE}-{port}"]
        if not (_any_is(tokens, self.token) or _any_is(cookies, self.cookie)):
            return "open the address that mi-splat has printed, with its token"
        return None

    def door(self, path: str) -> str | None:
        """For an address with the token, a page that leads to the one without it; None
        for others.

        A redirect would fail behind a link of another site, because the browser then
        leaves the cookie out.
        """
        rest = parse_qsl(urlsplit(path).query, keep_blank_values=True)
        kept = [(key, value) for key, value in rest if key != "token"]
        if len(kept) == len(rest):
            return None
        target = html.escape(
            f"/{self.secret_path}/" + (f"?{urlencode(kept)}" if kept else "")
        )
        return (
            '<!doctype html><html lang="en"><meta'
            ' charset="utf-8"><title>mi-splat</title><meta http-equiv="refresh"'
            f' content="0; url={target}"><a href="{target}">Open the page</a></html>\n'
        )

    def headers(self, host: str, nonce: str) -> dict[str, str]:
        """Headers of every answer: the cookie, and what the page may do."""
        # Paths keep the pages of one browser apart; the port in the name helps whoever
        # looks at the cookies.
        name = f"{COOKIE}-{_name_and_port(host)[1]}"
        return {
            "Set-Cookie": (
                f"{name}={self.cookie}; HttpOnly; SameSite=Strict;"
                f" Path=/{self.secret_path}"
            ),
            "Content-Security-Policy": content_security_policy(host, nonce),
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
        }


def content_security_policy(host: str, nonce: str) -> str:
    """Only scripts with the nonce, and those that they add, run; and the page connects
    to nobody else.
    """
    return "; ".join(
        (
            "default-src 'none'",
            # No 'unsafe-eval': only viser's renderer of splats needs it, which this
            # page does not use. The page unpacks itself and every message with
            # WebAssembly.
            f"script-src 'nonce-{nonce}' 'strict-dynamic' 'wasm-unsafe-eval'",
            # the connection to the server, whose code is in the page
            "worker-src blob:",
            # the controls write their colours and places into the page
            "style-src 'unsafe-inline'",
            "img-src data: blob:",
            "font-src data:",
            f"connect-src 'self' ws://{host} data:",  # data: is WebAssembly in the page
            "frame-src 'none'",
            "object-src 'none'",
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'none'",
        )
    )


def _name_and_port(host: str) -> tuple[str | None, int]:
    """The parts of a Host header; no name if it is invalid."""
    try:
        parts = urlsplit(f"//{host}")
        return parts.hostname, parts.port or 80
    except ValueError:
        return None, 0


def _any_is(given: Iterable[str], secret: str) -> bool:
    """Whether a secret is among what was given, in a time that does not depend on how
    much of it is right.
    """
    return any(
        hmac.compare_digest(value.encode("utf-8", "replace"), secret.encode())
        for value in given
    )


@contextmanager
def guarding(guard: Guard, websockets_server: Any) -> Iterator[None]:
    """Servers that `websockets` starts in this block answer only requests that the
    guard lets pass.
    """
    plain = websockets_server.serve
    guarded = []

    def serve(handler: Any, *arguments: Any, **options: Any) -> Any:
        answer: Callable[[Any, Any], Any] | None = options.get("process_request")
        if answer is None:
            raise MiSplatError(
                "viser: expected a server of pages, got another; install the extra"
                " `view` again"
            )

        def process_request(connection: Any, request: Any) -> Any:
            objection = guard.objection(request.path, request.headers)
            if objection is not None:
                return connection.respond(HTTPStatus.FORBIDDEN, f"{objection}\n")
            door = guard.door(request.path)
            nonce = secrets.token_urlsafe(16)
            # as viser knows it
            request.path = request.path.removeprefix(f"/{guard.secret_path}") or "/"
            request.headers.pop("Accept-Encoding", None)  # scripts are added below
            response = answer(connection, request)
            if response is None:  # a websocket
                return None
            if response.headers.get("Content-Type", "").startswith("text/html"):
                script = f'<script nonce="{nonce}"'.encode()
                response.body = (
                    response.body + f"<script>{NAMING}</script>".encode()
                ).replace(b"<script", script)
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
            if door is not None:
                response = connection.respond(HTTPStatus.OK, door)
                del response.headers["Content-Type"]  # of plain text
                response.headers["Content-Type"] = "text/html; charset=utf-8"
            for name, value in guard.headers(request.headers["Host"], nonce).items():
                response.headers[name] = value
            return response

        guarded.append(True)
        quiet = logging.getLogger(f"{__name__}.connections")
        quiet.setLevel(logging.CRITICAL)  # it would print what others send
        options |= {
            "process_request": process_request,
            "max_size": LARGEST_MESSAGE,
            "logger": quiet,
        }
        return plain(_bounded(handler), *arguments, **options)

    websockets_server.serve = serve
    try:
        yield
    finally:
        websockets_server.serve = plain
    if not guarded:
        raise MiSplatError(
            "viser: expected a server to guard, got none; install the extra `view`"
            " again"
        )


def _bounded(handler: Any) -> Any:
    """A handler of websockets for a few windows, which reports each kind of invalid
    message once, in one line.
    """
    windows = set[Any]()
    reported = set[str]()

    def report(error: BaseException | None) -> None:
        kind = type(error).__name__
        if kind not in reported:
            reported.add(kind)
            _LOG.warning("The page ignored a message of a browser (%s).", kind)
            _LOG.debug("", exc_info=error)

    async def handle(connection: Any) -> None:
        import viser

        # viser would print the other's
        if connection.subprotocol != f"viser-v{viser.__version__}":
            await connection.close(1002, f"expected viser {viser.__version__}")
            return
        asyncio.get_running_loop().set_exception_handler(
            lambda loop, context: report(context.get("exception"))
        )
        if len(windows) >= MOST_WINDOWS:
            await connection.close(1013, f"{MOST_WINDOWS} windows are open already")
            return
        windows.add(connection)
        try:
            await handler(connection)
        finally:
            windows.discard(connection)

    return handle
