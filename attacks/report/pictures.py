"""Pictures inside a page: PNG files as data: addresses, made smaller where they are large."""

from __future__ import annotations

import base64
import io
from pathlib import Path

from PIL import Image

from mi_splat.io.picture_files import load_picture

LONGEST_SIDE = 1200
"""Pixels that the longer side of a picture on a page has at most."""


def data_address(path: Path) -> tuple[str, int, int]:
    """A picture as a data: address, and its width and height on the page.

    Raises:
        PictureFileError: The file is no picture, or has too many pixels.
    """
    picture = load_picture(path).convert("RGB")
    if max(picture.size) > LONGEST_SIDE:
        picture.thumbnail((LONGEST_SIDE, LONGEST_SIDE), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii"), *picture.size
