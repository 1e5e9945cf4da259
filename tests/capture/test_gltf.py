"""What nodes place, how triangles are stored, and what a file says of surfaces; trimesh
is the oracle of places.
"""

import base64
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mi_splat.capture import mesh_files
from mi_splat.capture.gltf import Glb, packed
from mi_splat.capture.mesh import Asset
from mi_splat.capture.mesh_files import COAT, load_mesh
from mi_splat.errors import MiSplatError

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]], "<f4")
TWO = np.array([0, 1, 2, 0, 2, 3], "<u2")
STRIP = np.array([0, 1, 3, 2], "<u2")


def written(
    folder: Path,
    *,
    order: NDArray[Any] = TWO,
    nodes: list[dict[str, Any]] | None = None,
    buffer: dict[str, Any] | None = None,
    material: dict[str, Any] | None = None,
    **primitive: Any,
) -> Path:
    """A GLB of a square that is a little bent."""
    data = CORNERS.tobytes() + order.tobytes()
    size = CORNERS.nbytes
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes or [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0},
                        "indices": 1,
                        "material": 0,
                        **primitive,
                    }
                ]
            }
        ],
        "materials": [material or {}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": len(CORNERS),
                "type": "VEC3",
                "min": CORNERS.min(0).tolist(),
                "max": CORNERS.max(0).tolist(),
            },
            {
                "bufferView": 1,
                "componentType": 5123,
                "count": len(order),
                "type": "SCALAR",
            },
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": size},
            {"buffer": 0, "byteOffset": size, "byteLength": order.nbytes},
        ],
        "buffers": [buffer or {"byteLength": len(data)}],
    }
    path = folder / "square.glb"
    path.write_bytes(packed(document, data))
    return path


def triangles(asset: Asset) -> NDArray[np.float32]:
    """(F, 3, 3) corners, sorted."""
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in asset.meshes])
    rows = corners.reshape(len(corners), -1)
    return corners[np.lexsort(rows.T)]


TREE: list[dict[str, Any]] = [
    {"translation": [0.1, 0.2, 0.3], "children": [1, 2]},
    {"rotation": [0.1, 0.2, 0.3, 0.9], "scale": [1, 2, -3], "mesh": 0},
    {"matrix": [1, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0, 0.5, 0, 0, 1], "children": [3]},
    {"mesh": 0},
]


def test_nodes_place_as_in_trimesh(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    path = written(tmp_path, nodes=TREE)
    scene = trimesh.load_scene(path, process=False)
    wanted = np.concatenate([mesh.triangles for mesh in scene.dump()])
    z_up = np.stack([wanted[..., 0], -wanted[..., 2], wanted[..., 1]], axis=-1)
    rows = z_up.astype(np.float32).reshape(len(z_up), -1).round(4)
    ours = triangles(load_mesh(path)).reshape(len(z_up), -1).round(4)
    # trimesh may begin a triangle with another corner
    assert np.allclose(
        np.sort(rows.reshape(-1, 3), axis=0),
        np.sort(ours.reshape(-1, 3), axis=0),
        atol=1e-4,
    )


def test_a_mirror_leaves_faces_outward(tmp_path: Path) -> None:
    (plain,) = load_mesh(written(tmp_path)).meshes
    node = {"mesh": 0, "scale": [1, 1, -1]}
    (mirrored,) = load_mesh(written(tmp_path, nodes=[node])).meshes
    assert np.array_equal(mirrored.faces, plain.faces[:, ::-1])


def test_a_strip_is_the_same_square(tmp_path: Path) -> None:
    square = load_mesh(written(tmp_path)).meshes[0]
    strip = load_mesh(written(tmp_path, order=STRIP, mode=5)).meshes[0]
    normals = []
    for mesh in (square, strip):
        a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
        normals.append(np.cross(b - a, c - a))
        assert len(mesh.faces) == 2
    assert (normals[0] @ normals[1].T > 0).all()


def test_lines_and_points_are_left_out(tmp_path: Path) -> None:
    with pytest.raises(MiSplatError, match="no faces"):
        load_mesh(written(tmp_path, mode=1))


def test_a_buffer_may_stand_in_the_document(tmp_path: Path) -> None:
    data = CORNERS.tobytes() + TWO.tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    buffer = {"byteLength": len(data), "uri": uri}
    read = load_mesh(written(tmp_path, buffer=buffer))
    assert np.array_equal(triangles(read), triangles(load_mesh(written(tmp_path))))


def test_a_clear_coat_is_gloss_and_a_flat_primitive_is_flat(tmp_path: Path) -> None:
    coat = {"clearcoatFactor": 1.0, "clearcoatRoughnessFactor": 0.3}
    material = {"extensions": {COAT: coat}}
    path = written(tmp_path, material=material, extras={"flat": True})
    (glossy,) = load_mesh(path).meshes
    assert glossy.roughness == pytest.approx(0.09)
    assert not glossy.smooth
    (plain,) = load_mesh(written(tmp_path)).meshes
    assert plain.roughness is None
    assert plain.smooth


def test_few_nodes_place_no_more_than_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes: list[dict[str, Any]] = [{"children": [1, 2, 3]}, *[{"mesh": 0}] * 3]
    path = written(tmp_path, nodes=nodes)
    assert len(triangles(load_mesh(path))) == 6
    monkeypatch.setattr(mesh_files, "MOST_TRIANGLES", 5)
    with pytest.raises(MiSplatError, match="more than 5 triangles"):
        load_mesh(path)


def test_draco_is_unpacked_where_it_is_installed(tmp_path: Path) -> None:
    draco = pytest.importorskip("DracoPy")
    data = draco.encode(CORNERS, TWO, quantization_bits=24)
    name = "KHR_draco_mesh_compression"
    glb = Glb.read(written(tmp_path, extensions={name: {"bufferView": 0}}))
    glb.document["extensionsRequired"] = [name]
    glb.document["bufferViews"][0] = {"buffer": 0, "byteLength": len(data)}
    glb.document["buffers"] = [{"byteLength": len(data)}]
    path = tmp_path / "packed.glb"
    path.write_bytes(packed(glb.document, data))
    read, wanted = (
        np.sort(triangles(load_mesh(file)).reshape(-1, 3), axis=0)
        for file in (path, written(tmp_path))
    )
    assert np.allclose(read, wanted, atol=1e-4)
