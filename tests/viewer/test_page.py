"""The server of the page, over HTTP and a websocket, without a browser."""

import re
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from urllib.parse import urlsplit

import numpy as np
import pytest
from torch import Tensor

pytest.importorskip("viser", reason="needs the extra `view`")

from websockets.exceptions import ConnectionClosed, InvalidStatus

from mi_splat.cameras.camera import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.render.tile.frozen import between_stages
from mi_splat.scene import GaussianScene
from mi_splat.viewer.content import Inspection
from mi_splat.viewer.guard import COOKIE, MOST_WINDOWS
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.server import Page, check_port
from mi_splat.viewer.session import DIFFERENCE, Pace, Step, ViewState
from tests.fakes import blobs
from tests.viewer.contents import ABOVE, START, MeanInspector, balls, painter
from tests.viewer.wire import PATIENCE, Browser, connection, headers_of, serving

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:websockets")
FULL = (80, 160)


@contextmanager
def visiting(shown: Painter) -> Iterator[Browser]:
    """A browser on a page; it has the first camera and a window of 160 x 80."""
    with (
        serving(shown) as page,
        connection(page.address, headers_of(page.address)) as browser,
    ):
        browser.look(START)
        yield browser


@pytest.fixture
def page() -> Iterator[Page]:
    with serving(painter()) as page:
        yield page


def fetch(address: str, headers: dict[str, str]) -> tuple[int, str, dict[str, str]]:
    """Status, text and headers of an answer."""
    try:
        with urllib.request.urlopen(
            urllib.request.Request(address, headers=headers), timeout=60
        ) as answer:
            return answer.status, answer.read().decode(), dict(answer.headers)
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode(), {}


def test_the_address_opens_the_page_and_nothing_else_does(page: Page) -> None:
    bare = page.address.partition("?")[0]
    status, text, headers = fetch(page.address, {})
    assert status == 200
    assert page.address.partition("=")[2] not in text
    leads_to = re.search(r'url=/([\w-]+/)"', text)
    assert leads_to is not None
    cookie = {"Cookie": headers["Set-Cookie"].partition(";")[0]}
    status, text, headers = fetch(bare + leads_to[1], cookie)
    assert (status, '<div id="root">' in text) == (200, True)
    assert headers["Content-Security-Policy"].startswith(
        "default-src 'none'; script-src 'nonce-"
    )
    assert headers["Set-Cookie"].endswith(f"Path=/{leads_to[1][:-1]}")
    assert fetch(bare + leads_to[1] + "none.js", cookie)[0] == 404
    assert fetch(bare + leads_to[1], {})[0] == 403
    assert fetch(bare, {})[0] == 403
    assert fetch(page.address, {"Host": "evil.example"})[0] == 403
    assert fetch(page.address, {"Origin": "http://evil.example"})[0] == 403


def test_a_websocket_needs_the_token_too(page: Page) -> None:
    wrong = {"Cookie": f"{COOKIE}-{urlsplit(page.address).port}=x"}
    for headers, origin in (
        ({}, None),
        (wrong, None),
        (headers_of(page.address), "http://evil.example"),
    ):
        with (
            pytest.raises(InvalidStatus, match="403"),
            connection(page.address, headers, origin=origin),
        ):
            pass


def test_the_picture_follows_the_mouse_and_so_do_the_controls() -> None:
    work = painter()
    there = replace(START, azimuth=200.0, elevation=-10.0, distance=9.0)
    with visiting(work) as browser:
        for orbit in (START, there):
            if orbit is there:
                time.sleep(1.1)  # until the browser is listened to
                browser.look(there)
            assert browser.picture().shape[1] < FULL[1]  # coarse
            pixels = browser.picture(FULL)
            state = ViewState(orbit=orbit, mode="side by side", canvas=(160, 80))
            # JPEG
            assert (
                np.abs(
                    pixels.astype(int) - work.paint(state, Step.FULL, Pace()).pixels
                ).mean()
                < 3
            )
        uuid = browser.control("Azimuth")["uuid"]
        values = [
            m["updates"]["value"]
            for m in browser.messages
            if m.get("uuid") == uuid and "updates" in m
        ]
        assert values[-1] == 200.0


