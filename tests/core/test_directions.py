"""Directions of cameras and their depths in bands and wedges, against a brute-force search over the sphere."""

import math

import hypothesis
import pytest
import torch
from hypothesis import strategies as st

from mi_splat.cameras import Camera, orbit_pose
from mi_splat.directions import Direction, azimuth_gap, depth_in_wedge, direction_of, sun_direction
from mi_splat.errors import InvalidValueError

CENTRE = (1.0, -2.0, 0.5)


def seen_from(azimuth: float, elevation: float, distance: float = 3.0) -> Direction:
    pose = orbit_pose(CENTRE, azimuth=azimuth, elevation=elevation, distance=distance)
    return direction_of(Camera(to_world=pose, focal=10.0, width=4, height=4), CENTRE)


def unit(azimuth: float, elevation: float) -> torch.Tensor:
    a, e = math.radians(azimuth), math.radians(elevation)
    return torch.tensor([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)], dtype=torch.float64)


def nearest_on(points: torch.Tensor, direction: Direction) -> float:
    """Degrees on the sphere to the nearest of (P, 3) unit vectors."""
    chord = (points - unit(direction.azimuth, direction.elevation)).norm(dim=1).min()
    return math.degrees(2 * math.asin(float(chord) / 2))


@hypothesis.given(azimuth=st.floats(0, 359), elevation=st.floats(-89, 89), distance=st.floats(0.01, 100))
def test_the_direction_of_an_orbit_camera(azimuth: float, elevation: float, distance: float) -> None:
    direction = seen_from(azimuth, elevation, distance)
    assert direction.azimuth == pytest.approx(azimuth, abs=1e-6)
    assert direction.elevation == pytest.approx(elevation, abs=1e-6)
    assert not direction.pole


@hypothesis.given(
    azimuth=st.floats(0, 359), elevation=st.floats(-85, 85), middle=st.floats(0, 359), half=st.floats(5, 175)
)
def test_depth_in_a_wedge_is_the_distance_to_the_nearest_point_of_its_edge(
    azimuth: float, elevation: float, middle: float, half: float
) -> None:
    direction = Direction(azimuth=azimuth, elevation=elevation, pole=False)
    edges = [unit(middle + side * half, -90 + 0.25 * i) for side in (-1, 1) for i in range(721)]
    depth = depth_in_wedge(direction, middle, half)
    assert abs(depth) == pytest.approx(nearest_on(torch.stack(edges), direction), abs=0.15)
    if abs(depth) > 0.01:
        assert (depth > 0) == (azimuth_gap(direction, middle) < half)


# Where the sun stands: closed forms at the equinoxes and at midsummer


def test_the_sun_rises_in_the_east_and_stands_in_the_south_at_noon() -> None:
    assert sun_direction(12, latitude=30) == pytest.approx((0, -0.5, math.sqrt(0.75)))
    assert sun_direction(9, latitude=45) == pytest.approx((math.sqrt(0.5), -0.5, 0.5))
    assert sun_direction(17.99, latitude=45) == pytest.approx((-1, 0, 0), abs=0.01)
    with pytest.raises(InvalidValueError, match="when the sun is up"):
        sun_direction(22.5, latitude=45)
