"""Cameras of a region: every number in its interval, drawn by seed, nothing else
changed.
"""

import dataclasses
import io
import math
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from attacks.transformations.config import CameraRegion, ImageTransformations
from attacks.transformations.draws import (
    ImageTransformation,
    draw_camera,
    draw_change,
    transform_image,
)
from mi_splat.cameras.camera import Camera, look_at, project_points
from mi_splat.cameras.directions import direction_of
from mi_splat.cameras.lens import Lens
from mi_splat.errors import InvalidValueError

CENTRE = (1.0, -2.0, 0.5)
REFERENCE = Camera(
    to_world=look_at((4.0, -2.0, 0.5), CENTRE),
    lens=Lens(focal=(50.0, 60.0), size=(64, 48)),
)


def draws(region: CameraRegion, count: int = 50, *, seed: int = 0) -> list[Camera]:
    return [
        draw_camera(
            region,
            np.random.default_rng((seed, index)),
            centre=CENTRE,
            radius=0.5,
            reference=REFERENCE,
        )
        for index in range(count)
    ]


def distance(camera: Camera) -> float:
    return math.dist(camera.position.tolist(), CENTRE)


def test_every_number_is_in_its_interval_and_fills_it() -> None:
    region = CameraRegion(azimuths=(20, 80), elevations=(10, 30), distances=(0.5, 2.0))
    directions = [direction_of(camera, CENTRE) for camera in draws(region)]
    for name, (low, high) in (("azimuth", (20, 80)), ("elevation", (10, 30))):
        values = [getattr(direction, name) for direction in directions]
        assert low <= min(values) < low + 0.2 * (high - low)
        assert high - 0.2 * (high - low) < max(values) <= high
    lengths = [distance(camera) for camera in draws(region)]
    assert 1.5 <= min(lengths) < 2.4  # the reference stands 3 away
    assert 5.1 < max(lengths) <= 6.0


def test_cameras_look_at_the_centre_with_the_reference_s_lens_and_without_roll() -> (
    None
):
    for camera in draws(CameraRegion(), 5):
        pixels, _ = project_points(torch.tensor([CENTRE], dtype=torch.float64), camera)
        assert pixels[0].tolist() == pytest.approx([camera.cx, camera.cy])
        assert (camera.fx, camera.fy, camera.width, camera.height) == (
            50.0,
            60.0,
            64,
            48,
        )
        # the image's rows are level
        assert float(camera.to_world[2, 0]) == pytest.approx(0.0, abs=1e-9)


def test_aim_moves_the_point_looked_at_within_the_ball() -> None:
    moved = [
        (after.position - before.position).norm().item()
        for before, after in zip(
            draws(CameraRegion()), draws(CameraRegion(aim=0.4)), strict=True
        )
    ]
    assert 0.1 < max(moved) <= 0.4 * 0.5 + 1e-9


@pytest.mark.parametrize(
    ("configuration", "settings"),
    [
        (CameraRegion, {"azimuths": (10, 5)}),
        (CameraRegion, {"elevations": (0, 91)}),
        (CameraRegion, {"distances": (0, 1)}),
        (CameraRegion, {"aim": -1}),
        (ImageTransformations, {"jpeg": 96}),
        (ImageTransformations, {"resize": 0.0}),
    ],
)
def test_settings_that_make_no_sense_are_refused(
    configuration: Any, settings: dict[str, Any]
) -> None:
    (name,) = settings
    with pytest.raises(InvalidValueError, match=f"^{name}: expected"):
        configuration(**settings)


def test_a_reference_in_the_middle_of_the_object_is_refused() -> None:
    inside = dataclasses.replace(REFERENCE, to_world=look_at(CENTRE, (5, 5, 5)))
    with pytest.raises(InvalidValueError, match="reference"):
        draw_camera(
            CameraRegion(),
            np.random.default_rng(0),
            centre=CENTRE,
            radius=1.0,
            reference=inside,
        )


# Changes of images: each against what it means, derivatives, and draws by seed


CHANGES = ImageTransformations(
    exposure=1.0, white_balance=0.2, gamma=0.3, blur=2.0, resize=0.5, noise=0.1, jpeg=30
)


def picture(*, dtype: torch.dtype = torch.float32) -> Tensor:
    generator = torch.Generator().manual_seed(3)
    return 0.1 + 0.8 * torch.rand(12, 16, 3, generator=generator, dtype=dtype)


