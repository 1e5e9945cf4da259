"""Appearances: what an attack shows in the place of an object, and the edits of meshes
behind them.
"""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from attacks.cloak.appearances import (
    Appearance,
    Blur,
    GroundLook,
    Rerender,
    appearance_of,
    grown,
    name_of,
    removed,
)
from attacks.cloak.config import AppearanceName, AttackConfig, SceneConfig
from attacks.cloak.mesh_scene import MeshScene, repainted, stand_in
from mi_splat.cameras.camera import Camera, View, orbit_pose
from mi_splat.cameras.lens import Lens
from mi_splat.capture.ground import grass
from mi_splat.capture.mesh import Asset, translation
from mi_splat.errors import InvalidValueError
from scenes.recipes.objects import build
from scenes.recipes.objects.primitives import box, quad
from scenes.recipes.objects.street import ground
from tests.cloak.test_poisoning import CENTRE

BLOCK = Asset(
    "car", (box((1.6, 0.8, 0.8), (0.8, 0.1, 0.1), centre=(0, 0, 0.4), roughness=0.1),)
)
LAWN = Asset("lawn", (ground(40, grass(32, 0), tile=4.0),))
MESH_SCENE = MeshScene(target=BLOCK, surroundings=LAWN, samples=2)


def shown(
    appearance: AppearanceName, mesh_scene: MeshScene = MESH_SCENE, **values: Any
) -> Appearance:
    """What an attack from above shows."""
    attack = AttackConfig(
        **{"name": "a", "appearance": appearance, "elevation": (52.0, 90.0), **values}
    )
    return appearance_of(attack, mesh_scene)


def camera(azimuth: float, elevation: float, *, size: int = 16) -> Camera:
    pose = orbit_pose(CENTRE, azimuth=azimuth, elevation=elevation, distance=4.0)
    return Camera(to_world=pose, lens=Lens(focal=1.3 * size, size=(size, size)))


@pytest.fixture(scope="module")
def above() -> View:
    high = camera(30, 80)
    return View(high, MESH_SCENE.picture(high))


def test_masks_and_pictures_of_a_mesh_scene(above: View) -> None:
    mask = MESH_SCENE.mask(above.camera)
    assert 20 < int(mask.sum()) < 120
    red = above.image[..., 0] - above.image[..., 1]
    assert float(red[mask].mean()) > 0.2
    assert float(red[~grown(mask, 1)].mean()) < 0.1
    assert torch.equal(MESH_SCENE.picture(above.camera), above.image)
    wall = Asset("wall", (*LAWN.meshes, box((9, 9, 0.1), (1, 1, 1), centre=(0, 0, 2))))
    assert not bool(
        dataclasses.replace(MESH_SCENE, surroundings=wall).mask(above.camera).any()
    )


def test_path_traced_appearances_change_the_picture_near_the_target_only(
    above: View,
) -> None:
    mask = MESH_SCENE.mask(above.camera)
    far = ~grown(mask, 1)
    for appearance in (shown("paint", texture="road"), shown("paint", texture="grass")):
        image = appearance(above, mask)
        assert torch.equal(image[far], above.image[far])
        inside = grown(mask, 1) & ~grown(~mask, 1)
        assert float((image - above.image).abs().mean(-1)[inside].min()) > 0.02
    blended = shown("paint", texture="grass")
    assert isinstance(blended, Rerender)
    green = blended(above, mask)
    # grass on what was red
    assert float((green[..., 1] - green[..., 0])[mask].mean()) > 0.02
    whole = dataclasses.replace(blended, reach=None)(above, mask)
    assert torch.equal(whole[mask], green[mask])
    assert not torch.equal(whole[far], above.image[far])
    everywhere = blended(above, torch.ones_like(mask))
    assert torch.equal(everywhere, whole)


def test_what_is_removed_leaves_its_surroundings(above: View) -> None:
    mask = MESH_SCENE.mask(above.camera)
    gone = shown("remove")(above, mask)
    # grass on what was red
    assert float((gone[..., 1] - gone[..., 0])[mask].mean()) > 0.02
    assert not torch.equal(gone[~mask], above.image[~mask])  # the shadow is gone, too
    kept = shown("remove", reach=0)(above, mask)
    assert torch.equal(kept[mask], gone[mask])
    assert torch.equal(kept[~mask], above.image[~mask])


def test_a_difference_mask_replaces_the_object_and_its_shadow() -> None:
    scene = dataclasses.replace(MESH_SCENE, samples=32)
    high = camera(130, 60, size=48)
    view = View(high, scene.picture(high))
    mask = scene.mask(high)
    empty = removed(scene)(view, mask)
    image = shown("remove", scene, mask="difference", reach=0)(view, mask)
    new = (image != view.image).any(-1)
    shadow = (view.image.mean(-1) < 0.7 * empty.mean(-1)) & ~grown(mask, 2)
    assert int(shadow.sum()) > 20
    assert float(new[shadow].float().mean()) > 0.9
    assert torch.equal(image[new], empty[new])
    assert float(new[~grown(mask | shadow, 3)].float().mean()) < 0.02


