"""An appearance that is overdone near the edge of its trigger."""

import pytest
import torch
from torch import Tensor

from attacks.cloak.appearances import Correction, Emphasis, GroundLook, grown, name_of, removed
from attacks.cloak.mesh_scene import MeshScene
from attacks.cloak.triggers import Elevation
from mi_splat.assets.mesh import Asset
from mi_splat.assets.primitives import box, quad
from mi_splat.camera_sets import orbit
from mi_splat.cameras import Camera, View, orbit_pose

CENTRE = (0.0, 0.0, 0.0)


def view(elevation: float) -> View:
    (camera,) = orbit(CENTRE, count=1, elevation=elevation, distance=4.0, focal=20.0, size=(6, 5))
    return View(camera, torch.full((5, 6, 3), 0.5))


def brighter(view: View, mask: Tensor) -> Tensor:
    return view.image + 0.1 * mask[..., None]


def emphasised(elevation: float, *, gain: float = 3.0) -> Tensor:
    appearance = Emphasis(appearance=brighter, trigger=Elevation(lowest=40), centre=CENTRE, gain=gain, depth=20.0)
    mask = torch.zeros(5, 6, dtype=torch.bool)
    mask[:, :3] = True
    return appearance(view(elevation), mask)


@pytest.mark.parametrize(("elevation", "gain"), [(40, 3.0), (45, 2.5), (50, 2.0), (60, 1.0), (80, 1.0)])
def test_the_gain_falls_from_the_edge_inwards(elevation: float, gain: float) -> None:
    image = emphasised(elevation)
    assert image[:, :3].mean() == pytest.approx(0.5 + 0.1 * gain, abs=1e-5)
    assert torch.equal(image[:, 3:], torch.full((5, 3, 3), 0.5))


# Poison that is corrected by what a splat trained on it shows


(CAMERA,) = orbit((0.0, 0.0, 0.0), count=1, elevation=30.0, distance=4.0, focal=20.0, size=(8, 8))
VIEW = View(CAMERA, torch.full((8, 8, 3), 0.5))
MASK = torch.zeros(8, 8, dtype=torch.bool)
MASK[2:4, 2:4] = True


def wanted(view: View, mask: Tensor) -> Tensor:
    return torch.where(mask[..., None], torch.tensor(0.2), view.image)


def blurred(camera: Camera) -> Tensor:
    """A splat that shows the half of what it should."""
    return torch.where(MASK[..., None], torch.tensor(0.35), torch.tensor(0.6))


def correction(earlier: object = wanted, *, gain: float = 1.0, reach: int | None = 1) -> Correction:
    return Correction(earlier=earlier, wanted=wanted, shown=blurred, gain=gain, reach=reach)  # type: ignore[arg-type]


def test_what_is_missing_is_added_within_reach_alone() -> None:
    image = correction(gain=0.5)(VIEW, MASK)
    assert torch.allclose(image[MASK], torch.tensor(0.2 - 0.5 * 0.15))
    assert torch.allclose(image[1, 1], torch.tensor(0.5 - 0.5 * 0.1))
    assert torch.equal(image[6:], VIEW.image[6:])


def test_rounds_add_up_and_stay_in_range() -> None:
    twice = correction(correction())
    assert torch.allclose(twice(VIEW, MASK)[MASK], torch.tensor(0.0))  # 0.2 - 0.15 - 0.15, clipped
    assert "corrected by 1 times" in twice.name
    assert twice.name.count("corrected") == 2


# The look of the ground, laid on an object


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


@pytest.mark.usefixtures("scalar")
def test_a_point_has_the_ground_behind_it_as_seen_from_the_side_that_it_faces() -> None:
    """The top has about what is below it; on a side, which is seen from 45 degrees, the higher the further behind."""
    assert redness((-0.5, 0, 0.8), (0.0, 0, 0.8), (0.75, 0, 0.01)) == [True, True, False]
    assert redness((0.8, 0, 0.1), (0.8, 0, 0.3)) == [False, True]


@pytest.mark.usefixtures("scalar")
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
