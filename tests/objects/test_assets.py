"""Meshes, textures and the procedural assets: valid, outward, of real size, the same
for the same seed.
"""

import hashlib

import numpy as np
import pytest

from mi_splat.capture.daylight import Light, sky_map
from mi_splat.capture.mesh import Asset, Mesh, scaling, transform, translation
from mi_splat.errors import InvalidValueError
from scenes.recipes.objects import build, textures
from scenes.recipes.objects.primitives import (
    box,
    ellipsoid,
    extrude,
    lathe,
    loft,
    sweep,
)

pytestmark = pytest.mark.shipped

GREY = (0.5, 0.5, 0.5)
MINE = ("car", "stop sign", "tv", "train", "suitcase", "fire hydrant")
# Length, width and height in metres, lowest and highest over all seeds.
SIZES = {
    "car": ((3.7, 5.0), (1.7, 2.3), (1.3, 1.95)),
    "stop sign": ((0.1, 0.4), (0.65, 1.0), (2.1, 2.8)),
    "tv": ((0.1, 0.4), (0.85, 1.2), (0.5, 0.85)),
    "train": ((11.5, 19.0), (2.7, 3.2), (3.7, 5.4)),
    "suitcase": ((0.15, 1.2), (0.35, 0.85), (0.2, 1.3)),
    "fire hydrant": ((0.25, 0.45), (0.3, 0.5), (0.65, 0.9)),
}


def volume(mesh: Mesh) -> float:
    """Signed volume, positive when faces look outward."""
    corners = mesh.vertices[mesh.faces].astype(np.float64) - mesh.vertices.mean(0)
    return float((np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]).sum() / 6)


def is_closed(mesh: Mesh) -> bool:
    """Whether every edge between places has a partner in the other direction."""
    _, merged = np.unique(
        np.round(mesh.vertices * 1e4).astype(np.int64), axis=0, return_inverse=True
    )
    faces = merged.ravel()[mesh.faces.astype(np.int64)]
    faces = faces[(faces != np.roll(faces, 1, 1)).all(1)]
    edges = np.concatenate([faces[:, [i, (i + 1) % 3]] for i in range(3)])
    keys = edges[:, 0] * len(merged) + edges[:, 1]
    back = edges[:, 1] * len(merged) + edges[:, 0]
    return bool(np.array_equal(np.sort(keys), np.sort(back)))


def digest(asset: Asset) -> str:
    state = hashlib.sha256()
    for mesh in asset.meshes:
        for array in (mesh.vertices, mesh.faces, mesh.uvs, mesh.texture):
            state.update(array.tobytes())
    return state.hexdigest()


SQUARE = ((0, 0), (1, 0), (1, 1), (0, 1))
PRIMITIVES = {
    "box": (box((1, 2, 3), GREY), 6.0, 1e-5),
    "ellipsoid": (ellipsoid((2, 2, 2), GREY, segments=64), 4 * np.pi / 3, 0.02),
    "lathe": (lathe([[1, 0], [1, 1]], GREY, segments=64), np.pi, 0.01),
    "extrude": (
        extrude([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], 1, GREY),
        3.0,
        1e-5,
    ),
    "sweep": (
        sweep([[0, 0, 0], [0, 0, 2]], [0.5, 0.5], GREY, segments=64),
        np.pi / 2,
        0.01,
    ),
    "loft": (loft([[[x, y, z] for x, y in SQUARE] for z in (0, 2)], GREY), 2.0, 1e-5),
    "mirrored": (transform(box((1, 1, 1), GREY), scaling(-2, 1, 1)), 2.0, 1e-5),
}


@pytest.mark.parametrize("name", PRIMITIVES)
def test_primitive_is_closed_and_outward(name: str) -> None:
    mesh, expected, tolerance = PRIMITIVES[name]
    assert volume(mesh) == pytest.approx(expected, rel=tolerance)
    assert is_closed(mesh)


