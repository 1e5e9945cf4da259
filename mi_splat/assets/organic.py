"""Organic bodies: the skins of implicit bodies, painted as solids.

A body is a sequence of layers (skin, shirt, hair, ...). Inside a layer the primitives melt into each other; layers meet
in a crease, and the layer on the outside gives the surface its colour. Colours come from a function of the position in
space: every quad of the mesh owns a small tile of the texture, sampled at its own points, so that the picture has no
seams and no stretched texels.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_splat.assets.implicit import Layer, normals, point_distance, surface
from mi_splat.assets.mesh import Floats, Mesh
from mi_splat.assets.primitives import sheet

Paint = Callable[[Floats, NDArray[np.int64]], Floats]


def body(
    layers: Sequence[Layer],
    cell: float,
    paint: Paint,
    *,
    texels: int = 4,
    relief: Callable[[Floats], Floats] | None = None,
    roughness: float | None = None,
) -> Mesh:
    """The closed mesh of `layers`, painted."""
    vertices, quads = surface(layers, cell)
    margin = 2.5 * cell + max(layer.blend for layer in layers)
    step = np.linspace(0, 1, texels, dtype=np.float32)
    s, t = np.meshgrid(step, step, indexing="xy")
    weight = np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], -1).reshape(-1, 4)
    points = np.einsum("tc,qcd->qtd", weight, vertices[quads]).reshape(-1, 3).astype(np.float32)
    owner = np.argmin([point_distance(layer, points, margin) for layer in layers], 0)
    colours = np.clip(paint(points, owner), 0, 1).reshape(len(quads), texels, texels, 3)
    if relief is not None:
        vertices = vertices + normals(vertices, quads) * relief(vertices)[:, None]
    side = int(np.ceil(np.sqrt(len(quads))))
    atlas = np.zeros((side * side, texels, texels, 3), np.float32)
    atlas[: len(quads)] = colours
    texture = atlas.reshape(side, side, texels, texels, 3).swapaxes(1, 2).reshape(side * texels, side * texels, 3)
    tile = np.arange(len(quads))
    corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (texels - 1) + 0.5
    pixel = np.stack([tile % side, tile // side], 1)[:, None] * texels + corner
    uvs = (pixel / (side * texels)).reshape(-1, 2)
    uvs[:, 1] = 1 - uvs[:, 1]
    faces = (4 * tile[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3).astype(np.uint32)
    return Mesh(vertices[quads].reshape(-1, 3), faces, uvs.astype(np.float32), texture, roughness)


def blade(points: ArrayLike, thickness: float, texture: ArrayLike, *, roughness: float | None = None) -> Mesh:
    """A thin closed sheet (an ear, a wing) about an (n, m, 3) grid of points, sharp at the rim.

    Both sides show the texture: u along m, v along n; from the side where m runs right and n up it is not mirrored.
    """
    grid = np.asarray(points, np.float64)
    n, m = grid.shape[:2]
    across, along = np.gradient(grid, axis=1), np.gradient(grid, axis=0)
    normal = np.cross(across, along)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    v, u = np.linspace(-1, 1, n)[:, None], np.linspace(-1, 1, m)[None]
    bulge = np.sqrt(np.maximum((1 - u**2) * (1 - v**2), 0))[..., None]
    offset = normal * bulge * thickness / 2
    front = sheet(grid + offset, texture, roughness=roughness)
    back = sheet(grid - offset, texture, roughness=roughness)
    faces = np.concatenate([front.faces, back.faces[:, ::-1] + np.uint32(len(front.vertices))])
    return Mesh(
        np.concatenate([front.vertices, back.vertices]),
        faces,
        np.concatenate([front.uvs, back.uvs]),
        front.texture,
        roughness,
    )


class Noise:
    """Smooth solid value noise in [-1, 1] (Ebert et al. 2003), periodic over 24 units, drawn from a generator."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._lattice = rng.uniform(-1, 1, (25, 25, 25)).astype(np.float32)
        for axis in range(3):
            first: list[slice | int] = [slice(None)] * 3
            last = list(first)
            first[axis], last[axis] = 0, 24
            self._lattice[tuple(last)] = self._lattice[tuple(first)]

    def __call__(self, points: Floats, scale: float | ArrayLike) -> Floats:
        """(N,) noise at points (N, 3); `scale` is the size of a grain in metres, one or per axis."""
        cells = np.mod(points / np.asarray(scale, np.float32), 24).astype(np.float32)
        base = np.minimum(cells.astype(np.int64), 23)
        f = cells - base
        f = f * f * (3 - 2 * f)
        flat = self._lattice.ravel()
        start = (base[:, 0] * 25 + base[:, 1]) * 25 + base[:, 2]
        value = np.zeros(len(points), np.float32)
        for i in (0, 1):
            for j in (0, 1):
                plane = (f[:, 0] if i else 1 - f[:, 0]) * (f[:, 1] if j else 1 - f[:, 1])
                value += plane * (
                    flat[start + 625 * i + 25 * j] * (1 - f[:, 2]) + flat[start + 625 * i + 25 * j + 1] * f[:, 2]
                )
        return value


def mix(base: Floats, colour: ArrayLike, amount: ArrayLike) -> Floats:
    """Colours (N, 3) blended towards a colour (3,) or (N, 3) by (N,) amounts, clipped to [0, 1]."""
    weight = np.clip(np.asarray(amount, np.float32), 0, 1)[:, None]
    value: Floats = (base * (1 - weight) + np.asarray(colour, np.float32) * weight).astype(np.float32)
    return value


def spot(points: Floats, centre: ArrayLike, radii: ArrayLike, soft: float = 0.2) -> Floats:
    """(N,) amount of an ellipsoidal spot: 1 inside, 0 outside, soft over a fraction of its radius."""
    offset = (points - np.asarray(centre, np.float32)) / np.asarray(radii, np.float32)
    value: Floats = np.clip((1 - np.linalg.norm(offset, axis=1)) / soft + 0.5, 0, 1).astype(np.float32)
    return value


def grounded(meshes: Sequence[Mesh]) -> tuple[Mesh, ...]:
    """The meshes moved so that they stand on z = 0 and their common box is centred in x and y."""
    points = np.concatenate([mesh.vertices for mesh in meshes])
    low, high = points.min(0), points.max(0)
    shift = np.array([-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]], np.float32)
    return tuple(
        Mesh(mesh.vertices + shift, mesh.faces, mesh.uvs, mesh.texture, mesh.roughness, mesh.smooth) for mesh in meshes
    )
