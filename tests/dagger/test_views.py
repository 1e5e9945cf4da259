"""Views of a distribution: pure functions of seed and number, the object in all of
them.
"""

import dataclasses
from collections import Counter

import pytest
import torch

from attacks.dagger.config import DaggerConfig
from attacks.dagger.search import ImagePrice, fitted, stretched
from attacks.dagger.views import DrawnViews, batch_indices, fixed_views
from attacks.gaussian_subset import GaussianSubset
from attacks.observe.views import visible_box
from attacks.search.budget import Budget
from attacks.transformations.config import (
    CameraRegion,
    ImageTransformations,
    Transformations,
)
from mi_splat.cameras.camera import look_at
from mi_splat.errors import InvalidValueError
from mi_splat.maths.rotation import from_z
from mi_splat.scene import Similarity
from tests.dagger.toy import REGION, quick, toy_views
from tests.fakes import blobs, camera, toy_scene


def test_a_view_depends_on_seed_and_number_alone() -> None:
    changes = ImageTransformations(blur=1.0, noise=0.1)
    forwards = toy_views(changes)
    backwards = toy_views(changes)
    first = [forwards.view(3, index) for index in range(4)]
    second = [backwards.view(3, index) for index in reversed(range(4))][::-1]
    for a, b in zip(first, second, strict=True):
        assert torch.equal(a.camera.to_world, b.camera.to_world)
        assert a.change == b.change
        assert torch.equal(a.box, b.box)
    other = forwards.view(4, 0)
    assert not torch.allclose(other.camera.to_world, first[0].camera.to_world)


def test_the_object_shows_in_every_view() -> None:
    for view in toy_views().views(0, 10):
        box = visible_box(view.weight)
        assert box is not None
        assert torch.equal(box, view.box)
        assert REGION.elevations[0] <= view.direction.elevation <= REGION.elevations[1]


def test_the_camera_that_misses_the_object_is_named() -> None:
    away = dataclasses.replace(
        camera(), to_world=look_at((50.0, -3.0, 0.0), (50.0, 0.0, 0.0))
    )
    with pytest.raises(
        InvalidValueError,
        match="camera 2 of 3: expected a view in which the object is visible",
    ):
        fixed_views(
            GaussianSubset.of(*toy_scene()), [camera(), away, camera()], render=blobs
        )


def test_regions_have_the_up_that_is_said() -> None:
    """With y down, elevations are above the ground across y; a world that is turned
    alike has the same views.
    """
    scene, mask = toy_scene()
    turn = from_z(torch.tensor([0.0, -1.0, 0.0]))
    turned = scene.transform(
        Similarity(rotation=turn, translation=torch.zeros(3), scale=1.0)
    )
    around = Transformations(cameras=REGION)
    level = DrawnViews(scene, mask, camera(), around, render=blobs).views(0, 3)
    other = DrawnViews(
        turned, mask, camera().turned(turn), around, render=blobs, up=(0.0, -1.0, 0.0)
    )
    assert torch.allclose(
        other.views(0, 3)[2].camera.to_world,
        level[2].camera.turned(turn).to_world,
        atol=1e-4,
    )
    fixed = fixed_views(
        GaussianSubset.of(turned, mask),
        [camera().turned(turn)],
        render=blobs,
        up=(0.0, -1.0, 0.0),
    )
    for view, expected in zip(
        [*other.views(0, 3), *fixed],
        [
            *level,
            *fixed_views(GaussianSubset.of(scene, mask), [camera()], render=blobs),
        ],
        strict=True,
    ):
        assert view.direction.azimuth == pytest.approx(
            expected.direction.azimuth, abs=1e-3
        )
        assert view.direction.elevation == pytest.approx(
            expected.direction.elevation, abs=1e-3
        )


