"""`splat_ray` among surfaces and lights, against values that can be written down."""

import math
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import torch

from mi_splat.cameras.camera import Camera
from mi_splat.cameras.lens import Lens
from mi_splat.render.plugins.sensor import sensor_dict
from mi_splat.render.renderer import Renderer, RenderSettings
from tests.gaussians import varied_scene
from tests.ray_scenes import (
    GREEN,
    T,
    area,
    constant,
    diffuse,
    gaussian,
    linear,
    looking,
    pixel,
    scene_of,
    wall,
)


def test_one_gaussian_over_a_background() -> None:
    colour = pixel(
        scene_of(
            gaussian((0, 0, 0)),
            integrator={"background": {"type": "rgb", "value": 0.5}},
        )
    )
    np.testing.assert_allclose(
        colour, 0.6 * linear(GREEN) + 0.4 * linear(0.5), rtol=1e-4
    )


def test_a_gaussian_before_a_lambertian_wall() -> None:
    sun = {
        "type": "directional",
        "direction": [1, 0, 1],
        "irradiance": {"type": "rgb", "value": 3.0},
    }
    # The sun's ray to the wall's middle passes far from the Gaussian.
    reflected = 0.5 / math.pi * 3.0 * math.cos(math.pi / 4)
    black = gaussian((0, 0, 0), colour=(0, 0, 0))
    np.testing.assert_allclose(
        pixel(scene_of(black, wall=wall(4.0), sun=sun)), 0.4 * reflected, rtol=1e-3
    )
    # A green one is a light, too: the wall shows more than what comes straight to the
    # camera.
    green = pixel(scene_of(gaussian((0, 0, 0)), wall=wall(4.0), sun=sun), spp=1024)
    more = green - 0.6 * linear(GREEN) - 0.4 * reflected
    assert (more > 0).all()
    assert more.argmax() == 1


def test_a_gaussian_is_hidden_by_what_its_peak_lies_behind() -> None:
    lamp = {**wall(1.0), "emitter": area(0.7)}
    one = {"max_depth": 1}
    before = gaussian((0, 0, 0.9), scale=0.5)
    behind = gaussian((0, 0, 1.1), scale=0.5)
    np.testing.assert_allclose(
        pixel(scene_of(behind, lamp=lamp, integrator=one)), 0.7, rtol=1e-5
    )
    colour = pixel(scene_of(before, lamp=lamp, integrator=one))
    np.testing.assert_allclose(colour, 0.6 * linear(GREEN) + 0.4 * 0.7, rtol=1e-4)


def test_a_gaussian_in_a_mirror_is_seen_from_behind() -> None:
    """Before the mirror it hides the camera's view of itself: light passes it twice."""
    colour = pixel(
        scene_of(
            gaussian((0, 0, 0), opacity=0.3),
            mirror=wall(2.0, type="conductor", material="none"),
        )
    )
    own = 0.3 * linear(GREEN)
    np.testing.assert_allclose(colour, own + 0.7 * own, rtol=1e-4)


@pytest.mark.parametrize("emitter", ["directional", "point"])
def test_a_shadow_lets_one_minus_alpha_through(emitter: str) -> None:
    light = {
        "directional": {
            "type": "directional",
            "direction": [1, 0, 1],
            "irradiance": {"type": "rgb", "value": 3.0},
        },
        "point": {
            "type": "point",
            "position": [-4, 0, 0],
            "intensity": {"type": "rgb", "value": 3.0},
        },
    }[emitter]
    parts: dict[str, Any] = {
        "wall": wall(4.0),
        "light": light,
        "integrator": {"max_depth": 2},
    }
    bright = pixel(scene_of(**parts))
    # On the light's way to the wall's middle, (-2, 0, 2), and 0.1 beside it; outside of
    # the camera's ray.
    shade = gaussian((-2, 0.1, 2), scale=0.25, opacity=0.8, colour=(0, 0, 0))
    alpha = 0.8 * math.exp(-0.5 * (0.1 / 0.25) ** 2)
    np.testing.assert_allclose(
        pixel(scene_of(shade, **parts)), (1 - alpha) * bright, rtol=1e-4
    )
    position = (-6, 0, -2) if emitter == "point" else (2, 0, 6)
    beyond = gaussian(position, scale=0.25, opacity=0.8, colour=(0, 0, 0))
    np.testing.assert_allclose(pixel(scene_of(beyond, **parts)), bright, rtol=1e-5)


def test_a_furnace_stays_as_bright_as_its_walls() -> None:
    """A white sphere and a Gaussian of the environment's radiance, in that environment:
    nothing can be seen.
    """
    level = 0.8
    srgb = float(1.055 * level ** (1 / 2.4) - 0.055)
    ghost = gaussian(
        (0.4, 0.3, -1.2), scale=0.4, opacity=0.9, colour=(srgb, srgb, srgb)
    )
    parts = {
        "sensor": looking(size=12),
        "sky": constant(level),
        "ball": {"type": "sphere", "bsdf": diffuse(1.0)},
    }
    loaded = scene_of(ghost, integrator={"max_depth": -1, "rr_depth": 1000}, **parts)
    picture = np.array(mi.render(loaded, spp=256))
    np.testing.assert_allclose(picture.mean(), level, rtol=2e-3)
    np.testing.assert_allclose(picture, level, rtol=0.15)


def test_without_splats_it_is_the_path_tracer() -> None:
    parts = {
        "sensor": looking(size=16),
        "sky": constant(0.3),
        "floor": wall(2.0, **diffuse(0.4)),
    }
    parts |= {
        "ball": {"type": "sphere", "bsdf": {"type": "dielectric"}},
        "lamp": {
            "type": "sphere",
            "center": [2, 2, -1],
            "radius": 0.3,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 9.0}},
        },
    }
    picture = np.array(mi.render(scene_of(**parts), spp=1024))
    expected = np.array(
        mi.render(
            mi.load_dict(
                {
                    "type": "scene",
                    "integrator": {"type": "path", "max_depth": 6},
                    **parts,
                }
            ),
            spp=1024,
        )
    )
    assert picture.mean() == pytest.approx(expected.mean(), rel=0.02)
    assert np.abs(picture - expected).mean() < 0.05 * expected.mean()


def test_alone_it_is_the_renderers_picture() -> None:
    """Rays through random points of pixels, on average, against rays through their
    centres.
    """
    splat = varied_scene(40, degree=2, seed=3)
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = -6.0
    view = Camera(to_world=pose, lens=Lens(focal=60.0, size=(24, 20)))
    loaded = scene_of(
        splat, sensor=sensor_dict(view), integrator={"linear": False, "alpha": True}
    )
    picture = np.array(mi.render(loaded, spp=64))
    expected = Renderer(RenderSettings(method="ray", alpha=True, near=0.01))(
        splat, view
    ).numpy()
    assert picture.shape == expected.shape
    assert np.sqrt(np.mean((picture - expected) ** 2)) < 0.03


def test_a_surface_that_moves_is_seen_where_it_is() -> None:
    glow = {"type": "area", "radiance": {"type": "rgb", "value": 0.7}}
    loaded = scene_of(gaussian((0, 0, 0)), wall={**wall(1.0), "emitter": glow})
    with_splat = pixel(loaded)
    params = mi.traverse(loaded)
    params["wall.to_world"] = mi.Transform4f(
        T().translate([0, 0, -1]).rotate([0, 1, 0], 180).scale(50)
    )
    params.update()
    np.testing.assert_allclose(pixel(loaded), 0.7, rtol=1e-5)
    assert not np.allclose(with_splat, 0.7, rtol=0.05)
