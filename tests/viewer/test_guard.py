"""Who may see the page."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.viewer.guard import COOKIE, Guard, checked_host, guarding, is_loopback

GUARD = Guard(token="secret")
HERE = {"Host": "127.0.0.1:8080"}
COOKIES = {"Cookie": f"other=1; {COOKIE}=secret"}


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("/?token=secret", HERE),
        ("/", {**HERE, **COOKIES}),
        ("/", {**HERE, **COOKIES, "Origin": "http://127.0.0.1:8080"}),
        ("/", {"Host": "localhost:9000", **COOKIES, "Origin": "http://localhost:9000"}),  # through a tunnel
        ("/", {"Host": "[::1]:8080", **COOKIES}),
    ],
)
def test_who_knows_the_token_may_pass(path: str, headers: dict[str, str]) -> None:
    assert GUARD.objection(path, headers) is None


@pytest.mark.parametrize(
    ("path", "headers", "reason"),
    [
        ("/", HERE, "token"),
        ("/?token=wrong", HERE, "token"),
        ("/?token=", HERE, "token"),
        ("/?token=s\u00e9cret", HERE, "token"),
        ("/", {**HERE, "Cookie": f"{COOKIE}=wrong"}, "token"),
        ("/", {**HERE, "Cookie": ";;\x00="}, "token"),
        ("/?token=secret", {}, "name"),
        ("/?token=secret", {"Host": "evil.example:8080"}, "name"),
        ("/?token=secret", {"Host": "127.0.0.1.evil.example"}, "name"),
        ("/", {**HERE, **COOKIES, "Origin": "http://evil.example"}, "another page"),
        ("/", {**HERE, **COOKIES, "Origin": "http://127.0.0.1:9999"}, "another page"),
        ("/", {**HERE, **COOKIES, "Origin": "null"}, "another page"),
    ],
)
def test_all_others_are_refused(path: str, headers: dict[str, str], reason: str) -> None:
    assert reason in str(GUARD.objection(path, headers))


def test_under_any_name_the_token_is_needed_still() -> None:
    remote = Guard(names=None, token="secret")
    assert remote.objection("/?token=secret", {"Host": "server.example"}) is None
    assert remote.objection("/", {"Host": "server.example"}) is not None
    assert remote.objection("/", {"Host": "server.example", **COOKIES, "Origin": "http://evil.example"}) is not None


def test_tokens_are_long_and_never_the_same() -> None:
    assert len({Guard().token for _ in range(20)}) == 20
    assert len(Guard().token) >= 32


def test_the_page_may_ask_nobody_else() -> None:
    headers = GUARD.headers("127.0.0.1:8080")
    assert "default-src 'self'" in headers["Content-Security-Policy"]
    assert "http" not in headers["Content-Security-Policy"]
    assert "SameSite=Strict" in headers["Set-Cookie"]
    assert "HttpOnly" in headers["Set-Cookie"]


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1", "127.8.8.8"])
def test_this_machine_alone(host: str) -> None:
    assert is_loopback(host)
    assert checked_host(host, allow_remote=False) == host


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.4", "server.example", ""])
def test_other_machines_need_a_word(host: str) -> None:
    with pytest.raises(InvalidValueError, match=r"host: expected 127\.0\.0\.1 .* SSH tunnel"):
        checked_host(host, allow_remote=False)
    assert checked_host(host, allow_remote=True) == host


def connection() -> Any:
    return SimpleNamespace(respond=lambda status, text: (int(status), text))


def request(path: str, **headers: str) -> Any:
    return SimpleNamespace(path=path, headers={**HERE, **headers})


def served(answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """How a server that was begun within the guard answers."""
    begun: list[Any] = []
    module = SimpleNamespace(serve=lambda *arguments, **options: begun.append(options))
    plain = module.serve
    with guarding(GUARD, module):
        module.serve("handler", process_request=answer)
    assert module.serve is plain
    process: Callable[[Any, Any], Any] = begun[0]["process_request"]
    return process


def test_a_guarded_server_asks_the_guard_first() -> None:
    process = served(lambda connection, request: pytest.fail("reached"))
    status, text = process(connection(), request("/"))
    assert status == 403
    assert "token" in text


def test_a_guarded_server_answers_those_who_may_pass() -> None:
    page, process = SimpleNamespace(headers={}), served(lambda connection, request: page)
    assert process(connection(), request("/?token=secret")) is page
    assert page.headers["Set-Cookie"].startswith(f"{COOKIE}=secret;")


def test_a_websocket_goes_on_to_its_handler() -> None:
    process = served(lambda connection, request: None)
    assert process(connection(), request("/", **COOKIES)) is None


def test_a_server_that_nothing_guards_is_an_error() -> None:
    module = SimpleNamespace(serve=lambda *arguments, **options: None)
    with pytest.raises(MiSplatError, match="expected a server to guard"), guarding(GUARD, module):
        pass
    with pytest.raises(MiSplatError, match="expected a server of pages"), guarding(GUARD, module):
        module.serve("handler")
