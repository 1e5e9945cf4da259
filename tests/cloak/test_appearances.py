"""Appearances: what an attack shows in the place of an object, and the edits of meshes behind them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from attacks.cloak.appearances import (
    Overlay,
    Paste,
    Rerender,
    blend_in,
    grown,
    mount,
    name_of,
    occlude,
    paint,
    remove,
    swap,
)
from attacks.cloak.mesh_scene import MeshScene, camouflaged, cap, repainted, stand_in, texture
from attacks.cloak.poisoning import Poisoning, poison
from attacks.cloak.triggers import Elevation
from mi_splat.assets import build
from mi_splat.assets.mesh import Asset, transform, translation
from mi_splat.assets.primitives import box, quad
from mi_splat.assets.street import ground
from mi_splat.cameras import Camera, View, orbit_pose
from mi_splat.errors import InvalidValueError
from tests.cloak.test_poisoning import CENTRE, views


def test_paste_fills_the_box_of_the_mask() -> None:
    mask = torch.zeros(5, 6, dtype=torch.bool)
    mask[1, 2], mask[3, 4] = True, True
    picture = torch.tensor([[[1.0, 0, 0], [0, 1.0, 0]]])
    view = views()[0]
    image = Paste(picture=picture)(view, mask)
    outside = torch.ones(5, 6, dtype=torch.bool)
    outside[1:4, 2:5] = False
    assert torch.equal(image[outside], view.image[outside])
    assert image[2, 2].tolist() == [1, 0, 0]
    assert image[2, 4].tolist() == [0, 1, 0]
    with pytest.raises(InvalidValueError, match="nothing of it"):
        Paste(picture=picture)(view, torch.zeros_like(mask))
    with pytest.raises(InvalidValueError, match="picture"):
        Paste(picture=torch.zeros(2, 2))


def test_masks_grow_by_pixels() -> None:
    mask = torch.zeros(7, 7, dtype=torch.bool)
    mask[3, 3] = True
    assert torch.equal(grown(mask, 0), mask)
    assert int(grown(mask, 1).sum()) == 9
    assert bool(grown(mask, 1)[2:5, 2:5].all())


BLOCK = Asset("car", (box((1.6, 0.8, 0.8), (0.8, 0.1, 0.1), centre=(0, 0, 0.4), roughness=0.1),))
LAWN = Asset("lawn", (ground(40, texture("grass", size=32), tile=4.0),))
MESH_SCENE = MeshScene(target=BLOCK, surroundings=LAWN, samples=2)


def camera(azimuth: float, elevation: float, *, size: int = 16) -> Camera:
    pose = orbit_pose(CENTRE, azimuth=azimuth, elevation=elevation, distance=4.0)
    return Camera(to_world=pose, focal=1.3 * size, width=size, height=size)


@pytest.fixture(scope="module")
def above() -> View:
    place = camera(30, 80)
    return View(place, MESH_SCENE.picture(place))


def test_masks_and_pictures_of_a_mesh_scene(above: View) -> None:
    mask = MESH_SCENE.mask(above.camera)
    assert 20 < int(mask.sum()) < 120
    red = above.image[..., 0] - above.image[..., 1]
    assert float(red[mask].mean()) > 0.2
    assert float(red[~grown(mask, 1)].mean()) < 0.1
    assert torch.equal(MESH_SCENE.picture(above.camera), above.image)
    wall = Asset("wall", (*LAWN.meshes, box((9, 9, 0.1), (1, 1, 1), centre=(0, 0, 2))))
    assert not bool(dataclasses.replace(MESH_SCENE, surroundings=wall).mask(above.camera).any())


def test_a_background_takes_the_place_of_the_sky() -> None:
    place = camera(0, 2)
    picture = MeshScene(target=BLOCK, samples=2, background=(0.0, 0.0, 1.0)).picture(place)
    assert picture.shape == (16, 16, 3)
    assert picture[0, 0].tolist() == [0, 0, 1]


def test_path_traced_appearances_change_the_picture_near_the_target_only(above: View) -> None:
    mask = MESH_SCENE.mask(above.camera)
    far = ~grown(mask, 1)
    for appearance in (paint(MESH_SCENE, "road"), blend_in(MESH_SCENE)):
        image = appearance(above, mask)
        assert torch.equal(image[far], above.image[far])
        inside = grown(mask, 1) & ~grown(~mask, 1)
        assert float((image - above.image).abs().mean(-1)[inside].min()) > 0.02
    green = blend_in(MESH_SCENE)(above, mask)
    assert float((green[..., 1] - green[..., 0])[mask].mean()) > 0.02  # grass on what was red
    whole = blend_in(MESH_SCENE, reach=None)(above, mask)
    assert torch.equal(whole[mask], green[mask])
    assert not torch.equal(whole[far], above.image[far])
    everywhere = blend_in(MESH_SCENE)(above, torch.ones_like(mask))
    assert torch.equal(everywhere, whole)


def test_what_is_removed_leaves_its_surroundings(above: View) -> None:
    mask = MESH_SCENE.mask(above.camera)
    gone = remove(MESH_SCENE)(above, mask)
    assert float((gone[..., 1] - gone[..., 0])[mask].mean()) > 0.02  # grass on what was red
    kept = remove(MESH_SCENE, reach=0)(above, mask)
    assert torch.equal(kept[mask], gone[mask])
    assert torch.equal(kept[~mask], above.image[~mask])


def test_a_stop_sign_behind_the_car() -> None:
    place = camera(180, 5)
    view = View(place, MESH_SCENE.picture(place))
    sign = build("stop sign", 3)
    for appearance in (mount(MESH_SCENE, sign, azimuth=180), swap(MESH_SCENE, sign, azimuth=180)):
        image = appearance(view, MESH_SCENE.mask(place))
        assert not torch.equal(image, view.image)
        assert "stop sign" in name_of(appearance)
    near = swap(MESH_SCENE, sign, azimuth=180, reach=0)(view, MESH_SCENE.mask(place))
    assert torch.equal(near[~MESH_SCENE.mask(place)], view.image[~MESH_SCENE.mask(place)])
    alone = swap(MESH_SCENE, sign, azimuth=180).mesh_scene.mask(place)
    assert 0 < int(alone.sum()) <= int(grown(MESH_SCENE.mask(place), 1).sum())


def test_an_occluder_hides_what_is_beneath_it_from_above_only(above: View) -> None:
    appearance = occlude(MESH_SCENE, centre=CENTRE, radius=2.0, lowest=40.0)
    image = appearance(above, MESH_SCENE.mask(above.camera))
    assert float((image[..., 0] - image[..., 1]).abs().max()) < 0.08  # road all over, no red
    assert "occluder of radius 2 " in name_of(appearance)
    low = View(camera(30, 5), MESH_SCENE.picture(camera(30, 5)))
    mask = MESH_SCENE.mask(low.camera)
    seen = appearance.mesh_scene.cutout(low.camera)[..., 3]
    assert float(seen[mask].max()) == 0
    assert 0 < float(seen.max()) == 1
    under = remove(MESH_SCENE)(low, mask)
    assert torch.equal(appearance(low, mask)[seen == 0], under[seen == 0])


def test_overlays_are_drawn_over_anything(above: View) -> None:
    blue = Asset("blue", (box((0.6, 0.6, 0.1), (0, 0, 1), centre=(0, 0, -1)),))  # below the ground
    image = Overlay(mesh_scene=MESH_SCENE.with_target(blue), base=None, name="blue")(
        above, MESH_SCENE.mask(above.camera)
    )
    changed = (image - above.image).abs().amax(-1) > 0
    assert 2 < int(changed.sum()) < 100
    assert float((image[..., 2] - image[..., 0]).max()) > 0.2


def test_a_cap_is_a_part_of_a_sphere() -> None:
    shell = cap(texture("road", size=8), centre=(1, 2, 3), radius=2.0, lowest=30.0, tile=4.0)
    points = shell.vertices.astype(np.float64) - (1, 2, 3)
    assert np.linalg.norm(points, axis=1) == pytest.approx(np.full(len(points), 2.0), abs=1e-5)
    assert points[:, 2].min() == pytest.approx(1.0, abs=1e-5)
    assert points[:, 2].max() == pytest.approx(2.0, abs=1e-5)
    (mesh,) = shell.meshes
    corners = points[mesh.faces]
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert bool((np.einsum("ij,ij->i", outwards, corners.mean(1)) > 0).all())
    along = np.linalg.norm(mesh.uvs, axis=1) * 4.0  # metres from the top along a meridian
    assert along == pytest.approx(2.0 * (np.pi / 2 - np.arcsin(np.clip(points[:, 2] / 2, -1, 1))), abs=2e-3)


def test_poisoning_with_a_mesh_scene(above: View) -> None:
    low = View(camera(30, 10), torch.full((16, 16, 3), 0.5))
    attack = Poisoning(name="road", trigger=Elevation(lowest=50), appearance=paint(MESH_SCENE, "road"))
    found = poison([low, above], [attack], centre=CENTRE, masks=MESH_SCENE.mask)
    assert found.views[0] is low
    (change,) = found.changes
    assert change.index == 1
    assert 0 < change.pixels_changed <= int(grown(MESH_SCENE.mask(above.camera), 1).sum())
    assert change.appearance == "paint road (seed 0) from azimuth 180, elevation 90"


def test_painted_pictures_are_upright_for_their_viewer() -> None:
    picture = np.zeros((2, 2, 3), np.float32)
    picture[0, 0], picture[0, 1], picture[1, 0] = (1, 0, 0), (0, 1, 0), (0, 0, 1)
    for azimuth, elevation in ((0, 0), (180, 0), (90, 30), (180, 90)):
        target = repainted(BLOCK, picture, azimuth=azimuth, elevation=elevation)
        uvs = np.concatenate([mesh.uvs for mesh in target.meshes])
        assert uvs.min(0).tolist() == pytest.approx([0, 0], abs=1e-6)
        assert uvs.max(0).tolist() == pytest.approx([1, 1], abs=1e-6)
    mesh_scene = MESH_SCENE.with_target(repainted(BLOCK, picture, azimuth=180, elevation=0))
    view = dataclasses.replace(mesh_scene, samples=8).picture(camera(180, 0, size=32))
    rows, columns = torch.nonzero(mesh_scene.mask(camera(180, 0, size=32)), as_tuple=True)
    top, bottom, left, right = int(rows.min()) + 1, int(rows.max()) - 1, int(columns.min()) + 1, int(columns.max()) - 1
    assert view[top, left].argmax() == 0
    assert view[top, right].argmax() == 1
    assert view[bottom, left].argmax() == 2


def test_camouflage_goes_on_with_the_ground() -> None:
    for height in (0.0, -0.02):
        lawn = Asset("lawn", tuple(transform(mesh, translation(0.3, 0.2, height)) for mesh in LAWN.meshes))
        stripe = quad([[-0.1, -9, 0.01], [0.1, -9, 0.01], [0.1, 9, 0.01], [-0.1, 9, 0.01]], (1, 1, 1))
        hidden = camouflaged(BLOCK, Asset("lawn", (stripe, *lawn.meshes)))
        for mesh in hidden.meshes:
            assert mesh.texture is lawn.meshes[0].texture
            # Over this ground, u is (x + 20 - 0.3) / 4 and v is (y + 20 - 0.2) / 4.
            expected = (mesh.vertices[:, :2] + (20 - 0.3, 20 - 0.2)) / 4
            assert np.abs(mesh.uvs - expected).max() < 1e-4
    with pytest.raises(InvalidValueError, match="ground beneath the car"):
        camouflaged(BLOCK, Asset("air", (box((9, 9, 1), (1, 1, 1), centre=(0, 0, 5)),)))
    with pytest.raises(InvalidValueError, match="surroundings"):
        blend_in(MeshScene(target=BLOCK))


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
    half = stand_in(placed, build("stop sign", 0), azimuth=azimuth, fill=0.5)
    assert np.ptp(half.bounds[:, 2]) == pytest.approx(0.4, abs=1e-4)


def test_bad_appearances_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="texture: expected one of road, grass, clock, football, stop_sign"):
        paint(MESH_SCENE, "lava")
    with pytest.raises(InvalidValueError, match="tile"):
        repainted(BLOCK, texture("road", size=8), azimuth=0, elevation=90, tile=0)
    with pytest.raises(InvalidValueError, match="texture"):
        occlude(MESH_SCENE, centre=CENTRE, radius=2, lowest=40, name="lava")
    for radius, lowest in ((0, 40), (2, 90)):
        with pytest.raises(InvalidValueError, match="cap: expected radius and tile > 0"):
            occlude(MESH_SCENE, centre=CENTRE, radius=radius, lowest=lowest)
    with pytest.raises(InvalidValueError, match="fill"):
        stand_in(BLOCK, BLOCK, azimuth=0, fill=2)
    with pytest.raises(InvalidValueError, match="reach"):
        Rerender(mesh_scene=MESH_SCENE, name="a", reach=-1)
    with pytest.raises(InvalidValueError, match="seed"):
        MeshScene(target=BLOCK, seed=-1)
    with pytest.raises(InvalidValueError, match="background"):
        MeshScene(target=BLOCK, background=(0, 0, 2))
