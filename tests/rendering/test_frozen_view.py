"""FrozenView beside Renderer: images, gradients of SH, subsets of rows, determinism,
memory and bad input.
"""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera, orbit_pose
from mi_splat.cameras.lens import Lens
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.render.frozen_view import FrozenView
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.view_freezing import MIN_PICTURES, freeze_views
from mi_splat.scene import GaussianScene
from tests.gaussians import varied_scene

ERROR = 1e-5
BACKGROUND = (0.2, 0.5, 0.9)


def camera(width: int, height: int, *, distance: float = 3.0) -> Camera:
    pose = orbit_pose((0.0, 0.0, 0.0), azimuth=30.0, elevation=20.0, distance=distance)
    return Camera(
        to_world=pose, lens=Lens(focal=(1.0 * width, 0.9 * width), size=(width, height))
    )


def gradient(picture: Tensor, leaf: Tensor) -> Tensor:
    factors = torch.randn(picture.shape, generator=torch.Generator().manual_seed(3))
    (of_leaf,) = torch.autograd.grad((picture * factors).sum(), leaf)
    return of_leaf


def compare(view: FrozenView, scene: GaussianScene, sh: Tensor) -> None:
    """Image and gradient of a view with these SH of its rows are those of a
    Renderer.
    """
    every = scene.sh.clone()
    if every.shape[1] != sh.shape[1]:
        every = sh.clone()
    every[view.rows] = sh
    every.requires_grad_(True)
    leaf = sh.clone().requires_grad_(True)
    expected = Renderer(view.settings)(scene.replace(sh=every), view.camera)
    picture = view(leaf)
    assert picture.shape == expected.shape
    torch.testing.assert_close(picture, expected, rtol=0, atol=ERROR)
    wanted = gradient(expected, every)[view.rows]
    computed = gradient(picture, leaf)
    assert float((computed - wanted).abs().max()) <= ERROR * float(wanted.abs().max())


def other_colours(sh: Tensor, seed: int = 5) -> Tensor:
    return sh + 0.3 * torch.randn(
        sh.shape, generator=torch.Generator().manual_seed(seed)
    )


SETTINGS: dict[str, Any] = {
    "plain": {},
    "antialiased": {"antialiased": True},
    "alpha": {"alpha": True},
    "linear": {"linear": True, "alpha": True},
    "near": {"near": 2.9},
}


@pytest.mark.parametrize("name", SETTINGS)
def test_picture_and_gradient_are_the_renderers(name: str) -> None:
    scene = varied_scene(300, degree=2, seed=1)
    settings = RenderSettings(background=BACKGROUND, **SETTINGS[name])
    compare(
        FrozenView(scene, camera(50, 37), settings=settings),
        scene,
        other_colours(scene.sh),
    )


def test_stages_are_recorded_once_for_all_sizes() -> None:
    import mitsuba as mi

    from mi_splat.render.tile import colour_steps
    from mi_splat.render.tile.frozen import frozen

    frozen.cache_clear()
    for number in range(5):
        scene = varied_scene(100 + 37 * number, degree=1, seed=number)
        view = FrozenView(scene, camera(30 + 5 * number, 40 + number))
        for seed in range(2):
            compare(view, scene, other_colours(scene.sh, seed=seed))
    for stage in (colour_steps.colour_forward, colour_steps.colour_backward):
        assert frozen(mi.variant(), stage).n_recordings == 1  # type: ignore[attr-defined]


def test_a_dense_pile_keeps_what_is_not_hidden() -> None:
    scene = varied_scene(400, degree=0, seed=3)
    pile = scene.replace(means=scene.means * 0.2, opacities=torch.full((400,), 0.999))
    view = FrozenView(pile, camera(48, 48))
    compare(view, pile, other_colours(pile.sh))
    seen = FrozenView(pile.replace(opacities=torch.full((400,), 0.1)), camera(48, 48))
    assert view.nbytes < 0.8 * seen.nbytes


@pytest.mark.parametrize("kind", ["mask", "indices", "one", "slice"])
def test_rows_alone_are_free(kind: str) -> None:
    scene = varied_scene(500, degree=1, seed=4)
    where = camera(66, 51)
    mask = scene.means[:, 0] > scene.means[:, 0].quantile(0.8)
    kinds: dict[str, Tensor | slice] = {
        "mask": mask,
        "indices": mask.nonzero().flatten().flip(0) - 500,
        "one": torch.tensor([7]),
        "slice": slice(20, 120),
    }
    rows = kinds[kind]
    view = FrozenView(
        scene, where, settings=RenderSettings(background=BACKGROUND), rows=rows
    )
    assert len(view.rows) == (1 if kind == "one" else 100)
    compare(view, scene, other_colours(scene.sh[view.rows]))
    assert view.nbytes < FrozenView(scene, where).nbytes


