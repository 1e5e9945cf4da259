"""Which cameras have a frozen view, and views of one scene that keep it once."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from mi_splat.cameras import Camera, orbit_pose
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.frozen_view import FrozenView
from mi_splat.rendering import Renderer, RenderSettings, ScreenGradients
from mi_splat.view_freezing import MIN_PICTURES, freeze_views
from tests import oracle


def cameras(count: int = 3) -> list[Camera]:
    poses = [orbit_pose((0.0, 0.0, 0.0), azimuth=50.0 * k, elevation=20.0, distance=3.0) for k in range(count)]
    return [Camera(to_world=pose, focal=24.0, width=24 + 4 * k, height=21) for k, pose in enumerate(poses)]


def test_a_view_from_another_camera_is_a_view_of_its_own() -> None:
    scene, rows = oracle.random_scene(80, degree=2, seed=2), torch.arange(5, 40)
    settings = RenderSettings(background=(0.2, 0.3, 0.4), alpha=True)
    one, two, _ = cameras()
    first = FrozenView(scene, one, settings=settings, rows=rows)
    own, beside = FrozenView(scene, two, settings=settings, rows=rows), first.at(two)
    sh = scene.sh[rows] + 0.2
    picture = first(sh)
    assert torch.equal(beside(sh), own(sh))
    assert torch.equal(first(sh), picture)  # the first one still sees what it saw
    assert beside.camera is two
    assert first.camera is one
    assert own.nbytes - beside.nbytes == 4 * (11 * 80 + 27 * 45)  # geometry and the others' colours
    with pytest.raises(MiSplatError, match="max_bytes"):
        first.at(two, max_bytes=beside.nbytes - 1)
    with pytest.raises(InvalidValueError, match="camera: expected"):
        first.at([two])  # type: ignore[arg-type]


@pytest.mark.parametrize("rows", [None, torch.arange(20)])
def test_each_camera_has_a_view_whose_pictures_are_the_renderers(rows: torch.Tensor | None) -> None:
    scene, render = oracle.random_scene(60, degree=1, seed=1), Renderer(RenderSettings(background=(0.1, 0.2, 0.3)))
    where = cameras()
    found = freeze_views(scene, [*where, where[0]], render=render, pictures=MIN_PICTURES, rows=rows)
    assert list(found) == where
    for camera, view in found.items():
        torch.testing.assert_close(view(scene.sh[view.rows]), render(scene, camera), rtol=0, atol=1e-5)


def test_views_that_do_not_fit_are_left_to_the_renderer() -> None:
    scene, where = oracle.random_scene(60, degree=1, seed=1), cameras()
    settings: dict[str, Any] = {"render": Renderer(), "pictures": 100}
    sizes = [view.nbytes for view in freeze_views(scene, where, **settings).values()]
    for count in range(4):
        assert list(freeze_views(scene, where, max_bytes=sum(sizes[:count]), **settings)) == where[:count]
    assert list(freeze_views(scene, where, max_bytes=sum(sizes) - 1, **settings)) == where[:2]


def test_there_are_none_where_they_do_not_pay_or_the_renderer_is_another() -> None:
    class Own(Renderer):
        """Who knows what it does."""

    scene, where, plain = oracle.random_scene(10, degree=0, seed=1), cameras(1), Renderer()
    assert freeze_views(scene, where, render=plain, pictures=MIN_PICTURES)
    assert not freeze_views(scene, where, render=plain, pictures=MIN_PICTURES - 1)
    for render in (
        lambda scene, camera: plain(scene, camera),
        Own(),
        Renderer(RenderSettings(method="ray")),
        Renderer(screen_gradients=ScreenGradients()),
    ):
        assert not freeze_views(scene, where, render=render, pictures=100)
