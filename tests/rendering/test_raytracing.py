"""The ray tracer of splats against a float64 oracle, and its gradients against finite
differences of that oracle.
"""

import math
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from torch import Tensor

from mi_splat import oracle
from mi_splat.attributes import ATTRIBUTES
from mi_splat.cameras.camera import Camera, orbit_pose
from mi_splat.cameras.lens import Lens
from mi_splat.errors import InvalidValueError
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from tests.gaussians import varied_scene
from tests.ray_scenes import GREEN, constant, gaussian, linear, pixel, scene_of, wall

TOLERANCE = 1e-4
"""Of a pixel; float32 rounds a needle's peak."""

STEP = 1e-6
"""Of a finite difference in float64: so short that no Gaussian crosses 1/255 or another
one on the way.
"""


def camera(width: int = 45, height: int = 38, *, distance: float = 3.0) -> Camera:
    pose = orbit_pose((0.0, 0.0, 0.0), azimuth=30.0, elevation=20.0, distance=distance)
    return Camera(to_world=pose, lens=Lens(focal=45.0, size=(width, height)))


def ray(**settings: object) -> Renderer:
    return Renderer(RenderSettings(method="ray", **settings))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("count", "degree", "size"),
    [(1, 0, (5, 7)), (2, 3, (16, 16)), (90, 2, (45, 38)), (700, 1, (30, 21))],
)
@pytest.mark.parametrize("to_mean", [False, True])
def test_picture_is_the_oracles(
    count: int, degree: int, size: tuple[int, int], to_mean: bool
) -> None:
    scene = varied_scene(count, degree=degree, seed=count)
    view = camera(*size)
    background = (0.1, 0.2, 0.3)
    rendered = ray(background=background, alpha=True, colour_to_mean=to_mean)(
        scene, view
    ).numpy()
    picture, opacity = oracle.render_rays(
        scene, view, background=background, to_mean=to_mean
    )
    np.testing.assert_allclose(
        rendered, np.concatenate([picture, opacity[..., None]], -1), atol=TOLERANCE
    )


def test_three_hundred_gaussians_in_one_place_are_all_blended() -> None:
    few = varied_scene(1, degree=0, seed=4)
    count = 300
    scene = GaussianScene(
        torch.zeros(count, 3),
        few.scales.new_tensor([[0.5, 0.5, 0.5]]).repeat(count, 1),
        few.rotations.repeat(count, 1),
        torch.full((count,), 0.01),
        torch.linspace(-1, 1, count)[:, None, None].repeat(1, 1, 3),
    )
    view = camera()
    picture = ray(alpha=True)(scene, view)[..., 3].double().numpy()
    origin, directions, _ = oracle.pixel_rays(view)
    alpha = oracle.densest(scene, origin, directions)[1][0].reshape(
        view.height, view.width
    )
    expected = np.where(alpha >= 1 / 255, 1 - (1 - alpha) ** count, 0.0)
    assert expected.max() > 0.9
    clear = np.abs(alpha - 1 / 255) > 1e-6
    np.testing.assert_allclose(picture[clear], expected[clear], atol=TOLERANCE)


def overlapping_scene() -> GaussianScene:
    """Large Gaussians on top of each other: a ray meets dozens."""
    scene = varied_scene(70, degree=3, seed=5)
    return replace(
        scene, scales=scene.scales * 2.5, opacities=scene.opacities * 0.4 + 0.02
    )


@pytest.mark.parametrize("to_mean", [False, True])
def test_gradients_are_finite_differences_under_overlap(to_mean: bool) -> None:
    scene = overlapping_scene()
    view = camera()
    leaves = [tensor.clone().requires_grad_(True) for tensor in scene.tensors()]
    settings = {"background": (0.3, 0.6, 0.1), "alpha": True, "colour_to_mean": to_mean}
    weight = torch.randn(
        view.height, view.width, 4, generator=torch.Generator().manual_seed(3)
    )
    (ray(**settings)(GaussianScene(*leaves), view) * weight).sum().backward()  # type: ignore[no-untyped-call]

    def loss(name: str, change: Tensor) -> float:
        moved = GaussianScene(*(t.double() for t in scene.tensors()))
        values = getattr(moved, name) + change
        if name == "rotations":
            values = values / values.norm(dim=1, keepdim=True)
        picture, opacity = oracle.render_rays(
            replace(moved, **{name: values}),
            view,
            background=(0.3, 0.6, 0.1),
            to_mean=to_mean,
        )
        return float(
            (
                np.concatenate([picture, opacity[..., None]], -1)
                * weight.double().numpy()
            ).sum()
        )

    for name, leaf in zip(ATTRIBUTES, leaves, strict=True):
        assert leaf.grad is not None
        direction = leaf.grad.double() / leaf.grad.double().norm()
        numeric = (loss(name, STEP * direction) - loss(name, -STEP * direction)) / (
            2 * STEP
        )
        assert numeric == pytest.approx(float(leaf.grad.double().norm()), rel=2e-3), (
            name
        )
        other = torch.randn(
            leaf.shape, generator=torch.Generator().manual_seed(9), dtype=torch.float64
        )
        other /= other.norm()
        numeric = (loss(name, STEP * other) - loss(name, -STEP * other)) / (2 * STEP)
        slope = float((leaf.grad.double() * other).sum())
        assert slope == pytest.approx(numeric, abs=2e-3 * float(leaf.grad.norm())), name