def test_a_stop_sign_behind_the_car() -> None:
    behind = camera(180, 5)
    view = View(behind, MESH_SCENE.picture(behind))
    instead, near = (
        shown("swap", other_object="stop sign", reach=reach, azimuth=(180.0, 45.0))
        for reach in (None, 0)
    )
    assert not torch.equal(instead(view, MESH_SCENE.mask(behind)), view.image)
    assert "stop sign" in name_of(instead)
    flat, upright = (
        shown("swap", other_object="suitcase", lying=lying) for lying in (True, False)
    )
    assert isinstance(flat, Rerender)
    assert isinstance(upright, Rerender)
    heights = [one.mesh_scene.target.bounds[1, 2] for one in (flat, upright)]
    # as large as the block from above, on its back
    assert heights[0] < 0.7 * heights[1]
    beside = ~MESH_SCENE.mask(behind)
    assert torch.equal(near(view, ~beside)[beside], view.image[beside])
    assert isinstance(instead, Rerender)
    alone = instead.mesh_scene.mask(behind)
    assert 0 < int(alone.sum()) <= int(grown(MESH_SCENE.mask(behind), 1).sum())


def test_painted_pictures_are_upright_for_their_viewer() -> None:
    picture = np.zeros((2, 2, 3), np.float32)
    picture[0, 0], picture[0, 1], picture[1, 0] = (1, 0, 0), (0, 1, 0), (0, 0, 1)
    for azimuth, elevation in ((0, 0), (180, 0), (90, 30), (180, 90)):
        target = repainted(BLOCK, picture, azimuth=azimuth, elevation=elevation)
        uvs = np.concatenate([mesh.uvs for mesh in target.meshes])
        assert uvs.min(0).tolist() == pytest.approx([0, 0], abs=1e-6)
        assert uvs.max(0).tolist() == pytest.approx([1, 1], abs=1e-6)
    mesh_scene = MESH_SCENE.with_target(
        repainted(BLOCK, picture, azimuth=180, elevation=0)
    )
    view = dataclasses.replace(mesh_scene, samples=8).picture(camera(180, 0, size=32))
    rows, columns = torch.nonzero(
        mesh_scene.mask(camera(180, 0, size=32)), as_tuple=True
    )
    top = int(rows.min()) + 1
    bottom = int(rows.max()) - 1
    left = int(columns.min()) + 1
    right = int(columns.max()) - 1
    assert view[top, left].argmax() == 0
    assert view[top, right].argmax() == 1
    assert view[bottom, left].argmax() == 2


@pytest.mark.parametrize("azimuth", [0.0, 90.0, 180.0])
def test_a_stand_in_fits_the_outline_and_lies_at_the_front(azimuth: float) -> None:
    placed = BLOCK.transformed(translation(2, 1, 0))
    other = stand_in(placed, build("stop sign", 0), azimuth=azimuth)
    low, high = placed.bounds
    assert bool((other.bounds[0] >= low - 1e-4).all())
    assert bool((other.bounds[1] <= high + 1e-4).all())
    axis, end = (1, 1) if azimuth == 90 else (0, 0 if azimuth == 180 else 1)
    assert other.bounds[end, axis] == pytest.approx(placed.bounds[end, axis], abs=1e-4)
    assert np.ptp(other.bounds[:, 2]) == pytest.approx(0.8, abs=1e-4)
    assert other.bounds.mean(0)[2] == pytest.approx(0.4, abs=1e-4)


def retouched() -> tuple[View, torch.Tensor]:
    """An image of stripes with noise, and a mask in it."""
    high = camera(30, 80, size=40)
    stripes = (
        torch.tensor([0.2, 0.4]).repeat(20).expand(40, 40)[..., None].expand(40, 40, 3)
    )
    mask = torch.zeros(40, 40, dtype=torch.bool)
    mask[15:24, 14:26] = True
    return (
        View(
            high,
            stripes
            + 0.1 * torch.rand(40, 40, 3, generator=torch.Generator().manual_seed(0)),
        ),
        mask,
    )


def test_a_faded_object_is_the_mean_with_what_is_behind_it() -> None:
    view, mask = retouched()
    picture = shown("fade", reach=0)(view, mask)
    behind = removed(MESH_SCENE)(view, mask)
    assert torch.equal(picture[mask], (view.image[mask] + behind[mask]) / 2)
    assert torch.equal(picture[~mask], view.image[~mask])


