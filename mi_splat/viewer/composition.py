"""From pictures of splats to the one picture that fills the page: beside each other, split, or their difference."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]

BESIDE, SPLIT, DIFFERENCE = "side by side", "split", "difference"
FULL_SCALE = 0.5
"""Change of a colour channel that has the brightest colour of a heat map."""
MARGIN = (24, 24, 27)
"""Colour around the pictures."""
GAP = 4
"""Pixels between two pictures of a full page."""

UPPER_PART = 0.45
"""Part of a high page's height that its controls leave free."""

_HEAT = ((0.0, (0, 0, 0)), (0.25, (88, 0, 110)), (0.5, (200, 40, 60)), (0.75, (250, 150, 20)), (1.0, (255, 255, 210)))


def ways_of_showing(splats: Sequence[str]) -> tuple[str, ...]:
    """What can be shown of one splat or of two, the first way being the usual one."""
    return tuple(splats) if len(splats) < 2 else (BESIDE, SPLIT, *splats, DIFFERENCE)


def panes(show: str, splats: Sequence[str]) -> tuple[str, ...]:
    """What stands beside each other: names of splats, or one of SPLIT and DIFFERENCE."""
    return tuple(splats) if show == BESIDE else (show,)


def needed(pane: str, splats: Sequence[str]) -> tuple[str, ...]:
    """Names of the splats whose pictures a pane is made of."""
    return tuple(splats) if pane in (SPLIT, DIFFERENCE) else (pane,)


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Where pictures stand on the page.

    Attributes:
        canvas: Width and height of the page's place for pictures, in pixels.
        size: Width and height of each picture.
        corners: Left and top of each picture.
    """

    canvas: tuple[int, int]
    size: tuple[int, int]
    corners: tuple[tuple[int, int], ...]

    @property
    def pixels(self) -> int:
        """Pixels of all pictures."""
        return len(self.corners) * self.size[0] * self.size[1]


def lay_out(canvas: tuple[int, int], aspect: float, count: int, *, gap: int = GAP) -> Layout:
    """Pictures of one shape as large as they can be, in a row or in a column.

    In a place that is higher than wide they stand in its upper part, since a narrow page has its controls at the
    bottom.
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
    """One picture (H, W, 3) of the whole place from those in it, (h, w, 3) each."""
    width, height = layout.canvas
    page = np.empty((height, width, 3), np.uint8)
    page[:] = MARGIN
    for picture, (left, top) in zip(pictures, layout.corners, strict=True):
        h, w = min(picture.shape[0], height - top), min(picture.shape[1], width - left)
        page[top : top + h, left : left + w] = picture[:h, :w]
    return page


def pane_pixels(pane: str, pictures: Mapping[str, Pixels], *, split: float = 0.5) -> Pixels:
    """The pixels of a pane."""
    if pane == DIFFERENCE:
        before, after = pictures.values()
        return heat_map(before, after)
    if pane == SPLIT:
        before, after = pictures.values()
        return split_pictures(before, after, split)
    return pictures[pane]


def split_pictures(left: Pixels, right: Pixels, at: float) -> Pixels:
    """The left part of one picture and the right part of another, with a white line between them."""
    column = round(min(max(at, 0.0), 1.0) * left.shape[1])
    both = np.concatenate([left[:, :column], right[:, column:]], axis=1)
    both[:, max(column - 1, 0) : column + 1] = 255
    return both


def heat_map(before: Pixels, after: Pixels) -> Pixels:
    """How much each pixel changed: its largest change of a channel, black for none, over red to white."""
    change = np.abs(after.astype(np.int16) - before.astype(np.int16)).max(axis=-1)
    colours: Pixels = _heat_table()[change]
    return colours


def _heat_table() -> Pixels:
    """(256, 3) colour of each change of 0 to 255."""
    change = np.arange(256) / 255 / FULL_SCALE
    stops = [stop for stop, _ in _HEAT]
    channels = [np.interp(change, stops, [colour[i] for _, colour in _HEAT]) for i in range(3)]
    return np.stack(channels, axis=-1).astype(np.uint8)


def _fit(width: int, height: int, aspect: float) -> tuple[int, int]:
    """The largest picture of this shape that fits."""
    if width / height > aspect:
        return max(1, round(height * aspect)), height
    return width, max(1, round(width / aspect))
