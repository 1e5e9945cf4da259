"""Which cameras look at an object, and what happens to their pictures, as plain values.

Light, so that `--help` is fast. A splat has no lamps: its light is part of its colours. So "light" means here what a
camera makes of it: exposure, white balance and gamma of the picture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from mi_splat.config_values import check_numbers, finite_number
from mi_splat.errors import InvalidValueError, message


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRegion:
    """A box of cameras around an object; every number of a camera is drawn evenly from its interval.

    Attributes:
        azimuths: Degrees from world +x towards +y.
        elevations: Degrees above the ground.
        distances: Distance from the middle of the object, as factors of `distance_unit`.
        distance_unit: World units; None is the distance of the reference camera.
        roll: Largest turn of the picture to either side, degrees.
        fovs: Horizontal field of view, degrees; None keeps that of the reference camera.
        aim: Largest distance from the object's middle to the point looked at, as a fraction of the object's radius.
        least_visible: Fraction of the picture that the object must cover, or another camera is drawn.

    Raises:
        InvalidValueError: An interval is upside down, or a value is out of its range.
    """

    azimuths: tuple[float, float] = (0.0, 360.0)
    elevations: tuple[float, float] = (5.0, 40.0)
    distances: tuple[float, float] = (0.8, 1.2)
    distance_unit: float | None = None
    roll: float = 0.0
    fovs: tuple[float, float] | None = None
    aim: float = 0.0
    least_visible: float = 0.005

    def __post_init__(self) -> None:
        check_numbers(self, {"roll": 0, "aim": 0, "least_visible": 0})
        for name in ("azimuths", "elevations", "distances", "fovs"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, _interval(name, value))
        _within("elevations", self.elevations, -90, 90)
        _within("distances", self.distances, 1e-6, math.inf)
        if self.fovs is not None:
            _within("fovs", self.fovs, 1e-3, 179)
        if self.distance_unit is not None and not self.distance_unit > 0:
            raise InvalidValueError(message("distance_unit", "a number > 0", self.distance_unit, "1 is world units"))


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureChanges:
    """What may happen to a picture between the renderer and the detector; by default nothing.

    The order is that of a camera: light, blur, fewer pixels, noise, JPEG. Each amount is drawn evenly.

    Attributes:
        exposure: Largest change in stops to either side; a stop doubles the light.
        white_balance: Largest change of the gains of red and of blue, as a fraction.
        gamma: Largest change of the picture's exponent, as a natural logarithm.
        blur: Largest standard deviation of a Gaussian blur, pixels.
        resize: Smallest factor by which the picture is made smaller before it gets its size back; 1 for none.
        noise: Largest standard deviation of Gaussian noise; the picture's values lie in [0, 1].
        jpeg: Lowest JPEG quality, at most 95; the highest is 95. 0 for no JPEG.

    Raises:
        InvalidValueError: A value is out of its range.
    """

    exposure: float = 0.0
    white_balance: float = 0.0
    gamma: float = 0.0
    blur: float = 0.0
    resize: float = 1.0
    noise: float = 0.0
    jpeg: int = 0

    def __post_init__(self) -> None:
        check_numbers(self, {"exposure": 0, "white_balance": 0, "gamma": 0, "blur": 0, "noise": 0, "jpeg": 0})
        if not self.white_balance < 1:
            raise InvalidValueError(message("white_balance", "a fraction < 1", self.white_balance, "0.1 is much"))
        if not 0 < self.resize <= 1:
            raise InvalidValueError(message("resize", "a factor in (0, 1]", self.resize, "1 is no change"))
        if self.jpeg > 95:
            raise InvalidValueError(message("jpeg", "a quality in 0..95", self.jpeg, "0 is no JPEG"))

    @property
    def are_none(self) -> bool:
        """Whether pictures stay as they are."""
        return self == PictureChanges()


@dataclass(frozen=True, slots=True, kw_only=True)
class Transformations:
    """The distribution that an attack is made for, and with other seeds judged on.

    Attributes:
        cameras: Where the object is looked at from.
        pictures: What happens to the pictures.
    """

    cameras: CameraRegion = field(default_factory=CameraRegion)
    pictures: PictureChanges = field(default_factory=PictureChanges)


def _interval(name: str, value: Any) -> tuple[float, float]:
    """Two finite numbers, the lower one first."""
    expected = "two numbers, the lower one first"
    try:
        low, high = (float(finite_number(name, number)) for number in value)
    except (TypeError, ValueError):
        raise InvalidValueError(message(name, expected, repr(value), "pass for instance (5, 40)")) from None
    if low > high:
        raise InvalidValueError(message(name, expected, (low, high), "change their order"))
    return low, high


def _within(name: str, value: tuple[float, float], low: float, high: float) -> None:
    if not low <= value[0] <= value[1] <= high:
        raise InvalidValueError(message(name, f"numbers in [{low:g}, {high:g}]", value, "change them"))