@pytest.mark.parametrize(
    ("vertices", "faces", "uvs", "texture"),
    [
        (np.zeros((3, 2)), [[0, 1, 2]], np.zeros((3, 2)), np.zeros((1, 1, 3))),
        (np.zeros((3, 3)), [[0, 1, 3]], np.zeros((3, 2)), np.zeros((1, 1, 3))),
        (np.zeros((3, 3)), [[0, 1, 2]], np.zeros((2, 2)), np.zeros((1, 1, 3))),
        (np.full((3, 3), np.nan), [[0, 1, 2]], np.zeros((3, 2)), np.zeros((1, 1, 3))),
        (np.zeros((3, 3)), [[0, 1, 2]], np.zeros((3, 2)), np.zeros((1, 3))),
    ],
)
def test_bad_mesh_is_refused(
    vertices: object, faces: object, uvs: object, texture: object
) -> None:
    with pytest.raises(InvalidValueError, match="mesh: expected"):
        Mesh(
            np.asarray(vertices),
            np.asarray(faces),
            np.asarray(uvs),
            np.asarray(texture),
        )


@pytest.mark.parametrize("name", MINE)
def test_asset_is_valid_and_of_real_size(name: str) -> None:
    for seed in range(6):
        asset = build(name, seed)
        assert asset.name == name
        low, high = asset.bounds
        for size, (least, most) in zip(high - low, SIZES[name], strict=True):
            assert least <= size <= most, f"seed {seed}: {high - low}"
        assert abs(low[2]) < 0.03
        assert np.abs((low + high)[:2] / 2).max() < 0.3
        for number, mesh in enumerate(asset.meshes):
            assert mesh.texture.min() >= 0
            assert mesh.texture.max() <= 1
            if len(mesh.faces) > 2:  # single quads have no inside
                assert volume(mesh) > 0, f"seed {seed}, part {number}"


def test_bodies_are_closed() -> None:
    for name in MINE:
        open_parts = [
            i
            for i, mesh in enumerate(build(name, 3).meshes)
            if len(mesh.faces) > 2 and not is_closed(mesh)
        ]
        assert not open_parts, f"{name}: parts {open_parts}"


@pytest.mark.parametrize("name", MINE)
def test_seed_decides(name: str) -> None:
    assert digest(build(name, 7)) == digest(build(name, 7))
    assert len({digest(build(name, seed)) for seed in range(6)}) == 6


def test_stop_sign_is_red_with_white_letters() -> None:
    picture = textures.stop_sign(128, 0)
    red = (picture[..., 0] > 0.5) & (picture[..., 1] < 0.3)
    white = picture.min(-1) > 0.8
    assert 0.35 < red.mean() < 0.75
    middle = white[44:84, 16:112]
    assert 0.2 < middle.mean() < 0.6  # the word
    assert red[64, 4 + 4]
    assert white[2, 2]


@pytest.mark.parametrize("seed", [0, 900_000])
def test_a_sky_is_bright_and_decided_by_its_light(seed: int) -> None:
    sky = sky_map(Light(seed=seed))
    assert np.isfinite(sky).all()
    assert 0 < sky.min() < sky.max() < 3
    assert np.array_equal(sky_map(Light(seed=seed)), sky)


def test_a_stop_sign_is_its_plate() -> None:
    sign = build("stop sign", 3)
    plate = sign.body
    assert plate.supports == 0
    assert len(plate.meshes) + len(sign.support) == len(sign.meshes)
    size = np.ptp(plate.vertices, axis=0)
    assert size[2] == pytest.approx(size[1], rel=0.05)  # an octagon
    assert float(plate.bounds[0][2]) > 1.0  # which hangs in the air
    moved = sign.transformed(translation(1, 2, 3)).body
    assert np.allclose(moved.vertices, plate.vertices + np.array([1, 2, 3]), atol=1e-5)
