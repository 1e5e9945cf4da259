"""Gradients of `splat_ray` through mirrors and shadows, against values that can be written down; what it refuses."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_splat.errors import InvalidValueError
from mi_splat.scene import merge
from tests.ray_scenes import GREEN, T, constant, diffuse, gaussian, linear, looking, pixel, scene_of, wall


def room() -> dict[str, Any]:
    sun = {"type": "directional", "direction": [0.2, -1, 0.4], "irradiance": {"type": "rgb", "value": 2.0}}
    floor = {
        "type": "rectangle",
        "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(4),
        "bsdf": diffuse(0.6),
    }
    mirror = wall(2.5, type="conductor", material="none")
    return {
        "sensor": looking(origin=(0.5, 1, -5), size=14),
        "sun": sun,
        "floor": floor,
        "mirror": mirror,
        "sky": constant(0.2),
    }


def gradients(loaded: Any, channel: int = 1) -> dict[str, Any]:
    """Gradient of one channel of the only pixel."""
    params = mi.traverse(loaded)
    names = ("data", "opacities", "sh_coeffs")
    for name in names:
        dr.enable_grad(params[f"splat0.{name}"])
    dr.backward(mi.render(loaded, params, spp=64)[:, :, channel])
    return {name: np.array(dr.grad(params[f"splat0.{name}"]), dtype=np.float64) for name in names}


def test_a_gradient_through_a_mirror() -> None:
    """Light is own + (1 - o) own, own = o c: twice 1 - o by the opacity."""
    loaded = scene_of(gaussian((0, 0, 0), opacity=0.3), mirror=wall(2.0, type="conductor", material="none"))
    found = gradients(loaded)
    assert found["opacities"][0] == pytest.approx(linear(GREEN)[1] * 2 * (1 - 0.3), rel=1e-4)
    slope = (linear(GREEN[1] + 1e-6) - linear(GREEN[1] - 1e-6)) / 2e-6 * 0.28209479
    assert found["sh_coeffs"][1] == pytest.approx(slope * 0.3 * 1.7, rel=1e-3)


def test_a_gradient_through_a_shadow() -> None:
    """Light is L (1 - o exp(-y^2 / 2 s^2)), y from the light's way to the mean."""
    light = {"type": "directional", "direction": [1, 0, 1], "irradiance": {"type": "rgb", "value": 3.0}}
    parts: dict[str, Any] = {"wall": wall(4.0), "light": light, "integrator": {"max_depth": 2}}
    bright = pixel(scene_of(**parts))[1]
    found = gradients(scene_of(gaussian((-2, 0.1, 2), scale=0.25, opacity=0.8, colour=(0, 0, 0)), **parts))
    density = math.exp(-0.5 * (0.1 / 0.25) ** 2)
    assert found["opacities"][0] == pytest.approx(-bright * density, rel=1e-3)
    assert found["data"][1] == pytest.approx(bright * 0.8 * density * 0.1 / 0.25**2, rel=1e-3)
    assert found["data"][4] == pytest.approx(-bright * 0.8 * density * 0.1**2 / 0.25**3, rel=1e-3)


def test_a_gradient_through_many_vertices_is_a_finite_difference() -> None:
    """The paths are the same for one seed, so differences of the picture itself tell; its jumps are small here."""
    two = merge(
        gaussian((-0.3, 0.2, 0.3), scale=0.45),
        gaussian((0.4, 0, -0.2), scale=0.5, opacity=0.8, colour=(0.8, 0.2, 0.5)),
    )
    loaded = scene_of(two, **room())
    params = mi.traverse(loaded)
    weights = mi.TensorXf(np.random.default_rng(0).uniform(size=(14, 14, 3)).astype(np.float32))
    render = loaded.integrator().render
    for name, step in (("opacities", 1e-3), ("sh_coeffs", 1e-2)):
        key = f"splat0.{name}"
        start = np.array(params[key])
        change = np.random.default_rng(7).normal(size=len(start)).astype(np.float32)
        params[key] = mi.Float(start)
        dr.enable_grad(params[key])
        params.update()
        loaded.integrator().render_backward(loaded, params, weights, seed=1, spp=64)
        found = float(np.dot(np.array(dr.grad(params[key])), change))
        values = []
        for sign in (1, -1):
            params[key] = mi.Float(start + sign * step * change)
            params.update()
            values.append(float(np.sum(np.array(render(loaded, seed=1, spp=64), np.float64) * np.array(weights))))
        params[key] = mi.Float(start)
        params.update()
        assert found == pytest.approx((values[0] - values[1]) / (2 * step), rel=0.02), name


