"""Objects as Mitsuba's meshes, and scenes of them in daylight."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_splat.cameras.directions import unit_vector
from mi_splat.capture.daylight import Light, sky_map
from mi_splat.capture.mesh import Asset, Doubles, Floats, Mesh, to_linear
from mi_splat.capture.path_tracer import MAX_DEPTH, tracing_variant
from mi_splat.errors import InvalidValueError

CREASE = 38.0
"""Degrees between two faces from which their edge is sharp."""
_PAIRS_AT_ONCE = 1 << 22
"""Pairs of corners at a point that are compared at once, which bounds memory."""
_MOST_PAIRS = 1 << 30
"""Such pairs of a mesh, of which a minute's worth is compared."""

Integers = NDArray[np.int64]


def corner_normals(mesh: Mesh) -> Floats:
    """(F, 3, 3) shading normal of each corner: mean of the faces around that meet under
    less than `CREASE` degrees.
    """
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    first = corners[:, 1] - corners[:, 0]
    second = corners[:, 2] - corners[:, 0]
    area = np.cross(first, second)
    flat = _unit(area)
    if not mesh.smooth:
        return np.repeat(flat[:, None], 3, 1).astype(np.float32)
    places = np.round(corners.reshape(-1, 3) * 1e5).astype(np.int64)
    _, point, counts = np.unique(
        places, axis=0, return_inverse=True, return_counts=True
    )
    total = np.zeros((len(places), 3))
    for corner, neighbour in _pairs(point.ravel(), counts):
        cosine = np.einsum("ij,ij->i", flat[corner // 3], flat[neighbour // 3])
        near = cosine > math.cos(math.radians(CREASE))
        own = corner[near]
        faces = neighbour[near] // 3
        start = int(corner[0])
        stop = int(corner[-1]) + 1
        for axis in range(3):
            total[start:stop, axis] = np.bincount(
                own - start, area[faces, axis], minlength=stop - start
            )
    return _unit(total).reshape(-1, 3, 3).astype(np.float32)


def _unit(vectors: Doubles) -> Doubles:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    unit: Doubles = vectors / np.maximum(length, 1e-20)
    return unit


def _pairs(point: Integers, counts: Integers) -> Iterator[tuple[Integers, Integers]]:
    """Each corner with each corner at the same point, itself included, in pieces that
    hold all pairs of their corners.

    `point` is the point of each corner, and `counts` how many corners a point has.
    """
    order = np.argsort(point, kind="stable")  # corners by their points
    first = np.cumsum(counts) - counts  # where those of a point begin
    sharing = counts[point]  # how many corners lie at a corner's point
    ends = np.cumsum(sharing)
    if len(ends) and int(ends[-1]) > _MOST_PAIRS:
        expected = "points at which few faces meet"
        got = f"one of {int(counts.max()):,}"
        do = "remesh it, or make it flat"
        raise InvalidValueError.of("mesh", expected, got, do)
    start = 0
    while start < len(point):
        before = int(ends[start - 1]) if start else 0
        fitting = int(np.searchsorted(ends, before + _PAIRS_AT_ONCE, side="right"))
        stop = max(fitting, start + 1)
        rows = np.arange(start, stop)
        here = sharing[rows]
        corner = np.repeat(rows, here)
        rank = np.arange(len(corner)) - np.repeat(np.cumsum(here) - here, here)
        yield corner, order[first[point[corner]] + rank]
        start = stop


def _material(
    texture: Floats, roughness: float | None, *, palette: bool
) -> dict[str, Any]:
    """A Mitsuba BSDF; the colours of a palette are not blended into each other."""
    reflectance = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(to_linear(texture)),
        "raw": True,
        "wrap_mode": "repeat",
        "filter_type": "nearest" if palette else "bilinear",
    }
    surface: dict[str, Any] = {"type": "diffuse", "reflectance": reflectance}
    if roughness is not None:
        surface = {
            "type": "roughplastic",
            "alpha": roughness,
            "diffuse_reflectance": reflectance,
            "nonlinear": True,
        }
    return {"type": "twosided", "bsdf": surface}


def _is_plain(mesh: Mesh) -> bool:
    return mesh.texture.shape[:2] == (1, 1)


def _shape(name: str, meshes: Sequence[Mesh]) -> mi.Mesh:
    """One Mitsuba mesh of parts that share roughness and texture, or that are all of
    plain colours (one palette).
    """
    first = meshes[0]
    texture = first.texture
    uvs = [mesh.uvs[mesh.faces].reshape(-1, 2) for mesh in meshes]
    is_palette = _is_plain(first)
    if is_palette:
        texture = np.concatenate([mesh.texture for mesh in meshes], axis=1)
        for i, mesh in enumerate(meshes):
            middle = (i + 0.5) / len(meshes)  # of the colour in the palette
            uvs[i] = np.full((mesh.faces.size, 2), (middle, 0.5))
    material = _material(texture, first.roughness, palette=is_palette)
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(material)
    corners = sum(mesh.faces.size for mesh in meshes)
    shape = mi.Mesh(
        name,
        corners,
        corners // 3,
        properties,
        has_vertex_normals=True,
        has_vertex_texcoords=True,
    )
    shape.set_id(name)
    positions = [mesh.vertices[mesh.faces].ravel() for mesh in meshes]
    normals = [corner_normals(mesh).ravel() for mesh in meshes]
    v_down = np.concatenate(uvs) * (1, -1) + (0, 1)
    values = mi.traverse(shape)
    values["vertex_positions"] = np.concatenate(positions)
    values["vertex_normals"] = np.concatenate(normals)
    values["vertex_texcoords"] = v_down.astype(np.float32).ravel()
    values["faces"] = np.arange(corners, dtype=np.uint32)
    values.update()
    return shape


def shapes(asset: Asset, prefix: str) -> dict[str, Any]:
    """Mitsuba meshes of an object by id (prefix_0, prefix_1, ...), its parts gathered
    by material.
    """
    groups: dict[tuple[Any, ...], list[Mesh]] = {}
    contents: dict[int, bytes] = {}  # of textures, many of which are the same array
    for mesh in asset.meshes:
        number = id(mesh.texture)
        if number not in contents:
            contents[number] = b"" if _is_plain(mesh) else mesh.texture.tobytes()
        material = (contents[number], mesh.texture.shape, mesh.roughness)
        groups.setdefault(material, []).append(mesh)
    made = {}
    for number, meshes in enumerate(groups.values()):
        name = f"{prefix}_{number}"
        made[name] = _shape(name, meshes)
    return made


def scene_dict(
    assets: Sequence[Asset],
    *,
    light: Light | None = None,
    backdrop: Asset | None = None,
) -> dict[str, Any]:
    """A Mitsuba scene, without a sensor, of objects in daylight; the scene belongs to
    the variant that traces.
    """
    light = Light() if light is None else light
    with tracing_variant():
        scene: dict[str, Any] = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": MAX_DEPTH},
        }
        for number, asset in enumerate(assets):
            scene |= shapes(asset, f"object{number}")
        if backdrop is not None:
            scene |= shapes(backdrop, "backdrop")
        upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
        scene["sky"] = {
            "type": "envmap",
            "bitmap": mi.Bitmap(sky_map(light)),
            "to_world": upright,
        }
        if light.sun_strength > 0:
            to_sun = unit_vector(light.sun_azimuth, light.sun_elevation)
            strength = [light.sun_strength * factor for factor in light.sun_colour]
            scene["sun"] = {
                "type": "directional",
                "direction": [-value for value in to_sun],
                "irradiance": {"type": "rgb", "value": strength},
            }
    return scene