def test_a_control_moves_the_camera() -> None:
    work = painter(inspector=MeanInspector())
    with visiting(work) as browser:
        slider = browser.control("Elevation")
        browser.picture(FULL)
        for value in (float("nan"), 1e9, None, 70.0):  # the first ones change nothing
            browser.say(
                "GuiUpdateMessage", uuid=slider["uuid"], updates={"value": value}
            )
        told = browser.until(
            lambda message: message["type"] == "SetCameraPositionMessage"
        )
        assert np.allclose(told["position"], replace(START, elevation=70.0).position)
        expected = (
            painter(inspector=MeanInspector())
            .inspect("clean", replace(START, elevation=70.0))
            .text
        )
        browser.until(lambda message: expected in str(message.get("updates", {})))


def test_a_movement_interrupts_a_full_picture() -> None:
    begun = threading.Event()

    # in full, from the first camera
    def slow(scene: GaussianScene, camera: Camera) -> Tensor:
        end = time.monotonic() + (
            PATIENCE if camera.height == FULL[0] and camera.position[2] < 2 else 0
        )
        while time.monotonic() < end:
            begun.set()
            between_stages.get()()
        return blobs(scene, camera)

    with visiting(Painter(balls(1), slow)) as browser:
        assert begun.wait(PATIENCE)
        browser.say(
            "GuiUpdateMessage",
            uuid=browser.control("Elevation")["uuid"],
            updates={"value": 70.0},
        )
        state = ViewState(
            orbit=replace(START, elevation=70.0), mode="clean", canvas=(160, 80)
        )
        expected = Painter(balls(1), blobs).paint(state, Step.FULL, Pace()).pixels
        assert np.abs(browser.picture(FULL).astype(int) - expected).mean() < 3  # JPEG


def test_a_click_selects_an_object_and_a_button_clears_it() -> None:
    with visiting(painter(1)) as browser:
        browser.picture(FULL)
        ray = {"ray_origin": (0.0, 0.0, 0.0), "ray_direction": (0.0, 0.0, 1.0)}
        # beside the image, on nothing, on the ball
        for at in ((float("nan"), 7.0), (0.0, 0.5), (0.5, 0.5)):
            browser.say(
                "ScenePointerMessage",
                event_type="click",
                screen_pos=(at,),
                modifier=None,
                **ray,
            )
        browser.until(
            lambda message: (
                "mi-splat select clean.ply --click 24,16"
                in str(message.get("updates", {}))
            )
        )
        assert any(
            "Gaussians of clean" in str(message.get("updates", {}))
            for message in browser.messages
        )
        browser.say(
            "GuiUpdateMessage",
            uuid=browser.control("Clear")["uuid"],
            updates={"value": True},
        )
        browser.until(
            lambda message: "Click on an object" in str(message.get("updates", {}))
        )


def test_boxes_are_dragged_with_ctrl_and_can_be_saved() -> None:
    with visiting(painter(1)) as browser:
        browser.picture(FULL)
        ray = {"ray_origin": None, "ray_direction": None}
        for _ in range(2):
            browser.say(
                "ScenePointerMessage",
                event_type="rect-select",
                screen_pos=((0.35, 0.2), (0.65, 0.8)),
                modifier="cmd/ctrl",
                **ray,
            )
        browser.until(lambda message: "in 2 boxes" in str(message.get("updates", {})))
        assert browser.control("Save boxes.json")


def test_a_few_windows_are_served_at_a_time(page: Page) -> None:
    headers = headers_of(page.address)
    with ExitStack() as stack:
        windows = [
            stack.enter_context(connection(page.address, headers))
            for _ in range(MOST_WINDOWS)
        ]
        with (
            connection(page.address, headers) as one_more,
            pytest.raises(ConnectionClosed, match="windows are open"),
        ):
            one_more.socket.recv(timeout=PATIENCE)
        windows[0].socket.close()
        end = time.monotonic() + PATIENCE
        while True:
            try:
                with connection(page.address, headers) as next_one:
                    next_one.look(START)
                    assert next_one.picture().size
                break
            except ConnectionClosed:
                # the server has not heard yet that a window is gone
                assert time.monotonic() < end


