"""Settings of a capture as frozen values; light, so that the command line can ask for
them without Mitsuba.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from mi_splat.errors import InvalidValueError
from mi_splat.fields import Checked, Length, Metavar, above, between, check
from mi_splat.maths.orientation import Up

Ground = Literal["road", "grass", "asphalt", "none"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureSettings(Checked):
    """What the images of a capture depend on besides scene and cameras.

    Attributes:
        samples: Samples per pixel, 1 or more; more is less noise.
        seed: Seed of the noise; image i uses seed + i, and held-out images are numbered
            after the others.
        rgba: Write RGBA images with a transparent background instead of the sky.
        points: Number of points in the point cloud.
        near: Near plane: surfaces nearer to a camera than this are not rendered, world
            units. Default: 0.01.

    Raises:
        InvalidValueError: A number is out of range.
    """

    samples: Annotated[int, between(1, 1 << 20, "samples per pixel", "32 is usual")] = (
        32
    )
    seed: Annotated[int, between(0, 1 << 28, do="0 is usual"), Metavar("SEED")] = 0
    rgba: bool = False
    points: Annotated[int, between(1, 10_000_000, "points")] = 20_000
    near: Length | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshSettings(Checked):
    """How a mesh file is read.

    Attributes:
        up: Up axis of the file. Default: y.
        scale: Metres per unit of the file; 0.01 for centimetres.

    Raises:
        InvalidValueError: A number is out of range.
    """

    up: Up | None = None
    scale: Annotated[
        float, above(0, "metres per unit of the file"), Metavar("METRES")
    ] = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SurroundingsSettings:
    """What is around a mesh file, or around an object of the project.

    Attributes:
        ground: Texture of the square ground plane, as in the CLOAK studies; none for no
            ground. Asphalt does not repeat, so use it if cameras are to be estimated
            from the images.
        sun: Sun direction as AZIMUTH,ELEVATION in degrees, for instance -50,52; azimuth
            from +x towards +y, elevation 0 to 90. Default: 40,45.

    Raises:
        InvalidValueError: The sun's place is no two angles.
    """

    ground: Ground = "none"
    sun: Annotated[str, Metavar("AZIMUTH,ELEVATION")] | None = None

    def __post_init__(self) -> None:
        check(self)
        _ = self.sun_angles

    @property
    def sun_angles(self) -> tuple[float, float] | None:
        """Azimuth and elevation of the sun in degrees; None if they are not given."""
        if self.sun is None:
            return None
        try:
            azimuth, elevation = (float(word) for word in self.sun.split(","))
        except ValueError:
            azimuth = elevation = math.nan
        if not (math.isfinite(azimuth) and 0 <= elevation <= 90):
            expected = "azimuth,elevation in degrees, with an elevation of 0 to 90"
            raise InvalidValueError.of(
                "sun", expected, repr(self.sun), "write for instance -50,52"
            )
        return azimuth, elevation
