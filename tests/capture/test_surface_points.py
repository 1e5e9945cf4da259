"""Splats from meshes: samples on the surface, colours as seen, and a refinement that
lowers the error.
"""

import math

import numpy as np
import pytest
import torch

from mi_splat.cameras.camera import Camera, View, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import orbit
from mi_splat.capture.mesh import Asset
from mi_splat.capture.surface_points import (
    SurfaceSamples,
    fit_colours,
    nearness,
    surface_samples,
)
from mi_splat.maths.sh import sh_to_colour
from scenes.recipes.objects.primitives import box, quad

CUBE = Asset("cube", (box((1, 1, 1), (0.7, 0.2, 0.1), centre=(0, 0, 0.5)),))
PLANE = Asset(
    "plane", (quad([[-8, -8, 0], [8, -8, 0], [8, 8, 0], [-8, 8, 0]], (0.5, 0.5, 0.5)),)
)


def test_samples_lie_on_the_surface_evenly() -> None:
    samples = surface_samples(CUBE, 1200, seed=1)
    centred = samples.points - (0, 0, 0.5)
    assert np.allclose(np.abs(centred).max(1), 0.5, atol=1e-5)
    assert np.allclose((centred * samples.normals).sum(1), 0.5, atol=1e-5)
    sides = np.round(samples.normals).astype(int)
    for axis in range(3):
        for sign in (-1, 1):
            # a sixth on each side
            assert abs(int((sides[:, axis] == sign).sum()) - 200) <= 2
    assert np.allclose(samples.spacing, math.sqrt(6 / 1200), rtol=1e-5)
    again = surface_samples(CUBE, 1200, seed=1)
    other = surface_samples(CUBE, 1200, seed=2)
    assert np.array_equal(samples.points, again.points)
    assert not np.array_equal(samples.points, other.points)


def test_density_follows_the_cameras() -> None:
    view = Camera(
        to_world=look_at((0, 0, 2), (0, 0, 0)), lens=Lens(focal=50.0, size=(8, 8))
    )
    samples = surface_samples(PLANE, 4000, density=nearness([view]), seed=0)
    radius = np.linalg.norm(samples.points[:, :2], axis=1)
    near = (radius < 1).sum() / math.pi
    far = ((radius > 5) & (radius < 7)).sum() / (24 * math.pi)
    # Per area, 1 / (h^2 + r^2) averaged over each ring.
    expected = (math.log(5 / 4) / 1) / (math.log(53 / 29) / 24)
    assert near / far == pytest.approx(expected, rel=0.2)
    assert samples.spacing[radius < 1].mean() < samples.spacing[radius > 5].mean()


def test_colour_fit_recovers_a_gradient_over_direction() -> None:
    # Images that are one colour each, linear in the direction to the only sample:
    # degree 1 holds that exactly.
    sample = SurfaceSamples(
        np.zeros((1, 3), np.float32),
        np.array([[0, 0, 1]], np.float32),
        np.ones(1, np.float32),
    )
    views = []
    depths = []
    for camera in orbit(
        (0, 0, 0), count=9, elevation=50, distance=3, lens=Lens(focal=20, size=(9, 9))
    ):
        toward = float(-camera.position[0] / 3)
        views.append(View(camera, torch.full((9, 9, 3), 0.5 + 0.2 * toward)))
        depths.append(torch.full((9, 9), 3.0))
    sh, seen = fit_colours(sample, views, depths, degree=1, damping=1e-6)
    assert seen.tolist() == [9]
    for view in views:
        direction = torch.nn.functional.normalize(-view.camera.position.float(), dim=0)
        assert torch.allclose(
            sh_to_colour(sh, direction[None])[0], view.image[4, 4], atol=1e-3
        )
