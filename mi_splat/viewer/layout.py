"""Places the pictures of a page side by side, and draws the difference of two."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]

SIDE_BY_SIDE, DIFFERENCE = "side by side", "difference"
MARGIN = (24, 24, 27)
"""Colour around the pictures."""
UPPER_PART = 0.45
"""Fraction of a portrait page's height that its controls leave free."""


def display_modes(names: Sequence[str]) -> tuple[str, ...]:
    """How one picture or two can be shown; the first is the default."""
    return tuple(names) if len(names) < 2 else (SIDE_BY_SIDE, *names, DIFFERENCE)


def panes(mode: str, names: Sequence[str]) -> tuple[str, ...]:
    """What stands side by side: pictures by name, or their difference."""
    return tuple(names) if mode == SIDE_BY_SIDE else (mode,)


def pictures_of(pane: str, names: Sequence[str]) -> tuple[str, ...]:
    """Names of the pictures that a pane is made of."""
    return tuple(names) if pane == DIFFERENCE else (pane,)


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Where pictures of one size stand on a page: the left upper corner of each, in pixels."""

    canvas: tuple[int, int]
    size: tuple[int, int]
    corners: tuple[tuple[int, int], ...]


def lay_out(canvas: tuple[int, int], aspect: float, count: int, *, gap: int = 4) -> Layout:
    """Pictures of one shape as large as possible, in a row or in a column.

    On a portrait page they stand in the upper part, because the controls of a narrow page are at the bottom.
    """
    width, height = max(canvas[0], count), max(canvas[1], count)
    free = height if height <= width else max(count, round(UPPER_PART * height))
    row = _fit(max((width - gap * (count - 1)) // count, 1), free, aspect)
    column = _fit(width, max((free - gap * (count - 1)) // count, 1), aspect)
    w, h = max(row, column)
    across, down = (count, 1) if (w, h) == row else (1, count)
    left = (width - across * w - gap * (across - 1)) // 2
    top = 0 if height > width else (height - down * h - gap * (down - 1)) // 2
    corners = tuple(
        (max(left, 0) + i * (w + gap if across > 1 else 0), max(top, 0) + i * (h + gap if down > 1 else 0))
        for i in range(count)
    )
    return Layout(canvas=(width, height), size=(w, h), corners=corners)


def compose(pictures: Sequence[Pixels], layout: Layout) -> Pixels:
    """One picture (H, W, 3) of the whole canvas from the pictures on it, (h, w, 3) each."""
    width, height = layout.canvas
    page = np.empty((height, width, 3), np.uint8)
    page[:] = MARGIN
    for picture, (left, top) in zip(pictures, layout.corners, strict=True):
        h, w = min(picture.shape[0], height - top), min(picture.shape[1], width - left)
        page[top : top + h, left : left + w] = picture[:h, :w]
    return page


def difference(before: Pixels, after: Pixels) -> Pixels:
    """The largest change of a channel of each pixel as grey, white from half of the range."""
    change = np.abs(after.astype(np.int16) - before.astype(np.int16)).max(axis=-1, keepdims=True)
    grey: Pixels = np.minimum(2 * change, 255).repeat(3, axis=-1).astype(np.uint8)
    return grey


def _fit(width: int, height: int, aspect: float) -> tuple[int, int]:
    """The largest picture of this shape that fits."""
    if width / height > aspect:
        return max(1, round(height * aspect)), height
    return width, max(1, round(width / aspect))
