"""Windows of a real browser on pages."""

import io
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mi_splat.viewer.bench import Bench
from mi_splat.viewer.painter import Painter
from tests.viewer.wire import serving

PATIENCE = 120.0
UNUSED = "'unsafe-eval' is not an allowed source of script"
"""What viser's own renderer of splats complains of, which the page does not use."""


class Window:
    """A window of the browser, which remembers what went wrong in it and whom it asked."""

    def __init__(self, chromium: Any, address: str, size: tuple[int, int]) -> None:
        self.page = chromium.new_page(viewport={"width": size[0], "height": size[1]})
        self.errors: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda line: self.errors.append(line.text) if line.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("websocket", lambda socket: self.asked.append(socket.url))
        self.page.goto(address)

    def shot(self, width: int | None = None) -> NDArray[np.int32]:
        """What is to be seen, without the controls on the right if a width is given."""
        with Image.open(io.BytesIO(self.page.screenshot())) as image:
            return np.asarray(image.convert("RGB"), np.int32)[:, :width]

    def until(self, true: Callable[[], bool]) -> None:
        """Wait until something is the case."""
        end = time.monotonic() + PATIENCE
        while not true():
            assert time.monotonic() < end, self.page.inner_text("body")
            self.page.wait_for_timeout(100)

    def says(self, text: str) -> None:
        """Wait until the page says something."""
        self.until(lambda: text in self.page.inner_text("body"))

    def check(self) -> None:
        """Nothing went wrong, and nobody but the server was asked."""
        assert not [error for error in self.errors if UNUSED not in error]
        others = [url for url in self.asked if urlsplit(url.removeprefix("blob:")).hostname not in ("127.0.0.1", None)]
        assert not others


@contextmanager
def window(
    chromium: Any, work: Painter | Bench, size: tuple[int, int] = (1000, 640), *, says: str = "above the ground"
) -> Iterator[Window]:
    """A window on a page that says something sooner or later."""
    with serving(work) as page:
        opened = Window(chromium, page.address, size)
        opened.says(says)
        yield opened
        opened.check()
        opened.page.close()
