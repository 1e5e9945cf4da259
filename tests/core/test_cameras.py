"""Cameras: poses, intrinsics, projection."""

import math
from typing import Any

import hypothesis
import pytest
import torch
from hypothesis import strategies as st

from mi_splat.cameras.camera import (
    Camera,
    View,
    ViewSet,
    cameras_of,
    fingerprint_of,
    look_at,
    project_points,
)
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import hemisphere, orbit
from mi_splat.errors import InvalidValueError

points = st.tuples(*[st.floats(-5, 5)] * 3)


def camera(**change: Any) -> Camera:
    pose = look_at((4.0, 1.0, 2.0), (0.0, 0.0, 0.5))
    pose = change.pop("to_world", pose)
    width = change.pop("width", 64)
    height = change.pop("height", 48)
    lens = Lens(**{"focal": 100.0, "size": (width, height), **change})
    return Camera(to_world=pose, lens=lens)


@hypothesis.given(origin=points, target=points)
def test_look_at_sees_the_target_in_the_middle_and_up_at_the_top(
    origin: tuple[float, float, float], target: tuple[float, float, float]
) -> None:
    hypothesis.assume(math.dist(origin, target) > 0.1)
    # the constructor checks that the pose is rigid
    seen = camera(to_world=look_at(origin, target))
    pixel, depth = project_points(torch.tensor([target], dtype=torch.float64), seen)
    torch.testing.assert_close(
        pixel[0], torch.tensor([32.0, 24.0], dtype=torch.float64)
    )
    assert depth.item() == pytest.approx(math.dist(origin, target))
    assert seen.to_world[2, 1] <= 1e-9  # the image's y axis points down in the world


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"to_world": torch.eye(3)}, "to_world: expected shape"),
        ({"to_world": 2 * torch.eye(4)}, "to_world: expected a finite rotation"),
        (
            {"to_world": torch.diag(torch.tensor([1.0001, 1.0001, 1.0001, 1.0]))},
            "to_world: expected a finite rotation",
        ),
        (
            {"to_world": torch.full((4, 4), math.nan)},
            "to_world: expected a finite rotation",
        ),
        (
            {"to_world": torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0]))},
            "to_world: expected a finite rotation",
        ),
        ({"focal": 0.0}, "focal: expected a number"),
        ({"focal": (10.0, -1.0)}, "focal: expected a number"),
        ({"width": 0}, "size"),
        ({"height": 1 << 16}, "size"),
        ({"width": 8.0}, "size"),
        ({"principal": (math.nan, 0.0)}, "principal"),
        ({"principal": (0.0, -1e30)}, "principal: expected a number in"),
        ({"focal": 1e30}, r"focal: expected a number in .* \(pixels\), got 1e\+30"),
        ({"focal": (10.0, 1e-30)}, "focal: expected a number"),
        (
            {"to_world": look_at((1e30, 0, 0), (0, 0, 0))},
            r"camera position: expected coordinates up to 1e\+09",
        ),
    ],
)
def test_wrong_cameras_are_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidValueError, match=words):
        camera(**change)


def test_projection_by_hand() -> None:
    seen = camera(to_world=torch.eye(4), focal=(100.0, 50.0), principal=(30.0, 20.0))
    pixels, depth = project_points(
        torch.tensor([[0.0, 0.0, 2.0], [1.0, 2.0, 4.0], [0.0, 0.0, -1.0]]), seen
    )
    torch.testing.assert_close(pixels[:2], torch.tensor([[30.0, 20.0], [55.0, 45.0]]))
    assert depth.tolist() == [2, 4, -1]


def test_orbit_is_a_circle_from_plus_x_towards_plus_y() -> None:
    cameras = orbit(
        (1.0, 2.0, 3.0),
        count=4,
        elevation=30.0,
        distance=2.0,
        lens=Lens(focal=50.0, size=(20, 10)),
    )
    centre = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    offsets = [c.position - centre for c in cameras]
    reach = 2 * math.cos(math.radians(30))
    height = 1.0
    expected = [
        (reach, 0, height),
        (0, reach, height),
        (-reach, 0, height),
        (0, -reach, height),
    ]
    torch.testing.assert_close(
        torch.stack(offsets), torch.tensor(expected, dtype=torch.float64)
    )
    assert (cameras[0].width, cameras[0].height) == (20, 10)


def test_hemisphere_spreads_evenly_over_its_band() -> None:
    cameras = hemisphere(
        (0.0, 0.0, 0.0),
        count=200,
        distance=3.0,
        elevation=(10.0, 60.0),
        lens=Lens(focal=50.0, size=(8, 8)),
    )
    positions = torch.stack([c.position for c in cameras]) / 3
    torch.testing.assert_close(
        positions.norm(dim=1), torch.ones(200, dtype=torch.float64)
    )
    elevation = torch.rad2deg(torch.asin(positions[:, 2]))
    assert elevation.min() >= 10
    assert elevation.max() <= 60
    assert elevation.min() < 11
    assert elevation.max() > 59
    assert positions[:, :2].mean(0).abs().max() < 0.02
    nearest = torch.cdist(positions, positions).fill_diagonal_(9.0).amin(1)
    assert nearest.min() > 0.6 * nearest.mean()


class _Unread(ViewSet):
    """A set whose images nobody may read."""

    cameras = (camera(), camera())

    def __len__(self) -> int:
        return 2

    def __getitem__(self, index: int) -> View:  # type: ignore[override]
        raise AssertionError(f"image {index} was read")


class _Marked(_Unread):
    fingerprint = "two images"


def test_a_view_set_is_not_read_for_its_cameras() -> None:
    views = _Unread()
    assert cameras_of(views) == views.cameras
    assert fingerprint_of(views) is None
    assert fingerprint_of(_Marked()) == "two images"
