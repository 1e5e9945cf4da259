"""The ray tracer of splats against a float64 oracle, and its gradients against finite differences of that oracle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from mi_splat.cameras import Camera, orbit_pose
from mi_splat.errors import InvalidValueError
from mi_splat.rendering import Renderer, RenderSettings, ScreenGradients
from mi_splat.scene import ATTRIBUTES, GaussianScene
from tests import oracle, ray_oracle

TOLERANCE = 1e-4
"""Of a pixel; float32 rounds a needle's peak."""

STEP = 1e-6
"""Of a finite difference in float64: so short that no Gaussian crosses 1/255 or another one on the way."""


def camera(width: int = 45, height: int = 38, *, distance: float = 3.0) -> Camera:
    pose = orbit_pose((0.0, 0.0, 0.0), azimuth=30.0, elevation=20.0, distance=distance)
    return Camera(to_world=pose, focal=45.0, width=width, height=height)


def ray(**settings: object) -> Renderer:
    return Renderer(RenderSettings(method="ray", **settings))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("count", "degree", "size"), [(1, 0, (5, 7)), (2, 3, (16, 16)), (90, 2, (45, 38)), (700, 1, (30, 21))]
)
@pytest.mark.parametrize("to_mean", [False, True])
def test_picture_is_the_oracles(count: int, degree: int, size: tuple[int, int], to_mean: bool) -> None:
    scene, view = oracle.random_scene(count, degree=degree, seed=count), camera(*size)
    background = (0.1, 0.2, 0.3)
    found = ray(background=background, alpha=True, colour_to_mean=to_mean)(scene, view).numpy()
    picture, opacity = ray_oracle.render(scene, view, background=background, to_mean=to_mean)
    np.testing.assert_allclose(found, np.concatenate([picture, opacity[..., None]], -1), atol=TOLERANCE)


def test_three_hundred_gaussians_in_one_place_are_all_blended() -> None:
    few = oracle.random_scene(1, degree=0, seed=4)
    count = 300
    scene = GaussianScene(
        torch.zeros(count, 3),
        few.scales.new_tensor([[0.5, 0.5, 0.5]]).repeat(count, 1),
        few.rotations.repeat(count, 1),
        torch.full((count,), 0.01),
        torch.linspace(-1, 1, count)[:, None, None].repeat(1, 1, 3),
    )
    view = camera()
    found = ray(alpha=True)(scene, view)[..., 3].double().numpy()
    origin, directions, _ = ray_oracle.camera_rays(view)
    alpha = ray_oracle.peaks(scene, origin, directions)[1][0].reshape(view.height, view.width)
    expected = np.where(alpha >= 1 / 255, 1 - (1 - alpha) ** count, 0.0)
    assert expected.max() > 0.9
    clear = np.abs(alpha - 1 / 255) > 1e-6
    np.testing.assert_allclose(found[clear], expected[clear], atol=TOLERANCE)


def test_a_camera_inside_of_a_cloud_of_gaussians_sees_what_is_ahead() -> None:
    scene, view = oracle.random_scene(200, degree=1, seed=8), camera(distance=0.3)
    picture, _ = ray_oracle.render(scene, view, near=0.05)
    np.testing.assert_allclose(ray(near=0.05)(scene, view).numpy(), picture, atol=5 * TOLERANCE)


def test_nothing_visible_is_background() -> None:
    scene = oracle.random_scene(10, degree=1, seed=0)
    expected = torch.tensor([0.25, 0.5, 1.0]).expand(38, 45, 3)
    empty = scene.select(torch.zeros(10, dtype=torch.bool))
    assert torch.equal(ray(background=(0.25, 0.5, 1.0))(empty, camera()), expected)
    leaf = scene.means.clone().requires_grad_(True)
    picture = ray(background=(0.25, 0.5, 1.0))(replace(scene, means=leaf, opacities=torch.zeros(10)), camera())
    assert torch.equal(picture.detach(), expected)
    picture.sum().backward()  # type: ignore[no-untyped-call]
    assert leaf.grad is not None
    assert not leaf.grad.any()


def overlapping_scene() -> GaussianScene:
    """Large Gaussians on top of each other: a ray meets dozens."""
    scene = oracle.random_scene(70, degree=3, seed=5)
    return replace(scene, scales=scene.scales * 2.5, opacities=scene.opacities * 0.4 + 0.02)


@pytest.mark.parametrize("to_mean", [False, True])
def test_gradients_are_finite_differences_under_overlap(to_mean: bool) -> None:
    scene, view = overlapping_scene(), camera()
    leaves = [tensor.clone().requires_grad_(True) for tensor in scene.tensors()]
    settings = {"background": (0.3, 0.6, 0.1), "alpha": True, "colour_to_mean": to_mean}
    weight = torch.randn(view.height, view.width, 4, generator=torch.Generator().manual_seed(3))
    (ray(**settings)(GaussianScene(*leaves), view) * weight).sum().backward()  # type: ignore[no-untyped-call]

    def loss(name: str, change: Tensor) -> float:
        moved = GaussianScene(*(t.double() for t in scene.tensors()))
        values = getattr(moved, name) + change
        if name == "rotations":
            values = values / values.norm(dim=1, keepdim=True)
        picture, opacity = ray_oracle.render(
            replace(moved, **{name: values}), view, background=(0.3, 0.6, 0.1), to_mean=to_mean
        )
        return float((np.concatenate([picture, opacity[..., None]], -1) * weight.double().numpy()).sum())

    for name, leaf in zip(ATTRIBUTES, leaves, strict=True):
        assert leaf.grad is not None
        direction = leaf.grad.double() / leaf.grad.double().norm()
        numeric = (loss(name, STEP * direction) - loss(name, -STEP * direction)) / (2 * STEP)
        assert numeric == pytest.approx(float(leaf.grad.double().norm()), rel=2e-3), name
        other = torch.randn(leaf.shape, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
        other /= other.norm()
        numeric = (loss(name, STEP * other) - loss(name, -STEP * other)) / (2 * STEP)
        found = float((leaf.grad.double() * other).sum())
        assert found == pytest.approx(numeric, abs=2e-3 * float(leaf.grad.norm())), name


def test_two_cameras_add_their_gradients() -> None:
    scene = oracle.random_scene(30, degree=1, seed=2)
    views = [camera(20, 20), camera(24, 12, distance=4.0)]
    leaf = scene.sh.clone().requires_grad_(True)
    together = replace(scene, sh=leaf)
    sum(image.sum() for image in ray().batch(together, views)).backward()  # type: ignore[union-attr]
    assert leaf.grad is not None
    both = leaf.grad.clone()
    leaf.grad = None
    for view in views:
        ray()(together, view).sum().backward()  # type: ignore[no-untyped-call]
    torch.testing.assert_close(both, leaf.grad, rtol=1e-4, atol=1e-4)


def test_a_method_that_is_none_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="tile, ray"):
        RenderSettings(method="rays")  # type: ignore[arg-type]


def test_screen_gradients_need_a_screen() -> None:
    with pytest.raises(InvalidValueError, match="screen_gradients"):
        Renderer(RenderSettings(method="ray"), screen_gradients=ScreenGradients())