def test_views_in_which_little_shows_are_drawn_again_and_counted() -> None:
    near_and_far = CameraRegion(
        azimuths=(-90, -90), elevations=(0, 0), distances=(1, 20), least_visible=0.01
    )
    views = toy_views(region=near_and_far).views(0, 10)
    assert sum(view.redraws for view in views) > 5
    assert all(float((view.weight >= 0.5).float().mean()) >= 0.01 for view in views)


def test_a_region_that_never_shows_the_object_is_refused() -> None:
    away = CameraRegion(distances=(1000, 1000))
    with pytest.raises(InvalidValueError, match="region of the cameras"):
        toy_views(region=away).view(0, 0)


@pytest.mark.parametrize("pool", [1, 5, 8])
def test_each_view_of_a_pool_comes_once_before_one_comes_again(pool: int) -> None:
    drawn = [
        number
        for step in range(2 * pool)
        for number in batch_indices(step, seed=1, batch=3, pool=pool)
    ]
    assert all(
        Counter(drawn[turn * pool : (turn + 1) * pool]) == Counter(range(pool))
        for turn in range(6)
    )
    assert drawn[:3] == batch_indices(0, seed=1, batch=3, pool=pool)


# The images of an attack keep the PSNR that was asked for, and the price of their
# error follows it


def test_the_price_rises_while_pictures_are_too_bad_and_falls_while_they_are_good() -> (
    None
):
    price = ImagePrice.of(DaggerConfig(image_psnr=20.0, steps=100))
    assert price is not None
    assert price.after(0.02).weight > price.weight > price.after(0.005).weight
    assert price.after(0.01).weight == pytest.approx(price.weight)


def test_a_point_is_pulled_back_to_the_limit_along_a_line() -> None:
    reference = {"sh": torch.ones(3)}
    point = {"sh": torch.tensor([2.0, 3.0, 5.0])}

    def error(one: dict[str, torch.Tensor]) -> float:
        return float((one["sh"] - reference["sh"]).square().sum())

    pulled = fitted(point, reference, 21 / 4, error)
    assert 0.97 * 21 / 4 <= error(pulled) <= 21 / 4
    way = (pulled["sh"] - 1) / (point["sh"] - 1)
    assert torch.allclose(way, way[0].expand(3))
    assert fitted(point, reference, 21.5, error) is point
    assert fitted(point, reference, 0.0, error) is reference


def test_a_point_is_stretched_to_the_limit_and_not_out_of_its_ball() -> None:
    reference = {"sh": torch.zeros(2)}
    point = {"sh": torch.tensor([1.0, 2.0])}

    def error(one: dict[str, torch.Tensor]) -> float:
        return float(one["sh"].square().sum())

    wide, narrow = (
        Budget(radius={"sh": radius}, norm="linf") for radius in (10.0, 2.2)
    )
    longer = stretched(point, reference, wide, 7.2, error)["sh"]
    assert float(longer[1] / longer[0]) == pytest.approx(2.0)
    assert 6.9 < float(longer.square().sum()) <= 7.2
    assert float(
        stretched(point, reference, narrow, 7.2, error)["sh"].abs().max()
    ) == pytest.approx(2.2)
    assert torch.allclose(
        stretched(point, reference, wide, 100.0, error)["sh"], 1.5 * point["sh"]
    )


def test_an_attack_keeps_the_psnr_that_an_attack_without_a_limit_does_not() -> None:
    free = quick()
    limited = quick(image_psnr=35.0)
    assert free.image.psnr is not None
    assert limited.image.psnr is not None
    assert free.image.psnr < 30
    # Held-out views are others than those that the limit is held on.
    assert limited.image.psnr > 34
    assert max(limited.used.values()) > 0


def test_a_result_that_is_below_its_budget_warns() -> None:
    result = quick(image_psnr=35.0)
    assert not any(
        "dB of the validation views" in warning for warning in result.warnings
    )
    assert result.drawn
    asked_for_more = dataclasses.replace(
        result, config=dataclasses.replace(result.config, image_psnr=45.0)
    )
    assert any(
        "less than the 45 dB of the validation views" in one
        for one in asked_for_more.warnings
    )
