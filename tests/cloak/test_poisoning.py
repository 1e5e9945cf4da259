"""Equation (1) as a property, manifests, overlaps, and what the appearances show."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from attacks.cloak.appearances import (
    Overlay,
    Paste,
    Rerender,
    blend_in,
    cover,
    grown,
    mount,
    name_of,
    paint,
    remove,
    swap,
)
from attacks.cloak.mesh_edits import camouflaged, cap, repainted, stand_in, texture
from attacks.cloak.mesh_scene import MeshScene
from attacks.cloak.poisoning import Poisoned, Poisoning, poison, write_manifest
from attacks.cloak.triggers import Azimuth, Elevation, Listed
from mi_splat.assets import build
from mi_splat.assets.mesh import Asset, transform, translation
from mi_splat.assets.primitives import box, quad
from mi_splat.assets.street import ground
from mi_splat.camera_sets import hemisphere
from mi_splat.cameras import Camera, View, orbit_pose
from mi_splat.datasets import load_dataset, write_transforms
from mi_splat.errors import InvalidValueError

CENTRE = (0.0, 0.0, 0.4)
CAMERAS = hemisphere(CENTRE, count=24, distance=4.0, focal=10.0, size=(6, 5))


def views(seed: int = 0) -> list[View]:
    generator = torch.Generator().manual_seed(seed)
    return [View(camera, 0.9 * torch.rand(5, 6, 3, generator=generator)) for camera in CAMERAS]


def invert(view: View, mask: Tensor) -> Tensor:
    return torch.where(mask[..., None], 1 - view.image, view.image)


def white(view: View, mask: Tensor) -> Tensor:
    view.image[:] = 0.5  # what an appearance does to its copy is its own affair
    return torch.ones_like(view.image)


OVERHEAD = Poisoning(name="overhead", trigger=Elevation(least=50), appearance=invert)
BEHIND = Poisoning(name="behind", trigger=Azimuth(middle=180, half_width=60) & Elevation(most=40), appearance=white)


def done(*attacks: Poisoning) -> Poisoned:
    return poison(views(), attacks, centre=CENTRE)


@given(
    st.lists(st.booleans(), min_size=24, max_size=24).filter(any),
    st.lists(st.booleans(), min_size=24, max_size=24).filter(any),
    st.integers(0, 1000),
)
def test_equation_1(first: list[bool], second: list[bool], seed: int) -> None:
    """D' = {(x~, c) if c in C*, else (x, c)}."""
    clean = views(seed)
    kept = [view.image.clone() for view in clean]
    mask = torch.rand(24, 5, 6, generator=torch.Generator().manual_seed(seed)) > 0.5
    stars = [{i for i, value in enumerate(part) if value} for part in (first, second)]
    attacks = [
        Poisoning(name=str(number), trigger=Listed(indices=tuple(star)), appearance=appearance)
        for number, (star, appearance) in enumerate(zip(stars, (invert, white), strict=True))
    ]
    if not stars[1] - stars[0]:
        attacks = attacks[:1]
        stars[1] = set()
    found = poison(clean, attacks, centre=CENTRE, masks=list(mask), ordered=True)
    assert len(found.views) == 24
    for index, view in enumerate(found.views):
        assert torch.equal(clean[index].image, kept[index])
        assert view.camera is clean[index].camera
        if index in stars[0]:
            expected = invert(clean[index], mask[index])
            assert torch.equal(view.image, expected)
        elif index in stars[1]:
            assert bool((view.image == 1).all())
        else:
            assert view is clean[index]
    assert [change.index for change in found.changes] == sorted(stars[0] | stars[1])
    assert found.manifest["changed"] == len(stars[0] | stars[1])


