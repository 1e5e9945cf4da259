"""How a splat can be looked at otherwise than as it was attacked: other files, fewer SH bands, a street in the sun."""

from __future__ import annotations

import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_splat.config_values import check_numbers, finite_number
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import SplatLossWarning, load_splat, save_splat
from mi_splat.mixed_scenes import SAMPLES, MixedScene
from mi_splat.scene import GaussianScene
from mi_splat.sun import clock, sun_direction

FORMATS = (".ply", ".compressed.ply", ".spz", ".sog", ".glb", ".splat")
"""Formats that a splat can go through."""


def through_file(scene: GaussianScene, suffix: str) -> GaussianScene:
    """The splat after it was saved in a format and loaded again.

    Args:
        scene: The splat.
        suffix: One of `FORMATS`.

    Raises:
        InvalidValueError: It is none of them.
    """
    if suffix not in FORMATS:
        raise InvalidValueError(message("format", f"one of {', '.join(FORMATS)}", suffix, "choose one"))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", SplatLossWarning)
        path = Path(folder) / f"splat{suffix}"
        save_splat(scene, path)
        return load_splat(path)


def half_precision(scene: GaussianScene) -> GaussianScene:
    """The splat with SH rounded to float16."""
    return scene.replace(sh=scene.sh.half().to(scene.sh))


def fewer_bands(scene: GaussianScene, degree: int) -> GaussianScene:
    """The splat with SH of at most this degree."""
    return scene.with_degree(min(degree, scene.degree))


@dataclass(frozen=True, slots=True, kw_only=True)
class SunTable:
    """A street of meshes at several hours of a day.

    Attributes:
        scene: XML scene of splats among meshes, with the parameters sun_x, sun_y and sun_z; north is +y.
        hours: Local solar time, 12 is noon.
        latitude: Of the place, degrees north.
        declination: Of the sun, degrees; 0 at the equinoxes.
        samples: Paths a pixel.

    Raises:
        InvalidValueError: There are no hours, two show the same minute, the sun is not up at one of them, or a number
            is out of its range.
    """

    scene: str
    hours: tuple[float, ...]
    latitude: float = 45.0
    declination: float = 0.0
    samples: int = SAMPLES

    def __post_init__(self) -> None:
        check_numbers(self, {"samples": 1})
        if not self.hours:
            raise InvalidValueError(message("hours", "at least one", "none", "name some, for instance [9.0, 12.0]"))
        for hour in self.hours:
            sun_direction(finite_number("hour", hour), latitude=self.latitude, declination=self.declination)
        shown = [clock(hour) for hour in self.hours]
        if len(set(shown)) < len(shown):
            raise InvalidValueError(message("hours", "different minutes", ", ".join(shown), "leave the second out"))


def street_at(sun: SunTable, hour: float, **parameters: Any) -> MixedScene:
    """The street at one hour.

    Args:
        sun: The street.
        hour: Local solar time.
        parameters: Others of the scene file, for instance `car="a.ply"`.

    Raises:
        InvalidValueError: The sun is not up.
        MiSplatError: The file cannot be read, or is no scene of splats among surfaces.
    """
    east, north, up = sun_direction(hour, latitude=sun.latitude, declination=sun.declination)
    return MixedScene(Path(sun.scene), samples=sun.samples, sun_x=east, sun_y=north, sun_z=up, **parameters)
