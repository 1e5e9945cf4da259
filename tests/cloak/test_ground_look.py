"""The look of the ground, laid on an object."""

from __future__ import annotations

import pytest
import torch

from attacks.cloak.appearances import GroundLook, name_of, removed
from attacks.cloak.mesh_scene import MeshScene
from attacks.cloak.retouching import grown
from mi_splat.assets.mesh import Asset
from mi_splat.assets.primitives import box, quad
from mi_splat.cameras import Camera, View, orbit_pose

pytestmark = pytest.mark.usefixtures("scalar")

EDGE = 0.6
BLOCK = Asset("car", (box((1.6, 0.8, 0.8), (0.8, 0.8, 0.8), centre=(0, 0, 0.4)),))
STRIPES = Asset(
    "two halves",
    tuple(
        quad([(left, -9, 0), (right, -9, 0), (right, 9, 0), (left, 9, 0)], colour)
        for left, right, colour in ((-9, EDGE, (0.8, 0.1, 0.1)), (EDGE, 9, (0.1, 0.8, 0.1)))
    ),
)
LOOK = GroundLook(mesh_scene=MeshScene(target=BLOCK, surroundings=STRIPES, samples=2), reach=1)


def redness(*points: tuple[float, float, float]) -> list[bool]:
    red, green, _ = LOOK.colours(torch.tensor(points)).unbind(-1)
    return (red > green).tolist()


def test_a_point_has_the_ground_behind_it_as_seen_from_the_side_that_it_faces() -> None:
    """The top has about what is below it; on a side, which is seen from 45 degrees, the higher the further behind."""
    assert redness((-0.5, 0, 0.8), (0.0, 0, 0.8), (0.75, 0, 0.01)) == [True, True, False]
    assert redness((0.8, 0, 0.1), (0.8, 0, 0.3)) == [False, True]


def test_the_object_has_these_colours_and_all_else_is_as_if_it_were_not_there() -> None:
    camera = Camera(
        to_world=orbit_pose((0, 0, 0.4), azimuth=20, elevation=60, distance=4.0), focal=26.0, width=20, height=20
    )
    scene = LOOK.mesh_scene
    view, mask = View(camera, scene.picture(camera)), scene.mask(camera)
    image, around = LOOK(view, mask), removed(scene, reach=1)(view, mask)
    assert torch.equal(image[~mask], around[~mask])
    assert torch.equal(image[~grown(mask, 1)], view.image[~grown(mask, 1)])
    assert torch.equal(image[mask], LOOK.colours(scene.points(camera)[mask]))
    ground = around[mask][:, :2].sort(-1).values.mean(0)
    assert torch.allclose(image[mask][:, :2].sort(-1).values.mean(0), ground, atol=0.03)  # as bright as the ground
    assert name_of(LOOK) == "the ground laid on it, from elevation 45"
