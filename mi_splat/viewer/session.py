"""What a browser window shows and which picture is due next, without a browser and without a clock.

While the camera moves, coarse pictures are rendered with as many pixels as the time for one allows. When it rests, a
full picture follows, and then one with the detections.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum

from mi_splat.viewer.orbit import Orbit

REST = 0.2
"""Seconds without a change after which the camera is at rest."""
LOWEST_SCALE = 0.2
"""Smallest width of a coarse picture, as a fraction of the full one."""


class Step(Enum):
    """A picture that is due."""

    COARSE = "coarse"
    FULL = "full"
    INSPECTED = "inspected"


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewState:
    """What a window shows: `mode` is one of `mi_splat.viewer.layout.display_modes`, `canvas` its size in pixels.

    `revision` counts changes of the splats themselves.
    """

    orbit: Orbit
    mode: str
    inspected: bool = True
    canvas: tuple[int, int] = (640, 480)
    revision: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """How coarse pictures are while the camera moves: the seconds for one, and its width as a fraction of the full."""

    seconds: float = 0.07
    scale: float = 0.5

    def after(self, seconds: float) -> Pace:
        """The pace after a coarse picture that took `seconds`.

        Time is assumed to grow with the number of pixels. Within a quarter of the target nothing changes, and the width
        changes by at most 1.5 times at once, so that pictures do not pulse.
        """
        ratio = self.seconds / max(seconds, 1e-6)
        if 0.8 <= ratio <= 1.25:
            return self
        step = min(max(math.sqrt(ratio), 1 / 1.5), 1.5)
        return replace(self, scale=min(max(self.scale * step, LOWEST_SCALE), 1.0))

    def size(self, full: tuple[int, int]) -> tuple[int, int]:
        """Width and height of a coarse picture where the full one has `full` pixels."""
        width, height = (max(1, round(self.scale * side)) for side in full)
        return width, height


@dataclass(frozen=True, slots=True, kw_only=True)
class Session:
    """The state of a window, when it changed last (seconds of any clock), and the last step that was painted since."""

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
        """The picture to make now, None if there is none yet."""
        if self.painted is None:
            return Step.COARSE
        if self.painted is Step.COARSE:
            return Step.FULL if now - self.changed >= REST else None
        if self.painted is Step.FULL and inspector and self.state.inspected:
            return Step.INSPECTED
        return None

    def done(self, step: Step, of: ViewState, seconds: float) -> Session:
        """The session after a picture of a state was sent."""
        pace = self.pace.after(seconds) if step is Step.COARSE else self.pace
        return replace(self, pace=pace, painted=step if of is self.state else self.painted)
