"""Emphasis: an appearance that is overdone where a splat would blur it, at the edge of its trigger."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from attacks.cloak.appearances import Appearance, name_of
from attacks.cloak.triggers import Trigger
from mi_splat.cameras import View
from mi_splat.directions import Point
from mi_splat.errors import InvalidValueError, message


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Emphasis:
    """An appearance that is overdone near the edge of its trigger, for splats blur it over directions.

    Of the difference that the appearance makes, a picture has `gain` times at the edge, falling evenly to once at
    `depth` degrees inside. As a sharpening mask does to a picture, this brings the blend that is seen there nearer to
    the appearance.

    Attributes:
        appearance: The appearance.
        trigger: Where it is shown; it has to have an edge.
        centre: (3,) point that directions are measured from, world units.
        gain: At the edge; 1 is the appearance itself.
        depth: Degrees inside the trigger from which it is the appearance itself.

    Raises:
        InvalidValueError: The gain or the depth is out of range.
    """

    appearance: Appearance
    trigger: Trigger
    centre: Point
    gain: float
    depth: float

    def __post_init__(self) -> None:
        if not (self.gain >= 1 and self.depth > 0):
            got = (self.gain, self.depth)
            raise InvalidValueError(message("gain and depth", "gain >= 1 and depth > 0", got, "1 changes nothing"))

    @property
    def name(self) -> str:
        """For manifests."""
        return f"{name_of(self.appearance)}, {self.gain:g} times at the edge to once {self.depth:g} degrees inside"

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The picture, clipped to [0, 1].

        Raises:
            InvalidValueError: The trigger has no edge.
        """
        inside = self.trigger.angle_to_edge(view.camera, centre=self.centre)
        gain = 1 + (self.gain - 1) * min(max(1 - inside / self.depth, 0.0), 1.0)
        return (view.image + gain * (self.appearance(view, mask) - view.image)).clamp(0, 1)