def test_no_change_is_the_same_bits() -> None:
    assert torch.equal(transform_image(picture(), ImageTransformation()), picture())
    drawn = draw_change(ImageTransformations(), np.random.default_rng(1))
    assert drawn == ImageTransformation(noise_seed=drawn.noise_seed)


def test_a_stop_doubles_the_light() -> None:
    grey = torch.full((2, 2, 3), 0.2)
    after = transform_image(grey, ImageTransformation(gains=(2.0, 2.0, 2.0)))
    # sRGB 0.2 is 0.033105 in linear light, and twice as much light is sRGB 0.28538.
    assert after.flatten().tolist() == pytest.approx([0.28538] * 12, abs=1e-4)


def test_white_balance_and_gamma() -> None:
    after = transform_image(picture(), ImageTransformation(gains=(1.1, 1.0, 0.9)))
    assert bool(
        (after[..., 0] > picture()[..., 0]).all()
        and (after[..., 2] < picture()[..., 2]).all()
    )
    torch.testing.assert_close(after[..., 1], picture()[..., 1], atol=1e-5, rtol=0)
    torch.testing.assert_close(
        transform_image(picture(), ImageTransformation(gamma=2.0)), picture() ** 2
    )


def test_blur_spreads_a_point_as_a_gaussian() -> None:
    point = torch.zeros(31, 31, 3)
    point[15, 15] = 1.0
    after = transform_image(point, ImageTransformation(blur=2.0))[..., 0].double()
    positions = torch.arange(31, dtype=torch.float64) - 15
    assert float(after.sum()) == pytest.approx(1.0, abs=1e-5)
    assert float((after.sum(0) * positions**2).sum()) == pytest.approx(4.0, rel=0.05)


def test_resizing_keeps_the_size_and_loses_detail() -> None:
    after = transform_image(picture(), ImageTransformation(resize=0.25))
    assert after.shape == picture().shape
    assert float(after.var()) < 0.5 * float(picture().var())
    flat = torch.full((12, 16, 3), 0.3)
    torch.testing.assert_close(
        transform_image(flat, ImageTransformation(resize=0.25)), flat
    )


def test_noise_has_its_size_and_is_the_seed_s() -> None:
    grey = torch.full((64, 64, 3), 0.5)
    first, again, other = (
        transform_image(grey, ImageTransformation(noise=0.1, noise_seed=seed))
        for seed in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert float((first - grey).std()) == pytest.approx(0.1, rel=0.05)


def test_jpeg_is_the_real_one_and_passes_the_gradient() -> None:
    leaf = picture().requires_grad_(True)
    after = transform_image(leaf, ImageTransformation(jpeg=40))
    buffer = io.BytesIO()
    Image.fromarray((picture() * 255).round().to(torch.uint8).numpy()).save(
        buffer, format="JPEG", quality=40
    )
    expected = np.asarray(Image.open(buffer).convert("RGB"), dtype=np.float32) / 255
    assert torch.equal(after.detach(), torch.from_numpy(expected))
    assert not torch.equal(after.detach(), picture())
    (gradient,) = torch.autograd.grad((after * torch.arange(3.0)).sum(), [leaf])
    assert torch.equal(gradient, torch.arange(3.0).expand_as(gradient))


@pytest.mark.parametrize(
    "change",
    [
        {"gains": (1.2, 1.1, 0.9)},
        {"gamma": 1.3},
        {"blur": 1.0},
        {"resize": 0.6},
        {"noise": 0.02},
    ],
    ids=lambda change: next(iter(change)),
)
def test_derivatives_are_those_of_finite_differences(change: dict[str, Any]) -> None:
    leaf = picture(dtype=torch.float64)[:5, :6].clone().requires_grad_(True)
    assert torch.autograd.gradcheck(
        lambda x: transform_image(x, ImageTransformation(**change)), (leaf,), atol=1e-6
    )


def test_draws_are_in_their_intervals_and_pure() -> None:
    drawn = [
        draw_change(CHANGES, np.random.default_rng((7, index))) for index in range(200)
    ]
    assert drawn == [
        draw_change(CHANGES, np.random.default_rng((7, index))) for index in range(200)
    ]
    for name, low, high in (
        ("blur", 0, 2),
        ("resize", 0.5, 1),
        ("noise", 0, 0.1),
        ("jpeg", 30, 95),
    ):
        values = [getattr(change, name) for change in drawn]
        assert low <= min(values) < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < max(values) <= high
    light = [change.gains[1] for change in drawn]
    assert 0.5 <= min(light) < 0.6
    assert 1.8 < max(light) <= 2.0
    assert len({change.noise_seed for change in drawn}) == 200
