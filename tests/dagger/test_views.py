"""Views of a distribution: pure functions of seed and number, the object in all of them."""

from __future__ import annotations

from collections import Counter

import pytest
import torch

from attacks.dagger.views import ViewDistribution, batch_indices, fixed_views
from attacks.gaussian_subset import GaussianSubset
from attacks.observe.views import visible_box
from attacks.transformations.config import CameraRegion, PictureChanges, Transformations
from mi_splat.errors import InvalidValueError
from mi_splat.rotation import from_z
from mi_splat.scene import Similarity
from tests.dagger.toy import REGION, toy_views
from tests.fakes import blobs, camera, toy_scene


def test_a_view_depends_on_seed_and_number_alone() -> None:
    changes = PictureChanges(blur=1.0, noise=0.1)
    forwards, backwards = toy_views(changes), toy_views(changes)
    first = [forwards.view(3, index) for index in range(4)]
    second = [backwards.view(3, index) for index in reversed(range(4))][::-1]
    for a, b in zip(first, second, strict=True):
        assert torch.equal(a.camera.to_world, b.camera.to_world)
        assert a.change == b.change
        assert torch.equal(a.box, b.box)
    other = forwards.view(4, 0)
    assert not torch.allclose(other.camera.to_world, first[0].camera.to_world)


def test_views_are_kept_unless_told_otherwise() -> None:
    views = toy_views()
    assert views.view(0, 1) is views.view(0, 1)
    assert views.view(0, 2, keep=False) is not views.view(0, 2, keep=False)


def test_the_object_shows_in_every_view() -> None:
    for view in toy_views().views(0, 10):
        found = visible_box(view.weight)
        assert found is not None
        assert torch.equal(found, view.box)
        assert REGION.elevations[0] <= view.direction.elevation <= REGION.elevations[1]


def test_regions_have_the_up_that_is_said() -> None:
    """With y down, elevations are above the ground across y; a world that is turned alike has the same views."""
    scene, mask = toy_scene()
    turn = from_z(torch.tensor([0.0, -1.0, 0.0]))
    turned = scene.transform(Similarity(rotation=turn, translation=torch.zeros(3), scale=1.0))
    around = Transformations(cameras=REGION)
    level = ViewDistribution(scene, mask, camera(), around, render=blobs).views(0, 3)
    other = ViewDistribution(turned, mask, camera().turned(turn), around, render=blobs, up=(0.0, -1.0, 0.0))
    assert torch.allclose(other.views(0, 3)[2].camera.to_world, level[2].camera.turned(turn).to_world, atol=1e-4)
    fixed = fixed_views(GaussianSubset.of(turned, mask), [camera().turned(turn)], render=blobs, up=(0.0, -1.0, 0.0))
    for view, expected in zip(
        [*other.views(0, 3), *fixed],
        [*level, *fixed_views(GaussianSubset.of(scene, mask), [camera()], render=blobs)],
        strict=True,
    ):
        assert view.direction.azimuth == pytest.approx(expected.direction.azimuth, abs=1e-3)
        assert view.direction.elevation == pytest.approx(expected.direction.elevation, abs=1e-3)


def test_views_in_which_little_shows_are_drawn_again_and_counted() -> None:
    near_and_far = CameraRegion(azimuths=(-90, -90), elevations=(0, 0), distances=(1, 20), least_visible=0.01)
    found = toy_views(region=near_and_far).views(0, 10)
    assert sum(view.redraws for view in found) > 5
    assert all(float((view.weight >= 0.5).float().mean()) >= 0.01 for view in found)


def test_a_region_that_never_shows_the_object_is_refused() -> None:
    away = CameraRegion(distances=(1000, 1000))
    with pytest.raises(InvalidValueError, match="region of the cameras"):
        toy_views(region=away).view(0, 0)


@pytest.mark.parametrize("pool", [1, 5, 8])
def test_each_view_of_a_pool_comes_once_before_one_comes_again(pool: int) -> None:
    drawn = [number for step in range(2 * pool) for number in batch_indices(step, seed=1, batch=3, pool=pool)]
    assert all(Counter(drawn[turn * pool : (turn + 1) * pool]) == Counter(range(pool)) for turn in range(6))
    assert drawn[:3] == batch_indices(0, seed=1, batch=3, pool=pool)


def test_without_a_pool_every_view_is_new() -> None:
    drawn = [number for step in range(5) for number in batch_indices(step, seed=1, batch=3, pool=0)]
    assert drawn == list(range(15))
