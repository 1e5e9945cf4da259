"""Orbits: the camera of sliders and mouse is the one that `mi-splat render` takes, and
none gets lost on the way.
"""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mi_splat.cameras.camera import Camera, orbit_pose
from mi_splat.cameras.directions import Point
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import hemisphere
from mi_splat.cli.cameras import find_cameras
from mi_splat.cli.options import CameraOptions
from mi_splat.errors import InvalidValueError
from mi_splat.render.renderer import RenderSettings
from mi_splat.render.scene_files import SplatScene
from mi_splat.viewer.orbit import Orbit, focus_of, orbit_of
from tests.gaussians import random_scene

ANGLE = st.floats(0, 359.99)
LENGTH = st.floats(0.1, 50)
ELEVATION = st.floats(-90, 90)
BARE = SplatScene(
    scene=random_scene(5), objects={}, cameras={}, settings=RenderSettings()
)


def orbit(
    azimuth: float = 30.0, elevation: float = 20.0, distance: float = 5.0
) -> Orbit:
    return Orbit(
        target=(1.0, 2.0, 0.5),
        azimuth=azimuth,
        elevation=elevation,
        distance=distance,
        fov=50.0,
    )


@given(ANGLE, ELEVATION, LENGTH)
def test_the_camera_is_that_of_render(
    azimuth: float, elevation: float, distance: float
) -> None:
    ours = orbit(azimuth, elevation, distance).camera((64, 48))
    options = CameraOptions(
        azimuth=azimuth,
        elevation=elevation,
        distance=distance,
        fov=50.0,
        centre=(1.0, 2.0, 0.5),
        size=(64, 48),
    )
    (theirs,) = find_cameras(BARE, options).values()
    assert torch.equal(ours.to_world, theirs.to_world)
    assert (ours.fx, ours.fy) == (theirs.fx, theirs.fy)


@given(ANGLE, ELEVATION, LENGTH)
def test_a_camera_s_orbit_gives_the_camera_back(
    azimuth: float, elevation: float, distance: float
) -> None:
    camera = orbit(azimuth, elevation, distance).camera((64, 48))
    recovered = orbit_of(camera, (1.0, 2.0, 0.5))
    assert torch.allclose(
        recovered.changed().camera((64, 48)).to_world,
        camera.to_world,
        atol=1e-6 * distance,
    )
    assert recovered.fov == pytest.approx(50.0)


@given(ANGLE, st.floats(-89.9, 89.9), LENGTH)
def test_a_pose_from_the_browser_is_followed_in_short_numbers(
    azimuth: float, elevation: float, distance: float
) -> None:
    there = orbit(azimuth, elevation, distance)
    moved = orbit(200.0, -5.0, 3.0).moved(there.position, there.target)
    assert moved.is_at(there.position, there.target)
    assert moved.target == there.target  # it was not moved, and so was not rounded
    assert moved.azimuth == round(moved.azimuth, 2)
    assert moved.distance == float(f"{moved.distance:.5g}")


@pytest.mark.parametrize(
    ("position", "look_at", "changes"),
    [
        # straight above: the azimuth is kept
        ((1.0, 2.0, 4.5), (1.0, 2.0, 0.5), {"elevation": 90.0, "distance": 4.0}),
        (
            (5.0, 5.0, 5.0),
            (4.00004, 1.0, 5.0),
            {"target": (4.0, 1.0, 5.0), "azimuth": 75.96, "elevation": 0.0},
        ),
        ((1.0, 2.0, 0.5), (1.0, 2.0, 0.5), {}),  # no camera
        ((math.nan, 0.0, 0.0), (1.0, 2.0, 0.5), {}),
        ((math.inf, 0.0, 0.0), (1.0, 2.0, 0.5), {}),
    ],
)
def test_a_pose_of_the_mouse(
    position: Point, look_at: Point, changes: dict[str, Any]
) -> None:
    moved = orbit().moved(position, look_at)
    assert replace(moved, distance=5.0) == replace(
        orbit(), **{**changes, "distance": 5.0}
    )
    assert "distance" not in changes or moved.distance == changes["distance"]


@pytest.mark.parametrize(
    "wrong",
    [
        {"elevation": 91.0},
        {"distance": 0.0},
        {"fov": 180.0},
        {"azimuth": math.nan},
        {"roll": 181.0},
    ],
)
def test_wrong_numbers_are_refused(wrong: dict[str, float]) -> None:
    numbers: dict[str, Any] = {
        "azimuth": 0.0,
        "elevation": 0.0,
        "distance": 1.0,
        "fov": 45.0,
        **wrong,
    }
    with pytest.raises(InvalidValueError, match="orbit: expected"):
        Orbit(target=(0, 0, 0), **numbers)


@given(ANGLE, ELEVATION, st.floats(-180, 180))
def test_a_camera_of_a_file_is_kept_to_the_bit_and_its_roll_when_it_moves(
    azimuth: float, elevation: float, roll: float
) -> None:
    pose = orbit_pose(
        (1.0, 2.0, 0.5), azimuth=azimuth, elevation=elevation, distance=5.0, roll=roll
    )
    camera = Camera(
        to_world=pose, lens=Lens(focal=(50, 60), size=(64, 48), principal=(20, 30))
    )
    orbit = orbit_of(camera, (1.0, 2.0, 0.5))
    assert orbit.camera((64, 48)) is camera
    assert orbit.camera((128, 96)).lens.principal == (40, 60)
    plain = orbit.changed().camera((64, 48))
    assert torch.allclose(plain.to_world, pose, atol=2e-4)
    assert plain.fx == pytest.approx(50)
    assert plain.lens.principal is None
    moved = orbit.moved((9.0, 2.0, 0.5), (1.0, 2.0, 0.5))
    assert (moved.exact, moved.roll, moved.distance) == (None, orbit.roll, 8.0)


def test_the_focus_is_what_all_cameras_look_at() -> None:
    cameras = hemisphere(
        (1.0, -2.0, 0.7), count=12, distance=5, lens=Lens(focal=50, size=(64, 64))
    )
    assert focus_of(cameras, (0, 0, 0)) == pytest.approx((1.0, -2.0, 0.7))
    assert focus_of(cameras[:1], (3, 3, 3)) == (3, 3, 3)
    assert focus_of([], (3, 3, 3)) == (3, 3, 3)