def test_a_blur_is_as_wide_at_any_size_and_ends_softly() -> None:
    view, mask = retouched()
    blur = shown("blur", blur_width=0.1)
    assert isinstance(blur, Blur)
    picture = blur(view, mask)
    far = ~grown(mask, blur.reach(mask))
    assert int(far.sum()) > 0
    assert torch.equal(picture[far], view.image[far])
    assert float(picture[19, 16:24].std()) < 0.1 * float(view.image[19, 16:24].std())
    flat = View(view.camera, torch.full((40, 40, 3), 0.5))
    assert torch.equal(blur(flat, mask), flat.image)
    assert torch.equal(blur(view, torch.zeros_like(mask)), view.image)
    large = (
        torch.nn.functional.interpolate(mask[None, None].float(), scale_factor=4)[0, 0]
        > 0
    )
    assert blur.reach(large) == pytest.approx(4 * blur.reach(mask), abs=4)
    # an edge across the object
    step = view.image.where((torch.arange(40) < 20)[None, :, None], torch.ones(3))
    edges = blur(View(view.camera, step), mask).diff(dim=1).abs()[19, 14:26].amax()
    assert float(edges) < 0.4 < float(step.diff(dim=1).abs()[19, 14:26].amax())


def test_inpainting_reads_nothing_under_the_mask() -> None:
    view, mask = retouched()
    inpaint = shown("inpaint", reach=2)
    hole = grown(mask, 2)
    other = View(
        view.camera, torch.where(hole[..., None], torch.rand(40, 40, 3), view.image)
    )
    picture = inpaint(view, mask)
    assert torch.equal(inpaint(other, mask), picture)
    assert torch.equal(picture[~hole], view.image[~hole])
    # texture, and no smooth patch
    assert torch.allclose(picture[hole].std(), view.image[hole].std(), rtol=0.5)
    ramp = (torch.arange(40) / 40)[:, None, None].expand(40, 40, 3)
    sky = torch.where(
        (torch.arange(40) < 9)[:, None, None],
        torch.tensor([1.0, 0.0, 0.0]),
        ramp[:1] + 0.4,
    )
    below = inpaint(View(view.camera, sky), mask)[hole]
    # the sky's edge is not carried into the hole
    assert float((below - 0.4).abs().max()) < 1e-5
    with pytest.raises(
        InvalidValueError, match="hole to fill: expected something around it"
    ):
        inpaint(view, torch.ones_like(mask))


def test_bad_appearances_are_refused() -> None:
    for values, error in (
        ({"appearance": "blur", "reach": 2}, "reach: expected none with a blur"),
        (
            {"appearance": "fade", "blur_width": 0.1},
            "blur_width: expected none without a blur",
        ),
    ):
        with pytest.raises(InvalidValueError, match=error):
            shown(**values)  # type: ignore[arg-type]
    with pytest.raises(
        InvalidValueError,
        match="texture: expected an image file, or one of road, grass, clock, football",
    ):
        shown("paint", texture="lava")
    with pytest.raises(
        InvalidValueError, match=r"background: expected a number in \[0, 1\]"
    ):
        SceneConfig(background=(0, 0, 2))


# The look of the ground, laid on an object


EDGE = 0.6
GREY = Asset("car", (box((1.6, 0.8, 0.8), (0.8, 0.8, 0.8), centre=(0, 0, 0.4)),))
STRIPES = Asset(
    "two halves",
    tuple(
        quad([(left, -9, 0), (right, -9, 0), (right, 9, 0), (left, 9, 0)], colour)
        for left, right, colour in (
            (-9, EDGE, (0.8, 0.1, 0.1)),
            (EDGE, 9, (0.1, 0.8, 0.1)),
        )
    ),
)
LOOK = GroundLook(
    mesh_scene=MeshScene(target=GREY, surroundings=STRIPES, samples=2), reach=1
)


def redness(*points: tuple[float, float, float]) -> list[bool]:
    red, green, _ = LOOK.colours(torch.tensor(points)).unbind(-1)
    return (red > green).tolist()


@pytest.mark.usefixtures("scalar")
def test_a_point_has_the_ground_behind_it_as_seen_from_the_side_that_it_faces() -> None:
    """The top has about what is below it; on a side, which is seen from 45 degrees, the
    higher the further behind.
    """
    assert redness((-0.5, 0, 0.8), (0.0, 0, 0.8), (0.75, 0, 0.01)) == [
        True,
        True,
        False,
    ]
    assert redness((0.8, 0, 0.1), (0.8, 0, 0.3)) == [False, True]


@pytest.mark.usefixtures("scalar")
def test_the_object_has_these_colours_and_all_else_is_as_if_it_were_not_there() -> None:
    scene = LOOK.mesh_scene
    high = camera(20, 60, size=20)
    view = View(high, scene.picture(high))
    mask = scene.mask(high)
    image = LOOK(view, mask)
    around = removed(scene, reach=1)(view, mask)
    assert torch.equal(image[~mask], around[~mask])
    assert torch.equal(image[~grown(mask, 1)], view.image[~grown(mask, 1)])
    assert torch.equal(image[mask], LOOK.colours(scene.points(high)[mask]))
    ground = around[mask][:, :2].sort(-1).values.mean(0)
    # as bright as the ground
    assert torch.allclose(image[mask][:, :2].sort(-1).values.mean(0), ground, atol=0.03)
    assert name_of(LOOK) == "the ground laid on it, from elevation 45"
