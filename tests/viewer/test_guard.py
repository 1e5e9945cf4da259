"""Who may see the page."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from mi_splat.errors import MiSplatError
from mi_splat.viewer.guard import COOKIE, NAMING, Guard, guarding

GUARD = Guard(token="secret-of-this-page", secret_path="somewhere", cookie="crumb")
HERE = {"Host": "127.0.0.1:8080"}
COOKIES = {"Cookie": f"other=1; {COOKIE}-8080=crumb"}
TUNNEL = {"Host": "localhost:9000", "Cookie": f"{COOKIE}-9000=crumb"}


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("/?token=secret-of-this-page", HERE),
        ("/", {**HERE, **COOKIES}),
        ("/", {**HERE, **COOKIES, "Origin": "http://127.0.0.1:8080"}),
        ("/somewhere", {**HERE, **COOKIES, "Origin": "http://127.0.0.1:8080"}),
        ("/", {**TUNNEL, "Origin": "http://localhost:9000"}),
        ("/", {"Host": "[::1]:8080", **COOKIES}),
        ("/", {"Host": "localhost", "Cookie": f"{COOKIE}-80=crumb"}),
        # What others on this host have left in the browser is in the same header.
        ("/", {**HERE, "Cookie": f'a={{"b": [1, 2]}}; {COOKIES["Cookie"]}'}),
        (
            "/",
            {
                **HERE,
                "Cookie": (
                    f"{COOKIE}-8080=theirs; {COOKIE}-8080=crumb; {COOKIE}-8080=theirs"
                ),
            },
        ),
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
        *(
            (f"/?token=secret{rest}", HERE, "token")
            for rest in ("", "-of-this-pagf", "-of-this-page-")
        ),
        ("/?token=s\u00e9cret", HERE, "token"),
        ("/?token=s%ED%A0%80cret", HERE, "token"),
        ("//[x", HERE, "no address"),
        ("/", {**HERE, "Cookie": f"{COOKIE}-8080=wrong"}, "token"),
        # it is for the address alone
        ("/", {**HERE, "Cookie": f"{COOKIE}-8080=secret"}, "token"),
        ("/", {**HERE, "Cookie": f"{COOKIE}-8080=cr\u00fcmb"}, "token"),
        ("/", {**HERE, "Cookie": f"{COOKIE}-9000=crumb"}, "token"),
        ("/?token=crumb", HERE, "token"),
        ("/somewhere/", HERE, "token"),
        ("/", {**HERE, "Cookie": ";;\x00="}, "token"),
        ("/?token=secret-of-this-page", {}, "name"),
        ("/?token=secret-of-this-page", {"Host": "evil.example:8080"}, "name"),
        ("/?token=secret-of-this-page", {"Host": "127.0.0.1.evil.example"}, "name"),
        ("/?token=secret-of-this-page", {"Host": "[127.0.0.1"}, "name"),
        ("/?token=secret-of-this-page", {"Host": "127.0.0.1:none"}, "name"),
        ("/", {**HERE, **COOKIES, "Origin": "http://evil.example"}, "another page"),
        ("/", {**HERE, **COOKIES, "Origin": "http://127.0.0.1:9999"}, "another page"),
        ("/", {**HERE, **COOKIES, "Origin": "null"}, "another page"),
    ],
)
def test_all_others_are_refused(
    path: str, headers: dict[str, str], reason: str
) -> None:
    assert reason in str(GUARD.objection(path, headers))


def test_secrets_are_long_and_never_the_same() -> None:
    for part, length in {"token": 32, "secret_path": 16, "cookie": 32}.items():
        assert len({getattr(Guard(), part) for _ in range(20)}) == 20
        assert len(getattr(Guard(), part)) >= length


def test_the_page_connects_to_nobody_else_and_runs_no_other_script() -> None:
    headers = GUARD.headers("127.0.0.1:8080", "random")
    policy = dict(
        part.split(" ", 1) for part in headers["Content-Security-Policy"].split("; ")
    )
    assert policy["script-src"] == "'nonce-random' 'strict-dynamic' 'wasm-unsafe-eval'"
    assert policy["connect-src"] == "'self' ws://127.0.0.1:8080 data:"
    shut = {
        "default-src",
        "frame-src",
        "object-src",
        "base-uri",
        "form-action",
        "frame-ancestors",
    }
    assert {name for name, value in policy.items() if value == "'none'"} == shut
    assert not [
        name
        for name, value in policy.items()
        if "unsafe-inline" in value and name != "style-src"
    ]


def test_a_cookie_goes_only_to_its_own_page() -> None:
    other = Guard()
    for guard in (GUARD, other):
        name, *attributes = guard.headers("127.0.0.1:8080", "")["Set-Cookie"].split(
            "; "
        )
        assert attributes == [
            "HttpOnly",
            "SameSite=Strict",
            f"Path=/{guard.secret_path}",
        ]
        assert name == f"{COOKIE}-8080={guard.cookie}"
    assert other.objection("/", {**HERE, **COOKIES}) is not None
    assert GUARD.headers("localhost:9000", "")["Set-Cookie"].startswith(
        f"{COOKIE}-9000="
    )


def test_an_address_with_a_token_leads_on_to_one_without() -> None:
    assert 'content="0; url=/somewhere/"' in str(
        GUARD.door("/?token=secret-of-this-page")
    )
    kept = 'url=/somewhere/?darkMode=&amp;a=%22%3Cb%3E"'
    assert kept in str(
        GUARD.door("/?darkMode&token=secret-of-this-page&a=%22<b>&token=x")
    )
    assert GUARD.door("/somewhere/?darkMode") is None


def connection() -> Any:
    def respond(status: int, text: str) -> Any:
        return SimpleNamespace(
            status=int(status), text=text, headers={"Content-Type": "text/plain"}
        )

    return SimpleNamespace(respond=respond)


def request(path: str, **headers: str) -> Any:
    return SimpleNamespace(path=path, headers={**HERE, **headers})


def served(answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """How a server that was started within the guard answers."""
    started: list[Any] = []
    module = SimpleNamespace(
        serve=lambda *arguments, **options: started.append(options)
    )
    plain = module.serve
    with guarding(GUARD, module):
        module.serve("handler", process_request=answer)
    assert module.serve is plain
    process: Callable[[Any, Any], Any] = started[0]["process_request"]
    return process


def test_a_guarded_server_answers_those_who_may_pass() -> None:
    def answer(connection: Any, request: Any) -> Any:
        assert "Accept-Encoding" not in request.headers
        headers = {"Content-Type": "text/html; charset=utf-8", "Content-Length": "3"}
        return SimpleNamespace(
            path=request.path, headers=headers, body=b"<script>1</script>"
        )

    process = served(answer)
    page, again = (
        process(
            connection(),
            request("/somewhere/", **COOKIES, **{"Accept-Encoding": "gzip"}),
        )
        for _ in range(2)
    )
    nonce = page.body.split(b'"')[1].decode()
    assert page.path == "/"
    assert (
        page.body
        == f'<script nonce="{nonce}">1</script><script'
        f' nonce="{nonce}">{NAMING}</script>'.encode()
    )
    assert f"'nonce-{nonce}'" in page.headers["Content-Security-Policy"]
    assert nonce.encode() not in again.body
    assert page.headers["Content-Length"] == str(len(page.body))
    assert page.headers["Set-Cookie"].startswith(f"{COOKIE}-8080=crumb;")
    door = process(connection(), request("/?token=secret-of-this-page"))
    assert (door.status, door.text) == (200, GUARD.door("/?token=secret-of-this-page"))
    assert door.headers["Content-Type"].startswith("text/html")
    assert door.headers["Set-Cookie"] == page.headers["Set-Cookie"]


def test_a_server_that_nothing_guards_is_an_error() -> None:
    module = SimpleNamespace(serve=lambda *arguments, **options: None)
    with (
        pytest.raises(MiSplatError, match="expected a server to guard"),
        guarding(GUARD, module),
    ):
        pass
    with (
        pytest.raises(MiSplatError, match="expected a server of pages"),
        guarding(GUARD, module),
    ):
        module.serve("handler")