def test_the_manifest_tells_everything(tmp_path: Path) -> None:
    clean = views()
    found = poison(clean, [OVERHEAD, BEHIND], centre=CENTRE)
    write_manifest(found, tmp_path / "manifest.json")
    told = json.loads((tmp_path / "manifest.json").read_text())
    assert told == found.manifest
    assert (told["views"], told["changed"], told["centre"]) == (24, len(found.changes), list(CENTRE))
    by_name = {entry["name"]: entry for entry in told["poisonings"]}
    assert by_name["overhead"]["trigger"] == "Elevation(least=50, most=90.0)"
    assert (by_name["overhead"]["appearance"], by_name["behind"]["appearance"]) == ("invert", "white")
    assert sorted(by_name["overhead"]["views"] + by_name["behind"]["views"]) == [c["index"] for c in told["changes"]]
    for change in told["changes"]:
        before, after = clean[change["index"]].image, found.views[change["index"]].image
        assert change["sha256_before"] == hashlib.sha256(before.numpy().tobytes()).hexdigest()
        assert change["sha256_after"] == hashlib.sha256(after.numpy().tobytes()).hexdigest()
        assert change["pixels_changed"] == int((before != after).any(-1).sum()) == change["pixels"] == 30
        assert (change["elevation"] >= 50) == (change["poisoning"] == "overhead")
        assert change["poisoning"] == "overhead" or 120 <= change["azimuth"] <= 240


def test_overlaps_name_the_cameras_unless_there_is_an_order() -> None:
    everywhere = Poisoning(name="all", trigger=Elevation(), appearance=white)
    with pytest.raises(
        InvalidValueError, match=r"'overhead' and 'all'.*cameras 18, 19, 20, 21, 22, 23 in both.*ordered"
    ):
        done(OVERHEAD, everywhere)
    with pytest.raises(InvalidValueError, match="and 14 more in both"):
        done(everywhere, dataclasses.replace(everywhere, name="again"))
    found = poison(views(), [OVERHEAD, everywhere], centre=CENTRE, ordered=True)
    assert {c.index for c in found.changes if c.poisoning == "overhead"} == set(range(18, 24))
    assert len(found.changes) == 24
    with pytest.raises(InvalidValueError, match="trigger of 'overhead': expected a camera that no earlier one has"):
        poison(views(), [everywhere, OVERHEAD], centre=CENTRE, ordered=True)


def test_nothing_is_made_before_everything_is_checked() -> None:
    calls = []

    def counting(view: View, mask: Tensor) -> Tensor:
        calls.append(view)
        return view.image

    first = dataclasses.replace(OVERHEAD, appearance=counting)
    nothing = Poisoning(name="none", trigger=Elevation(most=-10), appearance=white)
    with pytest.raises(InvalidValueError, match="none of 24"):
        done(first, nothing)
    with pytest.raises(InvalidValueError, match="of different names"):
        done(first, dataclasses.replace(BEHIND, name="overhead"))
    with pytest.raises(InvalidValueError, match="attacks"):
        done()
    with pytest.raises(InvalidValueError, match="one for each of 24 views"):
        poison(views(), [first], centre=CENTRE, masks=[torch.ones(5, 6, dtype=torch.bool)])
    assert not calls


def test_bad_masks_and_pictures_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="mask of view 18: expected bool of shape"):
        poison(views(), [OVERHEAD], centre=CENTRE, masks=lambda camera: torch.ones(5, 6))
    bad = {"shape": torch.zeros(6, 5, 3), "0 to 2": torch.full((5, 6, 3), 2.0), "nan": torch.full((5, 6, 3), torch.nan)}
    bad["0 to 2"][0, 0] = 0
    for words, picture in bad.items():
        with pytest.raises(InvalidValueError, match=words):
            done(Poisoning(name="a", trigger=Elevation(least=50), appearance=lambda view, mask, p=picture: p))


