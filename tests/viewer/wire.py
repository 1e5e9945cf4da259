"""A page that is served, and a browser of a few lines: what viser's page says and hears
over its websocket.
"""

import io
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.server import Page

PATIENCE = 120.0
"""Seconds after which what does not come will never come."""


class Browser:
    """One connection, by an open websocket."""

    def __init__(self, socket: Any) -> None:
        self.socket = socket
        self.messages: list[dict[str, Any]] = []

    def look(self, orbit: Orbit, size: tuple[int, int] = (160, 80)) -> None:
        """Say where the camera is, as the page does whenever it moves."""
        import msgspec

        message = {
            "type": "ViewerCameraMessage",
            "wxyz": (1.0, 0.0, 0.0, 0.0),
            "position": orbit.position,
            "fov": 0.8,
            "near": 0.01,
            "far": 1000.0,
            "image_height": size[1],
            "image_width": size[0],
            "look_at": orbit.target,
            "up_direction": (0.0, 0.0, 1.0),
        }
        self.socket.send(msgspec.msgpack.encode(message))

    def say(self, kind: str, **content: Any) -> None:
        """Send any message."""
        import msgspec

        self.socket.send(msgspec.msgpack.encode({"type": kind, **content}))

    def until(self, arrived: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The next message of which this is true."""
        import msgspec
        import zstandard

        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            raw = self.socket.recv(timeout=PATIENCE)
            length = int.from_bytes(raw[8:16], "little")
            inner = msgspec.msgpack.decode(
                zstandard.ZstdDecompressor().decompress(raw[16 : 16 + length])
            )
            new = inner["messages"]
            start = 16 + length
            buffers = []
            # each begins at a multiple of eight
            for size in inner["binaryBufferLengths"]:
                start += -start % 8
                buffers.append(raw[start : start + size])
                start += size
            for message in new:
                if isinstance(message.get("rgb_data"), dict):
                    message["rgb_data"] = buffers[message["rgb_data"]["__binary_index"]]
            self.messages += new
            arrivals = [message for message in new if arrived(message)]
            if arrivals:
                return dict(arrivals[-1])
        pytest.fail("the message did not come")

    def picture(self, shape: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """The next image, of (height, width) if given."""
        while True:
            message = self.until(lambda message: bool(message.get("rgb_data")))
            with Image.open(io.BytesIO(message["rgb_data"])) as image:
                pixels = np.asarray(image)
            if shape is None or pixels.shape[:2] == shape:
                return pixels

    def control(self, label: str) -> dict[str, Any]:
        """The control with this label, among those that came so far or come soon."""

        def is_it(message: dict[str, Any]) -> bool:
            return bool(message.get("props", {}).get("label") == label)

        return next(filter(is_it, self.messages), None) or self.until(is_it)


def headers_of(address: str) -> dict[str, str]:
    """Headers of a page that was opened by its address."""
    with urllib.request.urlopen(address, timeout=PATIENCE) as answer:
        return {"Cookie": answer.headers["Set-Cookie"].partition(";")[0]}


@contextmanager
def connection(
    address: str,
    headers: dict[str, str],
    *,
    origin: str | None = None,
    version: str | None = None,
) -> Iterator[Browser]:
    """A websocket to the page at `address`."""
    import viser
    from websockets.sync.client import connect

    parts = urlsplit(address)
    with connect(
        f"ws://{parts.netloc}/",
        additional_headers=headers,
        origin=origin,  # type: ignore[arg-type]
        subprotocols=[f"viser-v{version or viser.__version__}"],  # type: ignore[list-item]
        max_size=None,
        compression=None,
    ) as socket:
        yield Browser(socket)


@contextmanager
def serving(shown: Painter) -> Iterator[Page]:
    """A page whose images another thread makes."""
    stop = threading.Event()
    with Page(shown, port=0) as page:
        thread = threading.Thread(target=page.run, args=(stop,))
        thread.start()
        try:
            yield page
        finally:
            stop.set()
            thread.join()
