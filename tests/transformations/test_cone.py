"""Cameras around a chosen one, images that stay as they are, and images of other
sizes.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from attacks.transformations.config import CameraCone, ImageTransformations
from attacks.transformations.draws import (
    ImageTransformation,
    draw_camera,
    draw_change,
    draw_size,
)
from mi_splat.cameras.camera import Camera, look_at, project_points
from mi_splat.cameras.lens import Lens
from mi_splat.errors import InvalidValueError

CENTRE = (1.0, -2.0, 0.5)
CHOSEN = Camera(
    to_world=look_at((3.5, -3.0, 2.0), (1.2, -2.0, 0.5), up=(0.1, 0.0, 1.0)),
    lens=Lens(focal=(50.0, 60.0), size=(64, 48)),
)
"""Looks beside the point that it is turned about, and is not level."""


def draws(cone: CameraCone, count: int = 300) -> list[Camera]:
    return [
        draw_camera(
            cone,
            np.random.default_rng(index),
            centre=CENTRE,
            radius=0.5,
            reference=CHOSEN,
        )
        for index in range(count)
    ]


def angle_to(camera: Camera) -> float:
    """Degrees between the directions of two cameras from the centre."""
    centre = torch.tensor(CENTRE, dtype=torch.float64)
    one, other = (
        torch.nn.functional.normalize(position - centre, dim=0)
        for position in (camera.position, CHOSEN.position)
    )
    return math.degrees(math.acos(min(1.0, float(one @ other))))


def distance(camera: Camera) -> float:
    return math.dist(camera.position.tolist(), CENTRE)


def test_cameras_fill_the_cone_evenly() -> None:
    angles = [angle_to(camera) for camera in draws(CameraCone(angle=20.0))]
    assert max(angles) <= 20.0 + 1e-6
    # half the area of a narrow cap lies beyond 0.71 of its radius
    beyond = sum(angle > 14.2 for angle in angles) / len(angles)
    assert 0.4 < beyond < 0.6


def test_distances_fill_their_margin() -> None:
    factors = [
        distance(camera) / distance(CHOSEN) for camera in draws(CameraCone(margin=0.2))
    ]
    assert 0.8 <= min(factors) < 0.82
    assert 1.18 < max(factors) <= 1.2


def test_the_object_stays_where_it_is_in_the_image() -> None:
    point = torch.tensor([CENTRE], dtype=torch.float64)
    before, _ = project_points(point, CHOSEN)
    for camera in draws(CameraCone(angle=30.0, margin=0.0), 20):
        after, _ = project_points(point, camera)
        assert torch.allclose(after, before, atol=1e-6)


def test_without_an_angle_and_a_margin_there_is_one_camera() -> None:
    for camera in draws(CameraCone(angle=0.0, margin=0.0), 5):
        assert torch.allclose(camera.to_world, CHOSEN.to_world, atol=1e-12)


@pytest.mark.parametrize("values", [{"angle": 181.0}, {"margin": 1.0}, {"angle": -1}])
def test_a_cone_is_checked(values: dict[str, float]) -> None:
    with pytest.raises(InvalidValueError):
        CameraCone(**values)


def test_a_share_of_the_images_stays_as_it_is() -> None:
    changes = ImageTransformations(jpeg=50, blur=1.0, plain=0.35)
    drawn = [draw_change(changes, np.random.default_rng(seed)) for seed in range(400)]
    plain = sum(change == ImageTransformation() for change in drawn) / len(drawn)
    assert 0.28 < plain < 0.42
    always = dataclasses.replace(changes, plain=1.0)
    assert draw_change(always, np.random.default_rng(0)) == ImageTransformation()


def test_half_of_the_images_get_another_size_and_show_the_same() -> None:
    changes = ImageTransformations(sizes=(0.5, 2.0))
    generators = [np.random.default_rng(seed) for seed in range(400)]
    cameras = [draw_size(changes, one, CHOSEN) for one in generators]
    widths = [camera.width for camera in cameras]
    same = sum(width == CHOSEN.width for width in widths) / len(widths)
    assert 0.43 < same < 0.6
    assert 32 <= min(widths) < 36
    assert 120 < max(widths) <= 128
    point = torch.tensor([CENTRE], dtype=torch.float64)
    share, _ = project_points(point, CHOSEN)
    for camera in cameras[:20]:
        here, _ = project_points(point, camera)
        assert float(here[0, 0]) / camera.width == pytest.approx(
            float(share[0, 0]) / CHOSEN.width, abs=0.01
        )
    with pytest.raises(InvalidValueError):
        ImageTransformations(sizes=(2.0, 0.5))


def test_sizes_and_plain_images_leave_other_draws_as_they_were() -> None:
    before = ImageTransformations(jpeg=50, blur=1.0)
    generator, other = np.random.default_rng(3), np.random.default_rng(3)
    assert draw_change(before, generator) == draw_change(before, other)
    assert draw_size(before, generator, CHOSEN) is CHOSEN
