"""The browser that tests open pages in, where there is one."""

import shutil
from collections.abc import Callable
from typing import Any

CHROMIUM = (
    shutil.which("chromium")
    or shutil.which("chromium-browser")
    or shutil.which("google-chrome")
)
SWITCHES = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
PATIENCE = 120_000
"""Milliseconds that a test waits for a page before it fails: on a busy machine all
takes long.
"""


def patient(make: Callable[..., Any]) -> Callable[..., Any]:
    """A function that makes a page or a context of the browser, but with this
    patience.
    """

    def made(**options: Any) -> Any:
        window = make(**options)
        window.set_default_timeout(PATIENCE)
        return window

    return made