# Gradients of `splat_ray` through mirrors and shadows, against values that can be
# written down; what it refuses


def gradients(loaded: Any, channel: int = 1) -> dict[str, Any]:
    """Gradient of one channel of the only pixel."""
    params = mi.traverse(loaded)
    names = ("data", "opacities", "sh_coeffs")
    for name in names:
        dr.enable_grad(params[f"splat0.{name}"])
    dr.backward(mi.render(loaded, params, spp=64)[:, :, channel])
    return {
        name: np.array(dr.grad(params[f"splat0.{name}"]), dtype=np.float64)
        for name in names
    }


def test_a_gradient_through_a_mirror() -> None:
    """Light is own + (1 - o) own, own = o c: twice 1 - o by the opacity."""
    loaded = scene_of(
        gaussian((0, 0, 0), opacity=0.3),
        mirror=wall(2.0, type="conductor", material="none"),
    )
    gradient = gradients(loaded)
    assert gradient["opacities"][0] == pytest.approx(
        linear(GREEN)[1] * 2 * (1 - 0.3), rel=1e-4
    )
    slope = (linear(GREEN[1] + 1e-6) - linear(GREEN[1] - 1e-6)) / 2e-6 * 0.28209479
    assert gradient["sh_coeffs"][1] == pytest.approx(slope * 0.3 * 1.7, rel=1e-3)


def test_a_gradient_through_a_shadow() -> None:
    """Light is L (1 - o exp(-y^2 / 2 s^2)), y from the light's way to the mean."""
    light = {
        "type": "directional",
        "direction": [1, 0, 1],
        "irradiance": {"type": "rgb", "value": 3.0},
    }
    parts: dict[str, Any] = {
        "wall": wall(4.0),
        "light": light,
        "integrator": {"max_depth": 2},
    }
    bright = pixel(scene_of(**parts))[1]
    gradient = gradients(
        scene_of(
            gaussian((-2, 0.1, 2), scale=0.25, opacity=0.8, colour=(0, 0, 0)), **parts
        )
    )
    density = math.exp(-0.5 * (0.1 / 0.25) ** 2)
    assert gradient["opacities"][0] == pytest.approx(-bright * density, rel=1e-3)
    assert gradient["data"][1] == pytest.approx(
        bright * 0.8 * density * 0.1 / 0.25**2, rel=1e-3
    )
    assert gradient["data"][4] == pytest.approx(
        -bright * 0.8 * density * 0.1**2 / 0.25**3, rel=1e-3
    )


def test_a_changed_colour_is_seen_in_the_same_tree() -> None:
    loaded = scene_of(gaussian((0, 0, 0), colour=(0, 0, 0)))
    params = mi.traverse(loaded)
    integrator = loaded.integrator()
    assert pixel(loaded).max() == 0
    tree = integrator._cache._splats[2].tree
    params["splat0.sh_coeffs"] = mi.Float(params["splat0.sh_coeffs"] + 0.5 / 0.28209479)
    params.update()
    np.testing.assert_allclose(pixel(loaded), 0.6 * linear(0.5), rtol=1e-4)
    assert integrator._cache._splats[2].tree is tree


def test_gradients_of_surfaces_are_refused() -> None:
    loaded = scene_of(gaussian((0, 0, 0)), wall=wall(2.0), sky=constant(1.0))
    params = mi.traverse(loaded)
    dr.enable_grad(params["wall.bsdf.reflectance.value"])
    with pytest.raises(InvalidValueError, match=r"wall\.bsdf\.reflectance\.value"):
        loaded.integrator().render_backward(
            loaded, params, mi.TensorXf(np.ones((1, 1, 3), np.float32))
        )


FOG = {
    "type": "sphere",
    "id": "fog",
    "interior": {"type": "homogeneous"},
    "bsdf": {"type": "null"},
}
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"wall": wall(2.0), "integrator": {"linear": False}}, "leave linear true"),
    (
        {
            "sky": constant(1.0),
            "integrator": {"background": {"type": "rgb", "value": 0.5}},
        },
        "remove one of them",
    ),
    ({"fog": FOG}, r"medium.*fog"),
    ({"wall": wall(2.0), "integrator": {"type": "splat_tile"}}, "splat_ray"),
]


@pytest.mark.parametrize(("parts", "words"), REFUSED)
def test_scenes_that_cannot_be_traced_are_refused(
    parts: dict[str, Any], words: str
) -> None:
    loaded = scene_of(gaussian((0, 0, 0)), **parts)
    with pytest.raises(InvalidValueError, match=words):
        loaded.integrator().render(loaded)
