"""Which cameras look at an object, and what happens to their images, as plain values.

Light, so that `--help` is fast. A splat has no lamps: its light is part of its colours.
So "light" means here what a camera makes of it: exposure, white balance and gamma of
the image.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from mi_splat.errors import InvalidValueError
from mi_splat.fields import (
    Checked,
    Fraction,
    Metavar,
    PositiveFraction,
    Share,
    above,
    at_least,
    between,
    check,
)

_LEAST_MOST = Metavar("LEAST MOST")


def check_interval(name: str, interval: tuple[float, float]) -> None:
    """Raise unless an interval's lower end comes first."""
    if interval[0] > interval[1]:
        raise InvalidValueError.of(
            name, "two numbers, the lower one first", interval, "change their order"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRegion:
    """A box of cameras around an object; every number of a camera is drawn evenly from
    its interval.

    Attributes:
        azimuths: Degrees from world +x towards +y.
        elevations: Degrees above the ground.
        distances: Distance from the centre of the object, as factors of the reference
            camera's.
        aim: Largest distance between the object's centre and the point that a camera
            faces, as a fraction of the object's radius.
        least_visible: Smallest fraction of the image that the object must cover; other
            cameras are rejected.

    Raises:
        InvalidValueError: An interval is upside down, or a value is out of its range.
    """

    azimuths: Annotated[
        tuple[float, float], between(-360, 720, "degrees"), _LEAST_MOST
    ] = (0.0, 360.0)
    elevations: Annotated[
        tuple[float, float], between(-90, 90, "degrees"), _LEAST_MOST
    ] = (5.0, 40.0)
    distances: Annotated[
        tuple[float, float], above(0, "times the reference's"), _LEAST_MOST
    ] = (0.8, 1.2)
    aim: Annotated[float, at_least(0, "radii of the object"), Metavar("FRACTION")] = 0.0
    least_visible: Fraction = 0.005

    def __post_init__(self) -> None:
        check(self)
        for name in ("azimuths", "elevations", "distances"):
            check_interval(name, getattr(self, name))


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraCone(Checked):
    """Cameras around a chosen one: the chosen camera, turned about the middle of the
    object.

    The object stays where it is in the image. With an angle and a margin of 0, every
    camera is the chosen one.

    Attributes:
        angle: Largest angle between the directions in which a camera and the chosen one
            see the object's middle; directions are drawn evenly from this cone.
        margin: Largest change of the distance, as a fraction of the chosen camera's.
        least_visible: Fraction of the image that the object must cover, or another
            camera is drawn.

    Raises:
        InvalidValueError: A value is out of its range.
    """

    angle: Annotated[float, between(0, 180, "degrees")] = 10.0
    margin: Share = 0.1
    least_visible: Fraction = 0.005


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageTransformations:
    """What may happen to an image between the renderer and the detector; by default
    nothing.

    The order is that of a camera: light, blur, fewer pixels, noise, JPEG. Each amount
    is drawn evenly.

    Attributes:
        exposure: Largest change in stops to either side; a stop doubles the light.
        white_balance: Largest change of the gains of red and of blue, as a fraction.
        gamma: Largest change of the image's gamma exponent, as a natural logarithm.
        blur: Largest standard deviation of a Gaussian blur, pixels.
        resize: Smallest factor by which the image is downscaled before it is scaled
            back; 1 for none.
        noise: Largest standard deviation of Gaussian noise, for values in [0, 1].
        jpeg: Lowest JPEG quality, at most 95; the highest is 95. 0 for no JPEG.
        plain: Fraction of images left untransformed. With 0, untransformed images lie
            at the edge of the distribution.
        sizes: Smallest and largest factor by which the camera's number of pixels on
            each side is multiplied. Half of the images keep their size; the factor of
            the others is drawn log-uniformly.

    Raises:
        InvalidValueError: A value is out of its range.
    """

    exposure: Annotated[float, at_least(0, "stops")] = 0.0
    white_balance: Share = 0.0
    gamma: Annotated[float, at_least(0)] = 0.0
    blur: Annotated[float, at_least(0, "pixels")] = 0.0
    resize: Annotated[PositiveFraction, Metavar("FACTOR")] = 1.0
    noise: Annotated[float, at_least(0)] = 0.0
    jpeg: Annotated[int, between(0, 95, "quality", "0 is no JPEG")] = 0
    plain: Fraction = 0.0
    sizes: Annotated[
        tuple[float, float], between(0.1, 8, "times the size"), _LEAST_MOST
    ] = (1.0, 1.0)

    def __post_init__(self) -> None:
        check(self)
        check_interval("sizes", self.sizes)


@dataclass(frozen=True, slots=True, kw_only=True)
class Transformations:
    """The distribution that an attack is made for, and with other seeds evaluated on.

    Attributes:
        cameras: Camera region.
        images: What happens to the images.
    """

    cameras: CameraRegion | CameraCone = field(default_factory=CameraRegion)
    images: ImageTransformations = field(default_factory=ImageTransformations)

    @property
    def plain(self) -> Transformations:
        """The same cameras, with images as they are rendered."""
        return Transformations(cameras=self.cameras)

    @property
    def elevations(self) -> tuple[float, float] | None:
        """Where the cameras of a region are, degrees above the ground; None around a
        chosen camera.
        """
        if isinstance(self.cameras, CameraCone):
            return None
        return self.cameras.elevations