def test_each_kind_of_invalid_message_is_reported_once(
    page: Page, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    headers = headers_of(page.address)
    with connection(page.address, headers) as browser:
        browser.look(START)
        browser.picture(FULL)
        slider = browser.control("Elevation")["uuid"]
        for number in range(100):
            for value in (
                f"{number}{'x' * 2000}",
                {str(number): "y" * 2000},
                ["z" * 2000],
            ):
                browser.say("GuiUpdateMessage", uuid=slider, updates={"value": value})
        browser.say("GuiUpdateMessage", uuid=slider, updates={"value": 70.0})
        browser.until(lambda message: message["type"] == "SetCameraPositionMessage")
        browser.say("ViewerCameraMessage", position="w" * 2000)
        with pytest.raises(ConnectionClosed):
            browser.until(lambda message: False)
    with (
        pytest.raises(ConnectionClosed),
        connection(page.address, headers, version="v" * 100) as browser,
    ):
        browser.until(lambda message: False)
    said = caplog.text + "".join(capfd.readouterr())
    assert 1 <= said.count("\n") <= 4
    assert not re.search("xxx|yyy|zzz|www|vvv|Traceback", said)


def test_a_browser_changes_nothing_of_a_control_but_its_value() -> None:
    with visiting(painter(1)) as browser:
        browser.picture(FULL)
        text = browser.control("clean")["uuid"]  # the command
        file = {
            "transfer_uuid": "a",
            "filename": "b",
            "mime_type": "c",
            "part_count": 0,
            "size_bytes": 0,
        }
        browser.say("FileTransferStartUpload", source_component_uuid=text, **file)
        for updates in ({"removed": True}, {"value": "", "removed": True}):
            browser.say("GuiUpdateMessage", uuid=text, updates=updates)
        browser.say(
            "GuiUpdateMessage",
            uuid=browser.control("Elevation")["uuid"],
            updates={"value": 70.0},
        )
        told = browser.until(
            lambda message: "--elevation 70" in str(message.get("updates", {}))
        )
        assert told["uuid"] == text
        assert "FileTransferPartAck" not in [
            message["type"] for message in browser.messages
        ]


def test_a_mode_that_is_not_there_changes_nothing() -> None:
    with (
        serving(painter(1)) as page,
        connection(page.address, headers_of(page.address)) as browser,
    ):
        browser.look(START)
        browser.picture(FULL)
        (client,) = page._clients.values()
        client._change(lambda state: replace(state, mode=DIFFERENCE, orbit=ABOVE))
        browser.picture(FULL)


def test_an_error_in_a_picture_is_shown_and_the_next_one_succeeds() -> None:
    work = painter(inspector=MeanInspector())
    inspector = MeanInspector()

    def fail(picture: Tensor) -> Inspection:
        raise InvalidValueError("image: expected another, got this; look elsewhere")

    work.inspector = fail
    with visiting(work) as browser:
        browser.until(
            lambda message: "look elsewhere" in str(message.get("updates", {}))
        )
        work.inspector = inspector
        elevation = browser.control("Elevation")["uuid"]
        browser.say("GuiUpdateMessage", uuid=elevation, updates={"value": 70.0})
        browser.until(lambda message: "mean colour" in str(message.get("updates", {})))


def test_nobody_can_open_the_page_to_the_world(monkeypatch: pytest.MonkeyPatch) -> None:
    from viser import _viser

    asked: list[object] = []
    monkeypatch.setattr(
        _viser, "ViserTunnel", lambda *arguments: asked.append(arguments)
    )
    with visiting(painter(1)) as browser:
        browser.say("ShareUrlRequest")
        browser.picture(FULL)
    assert not asked


def test_closing_leaves_no_thread_and_frees_the_port(
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = set(threading.enumerate())
    with serving(painter(1)) as page:
        port = urlsplit(page.address).port
        assert port is not None
        with connection(page.address, headers_of(page.address)) as browser:
            browser.look(START)
            browser.picture()
        with pytest.raises(InvalidValueError, match="expected a free port"):
            check_port(port)
    end = time.monotonic() + 60
    while set(threading.enumerate()) - before and time.monotonic() < end:
        time.sleep(0.05)
    assert not set(threading.enumerate()) - before
    check_port(port)
    assert capsys.readouterr().out == ""


def test_a_taken_port_is_not_left_for_another() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(
            InvalidValueError, match=r"port \d+: expected a free port.*--port 0"
        ):
            Page(painter(1), port=taken.getsockname()[1])
    with pytest.raises(InvalidValueError, match="expected a free port"):
        check_port(99999)
