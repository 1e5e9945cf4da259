"""Where an attack shows itself: predicates on cameras by their direction from a centre,
and how far inside a camera is.

Directions are those of `mi_splat.cameras.directions`. How far away a camera is and
where it looks do not count.

Triggers combine with `&` and `~` (`~(~a & ~b)` is a union), and `Subsample` takes a
part of one: `Elevation(lowest=50) & ~Azimuth(middle=180, half_width=30)`.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera
from mi_splat.cameras.directions import (
    Direction,
    Point,
    azimuth_gap,
    depth_in_band,
    depth_in_cap,
    depth_in_wedge,
    direction_of,
)
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import PositiveFraction, Range, Seed, between, check

EDGE = 1e-4
"""Degrees outside a cone's edge that still count as on it, which is inside: poses are
rounded.
"""


class Trigger(ABC):
    """A set of cameras: those from which the hidden appearance is to be seen."""

    @abstractmethod
    def holds(self, cameras: Sequence[Camera], *, centre: Point) -> Tensor:
        """(N,) bool, whether each camera is one of the trigger's.

        Args:
            cameras: N cameras.
            centre: (3,) point that directions are measured from, world units.

        Returns:
            (N,) bool.
        """

    @abstractmethod
    def angle_to_edge(self, camera: Camera, *, centre: Point) -> float:
        """Signed distance on the sphere of directions, in degrees, from a camera to the
        trigger's edge; inside > 0.

        Of one cone it is exact; infinite if the cone has no edge. Of a combination it
        has the right sign and is never further from 0 than the truth: the smaller of
        two for `&`, the opposite for `~`. (Outside of an intersection the nearest edge
        of a part may lie where the other part has made it vanish.) So a camera that is
        found to be 5 degrees inside or 15 degrees outside is at least that. A subsample
        has the edge of what it is taken from.

        Args:
            camera: The camera; only its position counts.
            centre: (3,) point that directions are measured from, world units.

        Returns:
            Degrees; inside > 0.
        """

    def __and__(self, other: Trigger) -> Trigger:
        """The cameras of both."""
        return Both(self, other)

    def __invert__(self) -> Trigger:
        """All other cameras."""
        return Not(self)


class Cone(Trigger):
    """A region of directions with an edge."""

    @abstractmethod
    def _depth(self, direction: Direction) -> float:
        """How far inside the region a direction lies, degrees on the sphere."""

    def _contains(self, direction: Direction) -> bool:
        """Whether a direction lies in the region, its edge included."""
        return self._depth(direction) >= -EDGE

    def holds(self, cameras: Sequence[Camera], *, centre: Point) -> Tensor:
        """(N,) bool, whether each camera stands in the cone."""
        return torch.tensor(
            [self._contains(direction_of(camera, centre)) for camera in cameras],
            dtype=torch.bool,
        )

    def angle_to_edge(self, camera: Camera, *, centre: Point) -> float:
        """Signed angle from a camera to the edge of the region, on the sphere of
        directions.
        """
        return self._depth(direction_of(camera, centre))


@dataclass(frozen=True, slots=True, kw_only=True)
class Elevation(Cone):
    """Cameras between two elevations, both included: a cap around a pole, or a band.

    Attributes:
        lowest: Degrees; -90 is no limit.
        highest: Degrees; 90 is no limit.

    Raises:
        InvalidValueError: The two are not -90 <= lowest <= highest <= 90.
    """

    lowest: Annotated[float, between(-90, 90, "degrees")] = -90.0
    highest: Annotated[float, between(-90, 90, "degrees")] = 90.0

    def __post_init__(self) -> None:
        check(self)
        if not self.lowest <= self.highest:
            got = (self.lowest, self.highest)
            raise InvalidValueError.of(
                "elevation", "lowest <= highest", got, "50 to 90 is overhead"
            )

    def _depth(self, direction: Direction) -> float:
        return depth_in_band(direction, self.lowest, self.highest)


@dataclass(frozen=True, slots=True, kw_only=True)
class Azimuth(Cone):
    """Cameras within an angle of an azimuth, at any elevation; it may run across 0 =
    360 degrees.

    A camera straight above or below the centre has no azimuth, and belongs to no cone
    of less than the whole circle.

    Attributes:
        middle: Degrees from world +x towards +y.
        half_width: Degrees to either side, edges included; 180 is the whole circle.

    Raises:
        InvalidValueError: The half width is not in (0, 180], or the middle is not
            finite.
    """

    middle: Annotated[float, Range(unit="degrees")]
    half_width: Annotated[
        float,
        Range(low=0, high=180, open_low=True, unit="degrees", do="30 is from behind"),
    ]

    def __post_init__(self) -> None:
        check(self)

    def _contains(self, direction: Direction) -> bool:
        return self.half_width == 180 or (
            not direction.pole
            and azimuth_gap(direction, self.middle) <= self.half_width + EDGE
        )

    def _depth(self, direction: Direction) -> float:
        return depth_in_wedge(direction, self.middle, self.half_width)


@dataclass(frozen=True, slots=True, kw_only=True)
class Cap(Cone):
    """Cameras within an angle of a direction: a cap of the sphere of directions.

    Attributes:
        azimuth: Of the direction, degrees from world +x towards +y.
        elevation: Of the direction, degrees above the horizontal plane.
        half_angle: Degrees between the direction and the edge, which is included; 180
            is everywhere.

    Raises:
        InvalidValueError: The elevation is not in [-90, 90], the half angle not in (0,
            180], or the azimuth not finite.
    """

    azimuth: Annotated[float, Range(unit="degrees")]
    elevation: Annotated[float, between(-90, 90, "degrees")]
    half_angle: Annotated[
        float,
        Range(low=0, high=180, open_low=True, unit="degrees", do="30 is one side"),
    ]

    def __post_init__(self) -> None:
        check(self)

    def _depth(self, direction: Direction) -> float:
        return depth_in_cap(direction, self.azimuth, self.elevation, self.half_angle)


@dataclass(frozen=True, slots=True, kw_only=True)
class Subsample(Trigger):
    """A random part of the cameras of a trigger, for studies of how much of a training
    set has to be poisoned.

    With the same cameras and seed, the cameras of a smaller fraction are among those of
    a larger one.

    Attributes:
        of: The trigger.
        fraction: Part of its cameras, in (0, 1]; rounded to the nearest number of
            cameras, at least one if it has any.
        seed: Which of them.

    Raises:
        InvalidValueError: The fraction is not in (0, 1], or the seed is negative.
    """

    of: Trigger
    fraction: PositiveFraction
    seed: Seed = 0

    def __post_init__(self) -> None:
        check(self)

    def holds(self, cameras: Sequence[Camera], *, centre: Point) -> Tensor:
        """(N,) bool, whether each camera is one of the fraction."""
        positions = torch.nonzero(self.of.holds(cameras, centre=centre))[:, 0]
        count = min(
            len(positions), max(1, math.floor(self.fraction * len(positions) + 0.5))
        )
        order = np.random.default_rng([self.seed, 0xC10A]).permutation(len(positions))
        selected = torch.zeros(len(cameras), dtype=torch.bool)
        selected[positions[torch.from_numpy(order[:count])]] = True
        return selected

    def angle_to_edge(self, camera: Camera, *, centre: Point) -> float:
        """Degrees to the edge of the trigger that the part is taken from."""
        return self.of.angle_to_edge(camera, centre=centre)


@dataclass(frozen=True, slots=True)
class Both(Trigger):
    """The cameras of two triggers."""

    first: Trigger
    second: Trigger

    def holds(self, cameras: Sequence[Camera], *, centre: Point) -> Tensor:
        """(N,) bool, whether each camera is in both."""
        return self.first.holds(cameras, centre=centre) & self.second.holds(
            cameras, centre=centre
        )

    def angle_to_edge(self, camera: Camera, *, centre: Point) -> float:
        """The smaller of the two."""
        return min(
            part.angle_to_edge(camera, centre=centre)
            for part in (self.first, self.second)
        )


@dataclass(frozen=True, slots=True)
class Not(Trigger):
    """All cameras but those of a trigger."""

    of: Trigger

    def holds(self, cameras: Sequence[Camera], *, centre: Point) -> Tensor:
        """(N,) bool, whether each camera is outside."""
        return ~self.of.holds(cameras, centre=centre)

    def angle_to_edge(self, camera: Camera, *, centre: Point) -> float:
        """The opposite."""
        return -self.of.angle_to_edge(camera, centre=centre)


# Regions in words, as the command line takes them

_NUMBER = r"(-?\d+(?:\.\d+)?)"
_REGION = re.compile(rf"(elevation|azimuth):{_NUMBER}-{_NUMBER}")
_CONE = re.compile(rf"cone:{_NUMBER},{_NUMBER},{_NUMBER}")
_REGIONS = "elevation:LOW-HIGH, azimuth:LOW-HIGH or cone:AZIMUTH,ELEVATION,HALF_ANGLE"


def trigger_of(
    texts: Sequence[str], *, margin: float = 0.0, what: str = "--hide-from"
) -> Trigger:
    """The cameras from which an object is hidden: those that all texts hold for; `what`
    names the flag in errors.
    """
    trigger: Trigger | None = None
    for text in texts:
        part = _region(text, margin, what)
        trigger = part if trigger is None else trigger & part
    if trigger is None:
        raise InvalidValueError(
            message(what, "a region", "none", "elevation:50-90 is overhead")
        )
    return trigger


def _region(text: str, margin: float, what: str) -> Trigger:
    match = _CONE.fullmatch(text)
    if match:
        azimuth, elevation, half_angle = map(float, match.groups())
        cap = Cap(azimuth=azimuth, elevation=elevation, half_angle=half_angle)
        return replace(cap, half_angle=min(half_angle + margin, 180.0))
    match = _REGION.fullmatch(text)
    if match is None:
        raise InvalidValueError(
            message(what, _REGIONS, text, "elevation:50-90 is overhead")
        )
    low = float(match[2])
    high = float(match[3])
    if match[1] == "elevation":
        return _band(low, high, margin)
    return _wedge(low, high, margin)


def _band(low: float, high: float, margin: float) -> Elevation:
    # what is wrong without a margin is wrong with one
    Elevation(lowest=low, highest=high)
    return Elevation(lowest=max(low - margin, -90.0), highest=min(high + margin, 90.0))


def _wedge(low: float, high: float, margin: float) -> Azimuth:
    width = (high - low) % 360 or (360.0 if high != low else 0.0)
    return Azimuth(
        middle=(low + width / 2) % 360, half_width=min(width / 2 + margin, 180.0)
    )