def test_nothing_visible_and_no_rows() -> None:
    scene = varied_scene(30, degree=0, seed=0)
    where = camera(9, 5)
    settings = RenderSettings(background=BACKGROUND, alpha=True)
    away = scene.replace(means=scene.means + torch.tensor([1e4, 1e4, 0.0]))
    none = torch.zeros(30, dtype=torch.bool)
    cases: list[tuple[GaussianScene, Tensor | None]] = [
        (away, None),
        (scene.select(none), None),
        (scene, none),
    ]
    cases.append(
        (
            scene.replace(opacities=scene.opacities * (torch.arange(30) > 3)),
            torch.arange(4),
        )
    )
    for case, rows in cases:
        view = FrozenView(case, where, settings=settings, rows=rows)
        leaf = case.sh[view.rows].clone().requires_grad_(True)
        picture = view(leaf)
        torch.testing.assert_close(
            picture, Renderer(settings)(case, where), rtol=0, atol=ERROR
        )
        assert not gradient(picture, leaf).any()


def test_memory_is_bounded_before_it_is_taken() -> None:
    scene = varied_scene(300, degree=1, seed=1)
    where = camera(50, 37)
    view = FrozenView(scene, where)
    assert FrozenView(scene, where, max_bytes=view.nbytes).nbytes == view.nbytes
    assert view.megabytes == pytest.approx(view.nbytes / 1e6)
    with pytest.raises(
        MiSplatError,
        match=r"FrozenView: expected at most .* MB \(max_bytes\), got .* MB .*pairs",
    ):
        FrozenView(scene, where, max_bytes=view.nbytes - 1)


def test_bad_input() -> None:
    scene = varied_scene(10, degree=1, seed=1)
    where = camera(20, 18)
    view = FrozenView(scene, where)
    for sh in (scene.sh[:9], scene.sh[:, :, :2], scene.sh[:, :3], scene.means):
        with pytest.raises(InvalidValueError, match="sh: expected"):
            view(sh)
    for rows in (
        torch.tensor([1, 1]),
        torch.tensor([3, -7]),
        torch.tensor([10]),
        torch.ones(9, dtype=torch.bool),
    ):
        with pytest.raises(InvalidValueError, match="rows: expected"):
            FrozenView(scene, where, rows=rows)
    for arguments in (
        {"camera": [where]},
        {"settings": RenderSettings(method="ray")},
        {"rows": [1]},
        {"scene": None},
    ):
        given: dict[str, Any] = {"scene": scene, "camera": where} | arguments
        with pytest.raises(InvalidValueError, match="expected"):
            FrozenView(given.pop("scene"), given.pop("camera"), **given)
    with pytest.raises(InvalidValueError, match="sh: expected"):
        view(torch.full_like(scene.sh, math.nan))


# Views of several cameras


def cameras(count: int = 3) -> list[Camera]:
    poses = [
        orbit_pose((0.0, 0.0, 0.0), azimuth=50.0 * k, elevation=20.0, distance=3.0)
        for k in range(count)
    ]
    return [
        Camera(to_world=pose, lens=Lens(focal=24.0, size=(24 + 4 * k, 21)))
        for k, pose in enumerate(poses)
    ]


@pytest.mark.parametrize("rows", [None, torch.arange(20)])
def test_each_camera_has_a_view_whose_pictures_are_the_renderers(
    rows: torch.Tensor | None,
) -> None:
    scene = varied_scene(60, degree=1, seed=1)
    render = Renderer(RenderSettings(background=(0.1, 0.2, 0.3)))
    where = cameras()
    views = freeze_views(
        scene, [*where, where[0]], render=render, pictures=MIN_PICTURES, rows=rows
    )
    assert list(views) == where
    for camera, view in views.items():
        torch.testing.assert_close(
            view(scene.sh[view.rows]), render(scene, camera), rtol=0, atol=1e-5
        )


def test_views_that_do_not_fit_are_left_to_the_renderer() -> None:
    scene = varied_scene(60, degree=1, seed=1)
    where = cameras()
    settings: dict[str, Any] = {"render": Renderer(), "pictures": 100}
    sizes = [view.nbytes for view in freeze_views(scene, where, **settings).values()]
    for count in range(4):
        assert (
            list(freeze_views(scene, where, max_bytes=sum(sizes[:count]), **settings))
            == where[:count]
        )
    assert (
        list(freeze_views(scene, where, max_bytes=sum(sizes) - 1, **settings))
        == where[:2]
    )
