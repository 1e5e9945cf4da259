"""Who may see the page: whoever knows its token, from a page of its own, under a name that was expected.

A server on this machine alone is still within reach of other users of it and of any web page that is open in a browser
on it. So every request needs the token: first in the address, then in a cookie that only this page's requests carry. A
request that another page makes is refused by its Origin, and one that came by a foreign name (DNS rebinding) by its
Host.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from mi_splat.errors import InvalidValueError, MiSplatError, message

LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
COOKIE = "mi-splat-view"


def is_loopback(host: str) -> bool:
    """Whether a name stands for this machine alone."""
    if host in LOOPBACK_NAMES:
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def checked_host(host: str, *, allow_remote: bool) -> str:
    """The host, if the page may be served on it.

    Raises:
        InvalidValueError: It can be reached from other machines, and nobody has allowed that.
    """
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
        token: What the address has to hold.
    """

    names: frozenset[str] | None = LOOPBACK_NAMES
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))

    def objection(self, path: str, headers: Mapping[str, str]) -> str | None:
        """Why a request is refused; None if it is not.

        Args:
            path: With its query, as the request has it.
            headers: Of the request.
        """
        host = headers.get("Host", "")
        if self.names is not None and urlsplit(f"//{host}").hostname not in self.names:
            return "this page is not served under that name"
        origin = headers.get("Origin")
        if origin is not None and origin != f"http://{host}":
            return "another page may not use this one"
        if not any(hmac.compare_digest(given.encode(), self.token.encode()) for given in self._given(path, headers)):
            return "open the address that mi-splat view has printed, with its token"
        return None

    def headers(self, host: str) -> dict[str, str]:
        """Headers of every answer: the cookie, and that the page shall ask nothing of anybody else.

        Args:
            host: Name and port under which the request came.
        """
        return {
            "Set-Cookie": f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/",
            "Content-Security-Policy": (
                "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; "
                f"connect-src 'self' ws://{host} data: blob:; frame-ancestors 'none'; form-action 'none'"
            ),
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
        }

    def _given(self, path: str, headers: Mapping[str, str]) -> Iterator[str]:
        """What a request gives for the token."""
        yield from parse_qs(urlsplit(path).query).get("token", ())
        try:
            cookie = SimpleCookie(headers.get("Cookie", "")).get(COOKIE)
        except CookieError:
            return
        if cookie is not None:
            yield cookie.value


@contextmanager
def guarding(guard: Guard, websockets_server: Any) -> Iterator[None]:
    """Servers that `websockets` begins to serve in this block answer only requests that the guard lets pass.

    viser has no hook for it, so its call of `serve` is led through here.

    Args:
        guard: Who may pass.
        websockets_server: The module `websockets.asyncio.server`.

    Raises:
        MiSplatError: No server was begun, or in a way that this code does not know: nothing would guard it.
    """
    plain, guarded = websockets_server.serve, []

    def serve(*arguments: Any, **options: Any) -> Any:
        answer: Callable[[Any, Any], Any] | None = options.get("process_request")
        if answer is None:
            raise MiSplatError("viser: expected a server of pages, got another; install the version that is asked for")

        def process_request(connection: Any, request: Any) -> Any:
            objection = guard.objection(request.path, request.headers)
            if objection is not None:
                return connection.respond(HTTPStatus.FORBIDDEN, f"{objection}\n")
            response = answer(connection, request)
            if response is not None:
                for name, value in guard.headers(request.headers["Host"]).items():
                    response.headers[name] = value
            return response

        guarded.append(True)
        return plain(*arguments, **{**options, "process_request": process_request})

    websockets_server.serve = serve
    try:
        yield
    finally:
        websockets_server.serve = plain
    if not guarded:
        raise MiSplatError("viser: expected a server to guard, got none; install the version that is asked for")