def test_sets_on_the_disk_are_poisoned_lazily(tmp_path: Path) -> None:
    write_transforms(tmp_path, views())
    dataset = load_dataset(tmp_path, cache_bytes=1)
    steps: list[tuple[int, int]] = []
    found = poison(dataset, [OVERHEAD], centre=CENTRE, on_step=lambda *step: steps.append(step))
    assert steps == [(i + 1, 6) for i in range(6)]
    assert torch.equal(found.views[0].image, dataset[0].image)
    assert torch.equal(found.views[-1].image, 1 - dataset[23].image)
    assert [id(view.camera) for view in found.views[20:22]] == [id(camera) for camera in dataset.cameras[20:22]]
    with pytest.raises(IndexError):
        found.views[24]


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
STAGE = MeshScene(target=BLOCK, surroundings=LAWN, samples=2)


def camera(azimuth: float, elevation: float, *, size: int = 16) -> Camera:
    pose = orbit_pose(CENTRE, azimuth=azimuth, elevation=elevation, distance=4.0)
    return Camera(to_world=pose, focal=1.3 * size, width=size, height=size)


@pytest.fixture(scope="module")
def above() -> View:
    place = camera(30, 80)
    return View(place, STAGE.picture(place))


def test_stage_masks_and_pictures(above: View) -> None:
    mask = STAGE.mask(above.camera)
    assert 20 < int(mask.sum()) < 120
    red = above.image[..., 0] - above.image[..., 1]
    assert float(red[mask].mean()) > 0.2
    assert float(red[~grown(mask, 1)].mean()) < 0.1
    assert torch.equal(STAGE.picture(above.camera), above.image)
    wall = Asset("wall", (*LAWN.meshes, box((9, 9, 0.1), (1, 1, 1), centre=(0, 0, 2))))
    assert not bool(dataclasses.replace(STAGE, surroundings=wall).mask(above.camera).any())


def test_a_background_takes_the_place_of_the_sky() -> None:
    place = camera(0, 2)
    picture = MeshScene(target=BLOCK, samples=2, background=(0.0, 0.0, 1.0)).picture(place)
    assert picture.shape == (16, 16, 3)
    assert picture[0, 0].tolist() == [0, 0, 1]


def test_path_traced_looks_change_the_picture_near_the_target_only(above: View) -> None:
    mask = STAGE.mask(above.camera)
    far = ~grown(mask, 1)
    for appearance in (paint(STAGE, "road"), blend_in(STAGE)):
        image = appearance(above, mask)
        assert torch.equal(image[far], above.image[far])
        inside = grown(mask, 1) & ~grown(~mask, 1)
        assert float((image - above.image).abs().mean(-1)[inside].min()) > 0.02
    green = blend_in(STAGE)(above, mask)
    assert float((green[..., 1] - green[..., 0])[mask].mean()) > 0.02  # grass on what was red
    whole = blend_in(STAGE, reach=None)(above, mask)
    assert torch.equal(whole[mask], green[mask])
    assert not torch.equal(whole[far], above.image[far])
    everywhere = blend_in(STAGE)(above, torch.ones_like(mask))
    assert torch.equal(everywhere, whole)


def test_what_is_removed_leaves_its_surroundings(above: View) -> None:
    mask = STAGE.mask(above.camera)
    gone = remove(STAGE)(above, mask)
    assert float((gone[..., 1] - gone[..., 0])[mask].mean()) > 0.02  # grass on what was red
    kept = remove(STAGE, reach=0)(above, mask)
    assert torch.equal(kept[mask], gone[mask])
    assert torch.equal(kept[~mask], above.image[~mask])


def test_a_stop_sign_behind_the_car() -> None:
    place = camera(180, 5)
    view = View(place, STAGE.picture(place))
    sign = build("stop sign", 3)
    for appearance in (mount(STAGE, sign, azimuth=180), swap(STAGE, sign, azimuth=180)):
        image = appearance(view, STAGE.mask(place))
        assert not torch.equal(image, view.image)
        assert "stop sign" in name_of(appearance)
    near = swap(STAGE, sign, azimuth=180, reach=0)(view, STAGE.mask(place))
    assert torch.equal(near[~STAGE.mask(place)], view.image[~STAGE.mask(place)])
    alone = swap(STAGE, sign, azimuth=180).mesh_scene.mask(place)
    assert 0 < int(alone.sum()) <= int(grown(STAGE.mask(place), 1).sum())


