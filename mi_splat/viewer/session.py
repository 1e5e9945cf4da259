"""What a browser window shows and which image is due next, without a browser and
without a clock.

While the camera moves, coarse images are rendered with as many pixels as the time for
one allows. When it rests, one of half the width follows, the full one, and then one
with the detections. A movement interrupts them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from mi_splat.viewer.orbit import Orbit

Pixels = NDArray[np.uint8]

SIDE_BY_SIDE = "side by side"
DIFFERENCE = "difference"
MARGIN = (24, 24, 27)  # colour around the images
UPPER_PART = 0.45  # fraction of a portrait page's height that its controls leave free


def display_modes(names: Sequence[str]) -> tuple[str, ...]:
    """How one image or two can be shown; the first is the default."""
    if len(names) < 2:
        return tuple(names)
    return (SIDE_BY_SIDE, *names, DIFFERENCE)


def panes(mode: str, names: Sequence[str]) -> tuple[str, ...]:
    """What stands side by side: images by name, or their difference."""
    if mode == SIDE_BY_SIDE:
        return tuple(names)
    return (mode,)


def pictures_of(pane: str, names: Sequence[str]) -> tuple[str, ...]:
    """Names of the images that a pane is made of."""
    if pane == DIFFERENCE:
        return tuple(names)
    return (pane,)


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Where images of one size stand on a page: the left upper corner of each, in
    pixels.
    """

    canvas: tuple[int, int]
    size: tuple[int, int]
    corners: tuple[tuple[int, int], ...]


def lay_out(
    canvas: tuple[int, int], aspect: float, count: int, *, gap: int = 4
) -> Layout:
    """Images of one shape as large as possible, in a row or in a column."""
    width = max(canvas[0], count)
    height = max(canvas[1], count)
    free = height if height <= width else max(count, round(UPPER_PART * height))
    row = _fit(max((width - gap * (count - 1)) // count, 1), free, aspect)
    column = _fit(width, max((free - gap * (count - 1)) // count, 1), aspect)
    w, h = max(row, column)
    # from one image to the next
    x, y = (w + gap, 0) if (w, h) == row else (0, h + gap)
    left = max((width - w - (count - 1) * x) // 2, 0)
    top = 0 if height > width else max((height - h - (count - 1) * y) // 2, 0)
    corners = tuple((left + i * x, top + i * y) for i in range(count))
    return Layout(canvas=(width, height), size=(w, h), corners=corners)


def compose(pictures: Sequence[Pixels], layout: Layout) -> Pixels:
    """One image (H, W, 3) of the whole canvas from the images on it, (h, w, 3)
    each.
    """
    width, height = layout.canvas
    page = np.empty((height, width, 3), np.uint8)
    page[:] = MARGIN
    for picture, (left, top) in zip(pictures, layout.corners, strict=True):
        h = min(picture.shape[0], height - top)
        w = min(picture.shape[1], width - left)
        page[top : top + h, left : left + w] = picture[:h, :w]
    return page


def difference(before: Pixels, after: Pixels) -> Pixels:
    """The largest change of a channel of each pixel as grey, white from half of the
    range.
    """
    change = np.abs(after.astype(np.int16) - before.astype(np.int16)).max(
        axis=-1, keepdims=True
    )
    grey: Pixels = np.minimum(2 * change, 255).repeat(3, axis=-1).astype(np.uint8)
    return grey


def _fit(width: int, height: int, aspect: float) -> tuple[int, int]:
    """The largest image of this shape that fits."""
    if width / height > aspect:
        return max(1, round(height * aspect)), height
    return width, max(1, round(width / aspect))


REST = 0.1  # seconds without a change after which the camera is at rest
LOWEST_SCALE = 0.2  # smallest width of a coarse image, as a fraction of the full one
HALF = 0.5  # width of the image between a coarse one and the full one


class Step(Enum):
    """An image that is due."""

    COARSE = "coarse"
    HALF = "half"
    FULL = "full"
    INSPECTED = "inspected"


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewState:
    """What a window shows: `mode` is one of `mi_splat.viewer.session.display_modes`,
    `canvas` its size in pixels.
    """

    orbit: Orbit
    mode: str
    inspected: bool = True
    canvas: tuple[int, int] = (640, 480)
    revision: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """How coarse images are while the camera moves: the seconds for one, and its
    width as a fraction of the full.
    """

    seconds: float = 0.07
    scale: float = 0.5

    def after(self, seconds: float) -> Pace:
        """The pace after a coarse image that took `seconds`."""
        ratio = self.seconds / max(seconds, 1e-6)
        if 0.8 <= ratio <= 1.25:
            return self
        step = min(max(math.sqrt(ratio), 1 / 1.5), 1.5)
        return replace(self, scale=min(max(self.scale * step, LOWEST_SCALE), 1.0))

    def size(self, full: tuple[int, int], step: Step) -> tuple[int, int]:
        """Width and height of the image of a step where the full one has `full`
        pixels.
        """
        scale = {Step.COARSE: self.scale, Step.HALF: HALF}.get(step, 1.0)
        width, height = (max(1, round(scale * side)) for side in full)
        return width, height


@dataclass(frozen=True, slots=True, kw_only=True)
class Session:
    """The state of a window, when it changed last (seconds of any clock), and the last
    step that was painted since.
    """

    state: ViewState
    changed: float
    pace: Pace = field(default_factory=Pace)
    painted: Step | None = None

    def change(self, state: ViewState, now: float) -> Session:
        """The session with another state; itself if the state is the same."""
        if state == self.state:
            return self
        return replace(self, state=state, changed=now, painted=None)

    def due(self, now: float, *, inspector: bool) -> Step | None:
        """The image to make now, None if there is none yet."""
        if self.painted is None:
            return Step.COARSE
        if self.painted is Step.COARSE:
            following = Step.HALF if self.pace.scale < HALF else Step.FULL
            if now - self.changed >= REST:
                return following
            return None
        if self.painted is Step.HALF:
            return Step.FULL
        if self.painted is Step.FULL and inspector and self.state.inspected:
            return Step.INSPECTED
        return None

    def done(self, step: Step, of: ViewState, seconds: float) -> Session:
        """The session after an image of a state was sent."""
        pace = self.pace.after(seconds) if step is Step.COARSE else self.pace
        return replace(
            self, pace=pace, painted=step if of is self.state else self.painted
        )
