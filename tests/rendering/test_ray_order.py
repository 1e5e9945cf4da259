"""Camera rays of `splat_ray` come in blocks of pixels; the picture does not depend on it."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mi_splat.plugins import ray
from tests.ray_scenes import T, area, gaussian, scene_of, wall

WIDTH, HEIGHT = 13, 6  # neither is a multiple of a block's side


def loaded(**film: Any) -> Any:
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "rgb", **film}
    place = T().look_at(origin=[0, 0, -5], target=[0, 0, 0], up=[0, 1, 0])
    sensor = {"type": "thinlens", "fov": 30.0, "aperture_radius": 0.1, "focus_distance": 5.0, "to_world": place}
    parts = {"lamp": {**wall(1.0), "emitter": area(0.7)}, "sensor": {**sensor, "film": film}}
    return scene_of(gaussian((0.3, 0, 0), scale=0.3), **parts, integrator={"max_depth": 1})


def sampled(scene: Any, samples: int) -> tuple[Any, Any]:
    sampler = mi.load_dict({"type": "independent", "sample_count": samples})
    size = scene.sensors()[0].film().crop_size()
    sampler.seed(0, int(size[0] * size[1]) * samples)
    found, _, place = scene.integrator().sample_rays(scene, scene.sensors()[0], sampler)
    return found, np.array(place)


@pytest.mark.parametrize("samples", [1, 3])
def test_the_first_rays_are_those_of_one_block(samples: int) -> None:
    _, place = sampled(loaded(rfilter={"type": "box"}), samples)
    pixels = {tuple(one) for one in place.T.astype(int)}
    assert pixels == {(x, y) for x in range(WIDTH) for y in range(HEIGHT)}
    first = place[:, : 16 * samples].astype(int)
    assert np.array_equal(first[0], np.repeat(np.tile(np.arange(4), 4), samples))
    assert np.array_equal(first[1], np.repeat(np.repeat(np.arange(4), 4), samples))


def test_with_many_samples_a_packet_has_one_pixel_already() -> None:
    _, place = sampled(loaded(rfilter={"type": "box"}), 16)
    assert np.array_equal(place[0, :32].astype(int), np.repeat([0, 1], 16))


@pytest.mark.parametrize("film", [{"rfilter": {"type": "box"}}, {"sample_border": True}, {"crop_width": 7}])
def test_the_picture_is_that_of_rays_row_by_row(film: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """No light is reflected here, so that no random number matters that is drawn after the rays."""
    settings = {"rfilter": {"type": "gaussian"}, **film}
    found = np.array(mi.render(loaded(**settings), spp=3, seed=5))
    monkeypatch.setattr(ray, "TILE", 0)
    expected = np.array(mi.render(loaded(**settings), spp=3, seed=5))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert expected.std() > 0.01