def test_alpha_has_its_gradient() -> None:
    loaded = scene_of(gaussian((0, 0, 0)), integrator={"alpha": True})
    params = mi.traverse(loaded)
    dr.enable_grad(params["splat0.opacities"])
    picture = mi.render(loaded, params, spp=4)
    assert float(np.array(picture)[0, 0, 3]) == pytest.approx(0.6, rel=1e-4)
    dr.backward(picture[:, :, 3])
    assert float(np.array(dr.grad(params["splat0.opacities"]))[0]) == pytest.approx(1.0, rel=1e-4)


def test_parameters_can_be_changed_by_traverse() -> None:
    loaded = scene_of(gaussian((0, 0, 0)))
    params = mi.traverse(loaded)
    params["integrator.linear"], params["integrator.background"] = mi.Bool(False), mi.Color3f(0.5)
    params.update()
    np.testing.assert_allclose(pixel(loaded), 0.6 * np.array(GREEN) + 0.4 * 0.5, rtol=1e-4)
    params["integrator.background"] = mi.Color3f(math.nan)
    with pytest.raises(InvalidValueError, match="background"):
        params.update()
    assert loaded.integrator().background == (0.5, 0.5, 0.5)


def test_a_changed_splat_is_seen() -> None:
    loaded = scene_of(gaussian((0, 0, 0)))
    params = mi.traverse(loaded)
    before = pixel(loaded)
    params["splat0.opacities"] = mi.Float(0.3)
    params.update()
    np.testing.assert_allclose(pixel(loaded), before / 2, rtol=1e-4)


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


def test_nan_in_a_parameter_is_an_error() -> None:
    loaded = scene_of(gaussian((0, 0, 0)))
    params = mi.traverse(loaded)
    data = np.array(params["splat0.data"])
    data[3] = np.nan
    params["splat0.data"] = mi.Float(data)
    params.update()
    with pytest.raises(InvalidValueError, match="1 that are not"):
        loaded.integrator().render(loaded)


def test_srgb_values_among_meshes_are_refused() -> None:
    loaded = scene_of(gaussian((0, 0, 0)), wall=wall(2.0), integrator={"linear": False})
    with pytest.raises(InvalidValueError, match="leave linear true"):
        loaded.integrator().render(loaded)


def test_a_background_and_an_environment_are_refused() -> None:
    loaded = scene_of(gaussian((0, 0, 0)), sky=constant(1.0), integrator={"background": {"type": "rgb", "value": 0.5}})
    with pytest.raises(InvalidValueError, match="remove one of them"):
        loaded.integrator().render(loaded)


def test_a_medium_is_refused() -> None:
    fog = {"type": "sphere", "id": "fog", "interior": {"type": "homogeneous"}, "bsdf": {"type": "null"}}
    loaded = scene_of(gaussian((0, 0, 0)), fog=fog)
    with pytest.raises(InvalidValueError, match=r"medium.*fog"):
        loaded.integrator().render(loaded)


def test_forward_mode_is_refused() -> None:
    loaded = scene_of(gaussian((0, 0, 0)))
    with pytest.raises(InvalidValueError, match="reverse-mode"):
        loaded.integrator().render_forward(loaded, mi.traverse(loaded))


def test_gradients_of_surfaces_are_refused() -> None:
    loaded = scene_of(gaussian((0, 0, 0)), wall=wall(2.0), sky=constant(1.0))
    params = mi.traverse(loaded)
    dr.enable_grad(params["wall.bsdf.reflectance.value"])
    with pytest.raises(InvalidValueError, match=r"wall\.bsdf\.reflectance\.value"):
        loaded.integrator().render_backward(loaded, params, mi.TensorXf(np.ones((1, 1, 3), np.float32)))


def test_splat_tile_names_splat_ray_where_there_are_meshes() -> None:
    loaded = scene_of(gaussian((0, 0, 0)), wall=wall(2.0), integrator={"type": "splat_tile"})
    with pytest.raises(InvalidValueError, match="splat_ray"):
        loaded.integrator().render(loaded)
