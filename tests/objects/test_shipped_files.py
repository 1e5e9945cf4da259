"""The GLB files that are shipped: those that their recipes write, and what the library
reads of them.
"""

from pathlib import Path

import numpy as np
import pytest

from mi_splat.capture.mesh import Asset
from mi_splat.capture.mesh_files import load_mesh
from mi_splat.capture.objects import FOLDER, OBJECTS, object_file
from scenes.recipes.objects import BUILDERS, build
from scenes.recipes.objects.__main__ import IN_WHEEL, Shipped, shipped
from scenes.recipes.objects.examples import SEED
from scenes.recipes.objects.glb import glb_of

pytestmark = pytest.mark.shipped

ROUNDING = 1e-3
"""Metres and colours by which a recipe may differ on another processor: NumPy rounds
powers and sums differently there, and noise amplifies it.
"""
QUICK = {"car", "tv", "suitcase", "fire_hydrant", "train", "stop_sign", "black_car"}


def same(read: Asset, made: Asset, *, tolerance: float = 0.0) -> None:
    """Whether a path tracer is given the same numbers, but for the rounding of another
    processor.
    """
    assert len(read.meshes) == len(made.meshes)
    for one, other in zip(read.meshes, made.meshes, strict=True):
        np.testing.assert_allclose(one.vertices, other.vertices, rtol=0, atol=tolerance)
        np.testing.assert_array_equal(one.faces, other.faces)
        np.testing.assert_allclose(one.texture, other.texture, rtol=0, atol=tolerance)
        assert one.roughness == pytest.approx(other.roughness, abs=tolerance)
        assert one.smooth == other.smooth
        if one.texture.shape[:2] != (1, 1):
            # Mitsuba's v runs down
            down, wanted = (np.float32(1) - mesh.uvs[:, 1] for mesh in (one, other))
            np.testing.assert_allclose(down, wanted, rtol=0, atol=tolerance)


@pytest.mark.parametrize("name", OBJECTS)
def test_an_object_is_read_to_the_bit(name: str, tmp_path: Path) -> None:
    made = build(name, SEED).body
    path = tmp_path / "object.glb"
    path.write_bytes(glb_of(made))
    same(load_mesh(path), made)
    same(load_mesh(object_file(name)), made, tolerance=ROUNDING)


def rewritten(one: Shipped, folder: Path) -> None:
    """The file of a recipe is the shipped one; twice it has the same bytes."""
    data = one.data()
    assert data == one.data()
    path = folder / one.file.name
    path.write_bytes(data)
    same(load_mesh(one.file), load_mesh(path), tolerance=ROUNDING)


@pytest.mark.parametrize(
    "one",
    [one for one in shipped() if one.file.stem in QUICK],
    ids=lambda one: str(one.file.stem),
)
def test_a_recipe_writes_the_shipped_file(one: Shipped, tmp_path: Path) -> None:
    rewritten(one, tmp_path)


@pytest.mark.nightly
@pytest.mark.parametrize(
    "one",
    [one for one in shipped() if one.file.stem not in QUICK],
    ids=lambda one: str(one.file.stem),
)
def test_every_recipe_writes_the_shipped_file(one: Shipped, tmp_path: Path) -> None:
    rewritten(one, tmp_path)


def test_every_file_has_a_recipe_and_every_name_a_file() -> None:
    files = {one.file for one in shipped()}
    for folder in {file.parent for file in files}:
        assert set(folder.glob("*.glb")) == {
            file for file in files if file.parent == folder
        }
    assert tuple(BUILDERS) == OBJECTS
    assert IN_WHEEL == FOLDER
    assert sum(file.stat().st_size for file in IN_WHEEL.glob("*.glb")) < 11_000_000


def test_textures_without_floats_have_8_bits(tmp_path: Path) -> None:
    made = build("stop sign", SEED).body
    path = tmp_path / "sign.glb"
    path.write_bytes(glb_of(made, exact=False))
    read = load_mesh(path)
    differences = [
        np.abs(one.texture - other.texture).max()
        for one, other in zip(read.meshes, made.meshes, strict=True)
    ]
    assert 0 < max(differences) < 0.5 / 255 + 1e-6
