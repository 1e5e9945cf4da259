"""Directions of cameras and their depths in bands and wedges, against a brute-force
search over the sphere.
"""

import math

import hypothesis
import pytest
import torch
from hypothesis import strategies as st

from mi_splat.cameras.camera import Camera, orbit_pose
from mi_splat.cameras.directions import Direction, direction_of, sun_direction
from mi_splat.cameras.lens import Lens
from mi_splat.errors import InvalidValueError

CENTRE = (1.0, -2.0, 0.5)


def seen_from(azimuth: float, elevation: float, distance: float = 3.0) -> Direction:
    pose = orbit_pose(CENTRE, azimuth=azimuth, elevation=elevation, distance=distance)
    return direction_of(
        Camera(to_world=pose, lens=Lens(focal=10.0, size=(4, 4))), CENTRE
    )


def unit(azimuth: float, elevation: float) -> torch.Tensor:
    a = math.radians(azimuth)
    e = math.radians(elevation)
    return torch.tensor(
        [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)],
        dtype=torch.float64,
    )


@hypothesis.given(
    azimuth=st.floats(0, 359),
    elevation=st.floats(-89, 89),
    distance=st.floats(0.01, 100),
)
def test_the_direction_of_an_orbit_camera(
    azimuth: float, elevation: float, distance: float
) -> None:
    direction = seen_from(azimuth, elevation, distance)
    assert direction.azimuth == pytest.approx(azimuth, abs=1e-6)
    assert direction.elevation == pytest.approx(elevation, abs=1e-6)
    assert not direction.pole


# Where the sun stands: closed forms at the equinoxes and at midsummer


def test_the_sun_rises_in_the_east_and_stands_in_the_south_at_noon() -> None:
    assert sun_direction(12, latitude=30) == pytest.approx((0, -0.5, math.sqrt(0.75)))
    assert sun_direction(9, latitude=45) == pytest.approx((math.sqrt(0.5), -0.5, 0.5))
    assert sun_direction(17.99, latitude=45) == pytest.approx((-1, 0, 0), abs=0.01)
    with pytest.raises(InvalidValueError, match="when the sun is up"):
        sun_direction(22.5, latitude=45)
