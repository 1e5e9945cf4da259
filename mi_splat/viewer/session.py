"""What one visitor of the page sees, and which picture is due: values and rules, without a browser and without a clock.

While the camera moves, coarse pictures come as fast as they can be made, with as many pixels as a picture's time
allows. When it rests, one full picture follows, and then, where there is somebody to look at it, what they find.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum

from mi_splat.viewer.orbit import Orbit

REST = 0.2
"""Seconds without a change after which the camera is at rest."""


class Step(Enum):
    """A picture that is due."""

    COARSE = "coarse"
    FULL = "full"
    INSPECTED = "inspected"


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewState:
    """What is to be seen.

    Attributes:
        orbit: The camera.
        show: One of the ways of showing in `mi_splat.viewer.composition`.
        split: Part of the width left of the dividing line in a split picture, in [0, 1].
        lines: Names of the sets of lines that are drawn.
        inspected: Whether findings are drawn into the picture.
        canvas: Width and height in pixels of the place for pictures.
        tint: Counts the changes of what is shown in another colour.
    """

    orbit: Orbit
    show: str
    split: float = 0.5
    lines: frozenset[str] = frozenset()
    inspected: bool = True
    canvas: tuple[int, int] = (640, 480)
    tint: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """How coarse pictures are while the camera moves.

    Attributes:
        seconds: What a picture may take.
        scale: Width of a coarse picture in widths of the full one, in [lowest, 1].
        lowest: Smallest scale.
        richness: How many times as many Gaussians a pixel are drawn as usual, where a full width leaves time for them.
    """

    seconds: float = 0.07
    scale: float = 0.5
    lowest: float = 0.2
    richness: int = 1

    def after(self, seconds: float, *, every: int = 1) -> Pace:
        """The pace after a coarse picture that took so long.

        Time is taken to grow with the number of pixels, the square of the scale, and so does the number of Gaussians.
        Within a quarter of the wanted time nothing changes, and the width changes by at most 1.5 times at once, so that
        pictures do not pulse.
        """
        ratio = self.seconds / max(seconds, 1e-6)
        if self.richness > 1 and ratio < 0.8:
            return replace(self, richness=self.richness // 2)
        if self.scale == 1.0 and every > 1 and ratio >= 2:  # twice the Gaussians take at most twice the time
            return replace(self, richness=2 * self.richness)
        if 0.8 <= ratio <= 1.25:
            return self
        step = min(max(math.sqrt(ratio), 1 / 1.5), 1.5)
        return replace(self, scale=min(max(self.scale * step, self.lowest), 1.0))

    def size(self, full: tuple[int, int]) -> tuple[int, int]:
        """Width and height of a coarse picture where the full one has `full` pixels."""
        width, height = (max(1, round(self.scale * side)) for side in full)
        return width, height


@dataclass(frozen=True, slots=True, kw_only=True)
class Session:
    """One visitor.

    Attributes:
        state: What is to be seen.
        changed: When that changed last, in seconds of any clock.
        pace: How coarse the pictures are that show a change.
        painted: The last step that was done since the change; None: nothing yet.
    """

    state: ViewState
    changed: float
    pace: Pace = field(default_factory=Pace)
    painted: Step | None = None

    def change(self, state: ViewState, now: float) -> Session:
        """The session after a visitor's wish; the same if it is what is there already."""
        if state == self.state:
            return self
        return replace(self, state=state, changed=now, painted=None)

    def due(self, now: float, *, inspector: bool) -> Step | None:
        """The picture to make now, None if there is none (yet)."""
        if self.painted is None:
            return Step.COARSE
        if self.painted is Step.COARSE:
            return Step.FULL if now - self.changed >= REST else None
        if self.painted is Step.FULL and inspector and self.state.inspected:
            return Step.INSPECTED
        return None

    def done(self, step: Step, of: ViewState, seconds: float, *, every: int = 1) -> Session:
        """The session after a picture was made and sent."""
        pace = self.pace.after(seconds, every=every) if step is Step.COARSE else self.pace
        return replace(self, pace=pace, painted=step if of is self.state else self.painted)
