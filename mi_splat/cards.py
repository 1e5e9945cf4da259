"""What a notebook shows of a value: pictures side by side above a line of facts, as HTML that needs nothing else.

Text may come out of the files of strangers. All of it is escaped here, and a picture is a PNG inside it. Styles are
in the elements, since a notebook may remove others; no colour is set that would be lost on a dark page.
"""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mi_splat.errors import InvalidValueError, listed, one_line

HEIGHT, WIDTH = 144, 480
"""Pixels that a picture of a card has at most."""


def card(facts: str, *drawings: str) -> str:
    """Drawings side by side, and a line of facts below them."""
    shown = _row(drawings) if drawings else ""
    line = f'<div style="font-family:monospace;font-size:0.85em;overflow-wrap:anywhere">{_text(facts)}</div>'
    return f'<div class="mi-splat-card">{shown}{line}</div>'


def picture(pixels: Any, caption: str = "", *, height: int = HEIGHT, width: int = WIDTH) -> str:
    """A picture with a caption below it."""
    values = _bytes(pixels)
    factor = min(1.0, height / values.shape[0], width / values.shape[1])
    image = Image.fromarray(values)
    if factor < 1:
        size = max(1, round(image.width * factor)), max(1, round(image.height * factor))
        image = image.resize(size, Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", optimize=True)
    data = base64.b64encode(buffer.getvalue()).decode()
    told = _text(caption)
    source = f'src="data:image/png;base64,{data}" alt="{told or "a picture"}" width="{image.width}"'
    # The class keeps the theme of a dark page from changing the colours.
    return _captioned(f'<img {source} class="dark-light" style="max-width:100%;height:auto">', caption)


class Pictures:
    """Pictures side by side, with their names below them, as a notebook shows them.

    Args:
        named: Picture by name; see `picture`.
        height: Pixels that each has at most.
        width: The same, of the other side.
    """

    def __init__(self, named: Mapping[str, Any], *, height: int = 192, width: int = WIDTH) -> None:
        self._drawings = [picture(value, name, height=height, width=width) for name, value in named.items()]
        self._names = listed(named)

    def __repr__(self) -> str:
        return f"Pictures({self._names})"

    def _repr_html_(self) -> str:
        return f'<div class="mi-splat-card">{_row(self._drawings)}</div>'


def sky(directions: NDArray[np.float64], marked: Sequence[bool], caption: str) -> str:
    """Directions as seen from straight above: the middle of the disc is up, its inner ring the horizon."""
    dots = []
    for (x, y, z), on in zip(directions.tolist(), marked, strict=True):
        far = math.acos(max(-1.0, min(1.0, z))) / math.pi  # 0 straight above, 1 straight below
        along = math.hypot(x, y) or 1.0
        at = f'cx="{80 + 72 * far * x / along:.1f}" cy="{80 - 72 * far * y / along:.1f}"'
        look = 'fill="#d1495b" r="3.5"' if on else 'fill="none" stroke="currentColor" stroke-opacity="0.5" r="2"'
        dots.append(f"<circle {at} {look}/>")
    rings = "".join(
        f'<circle cx="80" cy="80" r="{radius}" fill="none" stroke="currentColor" stroke-opacity="{light}"/>'
        for radius, light in ((72, 0.3), (36, 0.3))
    )
    drawing = f'<svg viewBox="0 0 160 160" width="160" height="160" role="img">{rings}{"".join(dots)}</svg>'
    return _captioned(drawing, caption)


def _captioned(drawing: str, caption: str) -> str:
    """A drawing with a line of text below it."""
    below = f'<div style="font-size:0.85em">{_text(caption)}</div>' if caption else ""
    return f"<div>{drawing}{below}</div>"


def _row(drawings: Sequence[str]) -> str:
    return f'<div style="display:flex;flex-wrap:wrap;gap:8px">{"".join(drawings)}</div>'


def _text(text: str) -> str:
    return html.escape(one_line(text))


def _bytes(pixels: Any) -> NDArray[np.uint8]:
    """A picture as (H, W, 3) uint8."""
    if hasattr(pixels, "detach"):
        pixels = pixels.detach().cpu()
    values = np.asarray(pixels)
    if values.ndim != 3 or values.shape[2] not in (3, 4) or 0 in values.shape:
        do = "pass a picture of three channels"
        raise InvalidValueError.of("picture", "shape (H, W, 3)", tuple(values.shape), do)
    if values.dtype != np.uint8:
        values = (np.nan_to_num(values.astype(np.float32)).clip(0, 1) * 255).round().astype(np.uint8)
    return np.ascontiguousarray(values[..., :3])