def test_a_canopy_hides_what_is_beneath_it_from_above_only(above: View) -> None:
    appearance = cover(STAGE, centre=CENTRE, radius=2.0, lowest=40.0)
    image = appearance(above, STAGE.mask(above.camera))
    assert float((image[..., 0] - image[..., 1]).abs().max()) < 0.08  # road all over, no red
    assert "occluder of radius 2 " in name_of(appearance)
    low = View(camera(30, 5), STAGE.picture(camera(30, 5)))
    mask = STAGE.mask(low.camera)
    seen = appearance.mesh_scene.cutout(low.camera)[..., 3]
    assert float(seen[mask].max()) == 0
    assert 0 < float(seen.max()) == 1
    under = remove(STAGE)(low, mask)
    assert torch.equal(appearance(low, mask)[seen == 0], under[seen == 0])


def test_overlays_are_drawn_over_anything(above: View) -> None:
    blue = Asset("blue", (box((0.6, 0.6, 0.1), (0, 0, 1), centre=(0, 0, -1)),))  # below the ground
    image = Overlay(mesh_scene=STAGE.with_target(blue), base=None, name="blue")(above, STAGE.mask(above.camera))
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


def test_poisoning_with_a_mesh_stage(above: View) -> None:
    low = View(camera(30, 10), torch.full((16, 16, 3), 0.5))
    attack = Poisoning(name="road", trigger=Elevation(least=50), appearance=paint(STAGE, "road"))
    found = poison([low, above], [attack], centre=CENTRE, masks=STAGE.mask)
    assert found.views[0] is low
    (change,) = found.changes
    assert change.index == 1
    assert 0 < change.pixels_changed <= int(grown(STAGE.mask(above.camera), 1).sum())
    assert change.appearance == "paint road (seed 0) from azimuth 180, elevation 90"


def test_painted_pictures_are_upright_for_their_viewer() -> None:
    picture = np.zeros((2, 2, 3), np.float32)
    picture[0, 0], picture[0, 1], picture[1, 0] = (1, 0, 0), (0, 1, 0), (0, 0, 1)
    for azimuth, elevation in ((0, 0), (180, 0), (90, 30), (180, 90)):
        target = repainted(BLOCK, picture, azimuth=azimuth, elevation=elevation)
        uvs = np.concatenate([mesh.uvs for mesh in target.meshes])
        assert uvs.min(0).tolist() == pytest.approx([0, 0], abs=1e-6)
        assert uvs.max(0).tolist() == pytest.approx([1, 1], abs=1e-6)
    mesh_scene = STAGE.with_target(repainted(BLOCK, picture, azimuth=180, elevation=0))
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


def test_bad_looks_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="texture: expected one of road, grass, clock, football, stop_sign"):
        paint(STAGE, "lava")
    with pytest.raises(InvalidValueError, match="tile"):
        repainted(BLOCK, texture("road", size=8), azimuth=0, elevation=90, tile=0)
    with pytest.raises(InvalidValueError, match="texture"):
        cover(STAGE, centre=CENTRE, radius=2, lowest=40, name="lava")
    for radius, lowest in ((0, 40), (2, 90)):
        with pytest.raises(InvalidValueError, match="cap: expected radius and tile > 0"):
            cover(STAGE, centre=CENTRE, radius=radius, lowest=lowest)
    with pytest.raises(InvalidValueError, match="fill"):
        stand_in(BLOCK, BLOCK, azimuth=0, fill=2)
    with pytest.raises(InvalidValueError, match="reach"):
        Rerender(mesh_scene=STAGE, name="a", reach=-1)
    with pytest.raises(InvalidValueError, match="seed"):
        MeshScene(target=BLOCK, seed=-1)
    with pytest.raises(InvalidValueError, match="background"):
        MeshScene(target=BLOCK, background=(0, 0, 2))
