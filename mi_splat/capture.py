"""Path-traced pictures of mesh scenes, with exact cameras and with boxes around what can be seen of each object.

Everything here runs in Mitsuba's `scalar_rgb` variant and puts the caller's variant back afterwards. Pixels are
box-filtered averages, converted to sRGB and clipped to [0, 1]; the same arguments give the same picture.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import torch
from torch import Tensor

from mi_splat.assets.daylight import Light, daylight, sky_map
from mi_splat.assets.mesh import Asset, Floats, Mesh
from mi_splat.assets.srgb import to_linear, to_srgb
from mi_splat.cameras import Camera, View, project_points
from mi_splat.errors import InvalidValueError, message
from mi_splat.plugins.sensor import sensor_dict

VARIANT = "scalar_rgb"
MAX_DEPTH = 3
"""Bounces followed by the path tracer, the camera's own ray included."""
PASSES, BRIGHTEST = 4, 1.6
"""Into how many passes a picture is split, and the intensity at which each is clipped."""

__all__ = [
    "Light",
    "PathTracer",
    "Photograph",
    "capture",
    "check_camera",
    "daylight",
    "depth_maps",
    "mesh_scene",
    "photograph",
    "scalar_variant",
    "to_linear",
    "to_srgb",
]

OnStep = Callable[[int, int], None]
"""Called after each picture with the number finished and the number wanted."""


@dataclass(frozen=True, slots=True, eq=False)
class Photograph:
    """A path-traced picture and what is in it.

    Attributes:
        view: The picture and its camera.
        boxes: (B, 4) float32 x0, y0, x1, y1 in pixels, tight around the visible pixels of each object.
        labels: B names of the objects.
        visible: (B,) float32 share of the object's own outline that is inside the picture and not hidden.
        objects: B positions of the objects in the sequence of assets that was photographed.
    """

    view: View
    boxes: Tensor
    labels: tuple[str, ...]
    visible: Tensor
    objects: tuple[int, ...]


@contextlib.contextmanager
def scalar_variant() -> Iterator[None]:
    """Switch Mitsuba to `scalar_rgb` and back to what was set before, also after an error.

    Mitsuba loads its Python modules again for an LLVM variant, 0.2 s each time. Every function here switches by itself;
    around many calls, one more switch outside makes theirs free.
    """
    previous = mi.variant()
    mi.set_variant(VARIANT)
    try:
        yield
    finally:
        if previous is not None and previous != VARIANT:
            mi.set_variant(previous)


def corner_normals(mesh: Mesh, *, crease: float = 38.0) -> Floats:
    """(F, 3, 3) shading normal of each corner: mean of the faces around that meet under less than `crease` degrees."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-20)
    if not mesh.smooth:
        return np.repeat(flat[:, None], 3, 1).astype(np.float32)
    keys = np.round(corners.reshape(-1, 3) * 1e5).astype(np.int64)
    _, point, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(point.ravel(), kind="stable")
    start = np.cumsum(counts) - counts
    mine = counts[point.ravel()]  # how many corners share this corner's point
    corner = np.repeat(np.arange(len(mine)), mine)
    rank = np.arange(len(corner)) - np.repeat(np.cumsum(mine) - mine, mine)
    other = order[start[point.ravel()[corner]] + rank]
    near = np.einsum("ij,ij->i", flat[corner // 3], flat[other // 3]) > math.cos(math.radians(crease))
    total = np.zeros((len(mine), 3))
    for axis in range(3):
        total[:, axis] = np.bincount(corner[near], area[other[near] // 3, axis], minlength=len(mine))
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-20)
    return total.reshape(-1, 3, 3).astype(np.float32)


def _material(texture: Floats, roughness: float | None, *, palette: bool) -> dict[str, Any]:
    """A Mitsuba BSDF; the colours of a palette are not blended into each other."""
    reflectance = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(to_linear(texture)),
        "raw": True,
        "wrap_mode": "repeat",
        "filter_type": "nearest" if palette else "bilinear",
    }
    if roughness is None:
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}
    plastic = {"type": "roughplastic", "alpha": roughness, "diffuse_reflectance": reflectance, "nonlinear": True}
    return {"type": "twosided", "bsdf": plastic}


def _is_plain(mesh: Mesh) -> bool:
    return mesh.texture.shape[:2] == (1, 1)


def _shape(name: str, meshes: Sequence[Mesh]) -> mi.Mesh:
    """One Mitsuba mesh of parts that share roughness and texture, or that are all of plain colours (one palette)."""
    texture, uvs = meshes[0].texture, [mesh.uvs[mesh.faces].reshape(-1, 2) for mesh in meshes]
    plain = _is_plain(meshes[0])
    if plain:
        texture = np.concatenate([mesh.texture for mesh in meshes], axis=1)
        uvs = [np.broadcast_to(((i + 0.5) / len(meshes), 0.5), uv.shape) for i, uv in enumerate(uvs)]
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(_material(texture, meshes[0].roughness, palette=plain))
    corners = sum(mesh.faces.size for mesh in meshes)
    shape = mi.Mesh(name, corners, corners // 3, properties, has_vertex_normals=True, has_vertex_texcoords=True)
    shape.set_id(name)
    values = mi.traverse(shape)
    values["vertex_positions"] = np.concatenate([mesh.vertices[mesh.faces].ravel() for mesh in meshes])
    values["vertex_normals"] = np.concatenate([corner_normals(mesh).ravel() for mesh in meshes])
    values["vertex_texcoords"] = (
        (np.concatenate(uvs) * (1, -1) + (0, 1)).astype(np.float32).ravel()
    )  # v runs down there
    values["faces"] = np.arange(corners, dtype=np.uint32)
    values.update()
    return shape


def shapes(asset: Asset, prefix: str) -> dict[str, Any]:
    """Mitsuba meshes of an asset by id (prefix_0, prefix_1, ...), its parts gathered by material.

    They belong to the variant that is set, which has to be that of the scene they go into.
    """
    groups: dict[tuple[bytes | None, tuple[int, ...], float | None], list[Mesh]] = {}
    for mesh in asset.meshes:
        texture = None if _is_plain(mesh) else mesh.texture.tobytes()
        groups.setdefault((texture, mesh.texture.shape, mesh.roughness), []).append(mesh)
    return {f"{prefix}_{i}": _shape(f"{prefix}_{i}", meshes) for i, meshes in enumerate(groups.values())}


def mesh_scene(assets: Sequence[Asset], *, light: Light | None = None, backdrop: Asset | None = None) -> dict[str, Any]:
    """A Mitsuba scene, without a sensor, of `assets` in daylight; the scene belongs to the `scalar_rgb` variant.

    Args:
        assets: The objects; the shapes of object i have ids that begin with "object<i>_".
        light: Sun and sky.
        backdrop: What surrounds the objects and has no box: ground, houses.
    """
    light = Light() if light is None else light
    azimuth, elevation = math.radians(light.sun_azimuth), math.radians(light.sun_elevation)
    to_sun = [
        math.cos(elevation) * math.cos(azimuth),
        math.cos(elevation) * math.sin(azimuth),
        math.sin(elevation),
    ]
    with scalar_variant():
        scene: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": MAX_DEPTH}}
        for number, asset in enumerate(assets):
            scene |= shapes(asset, f"object{number}")
        if backdrop is not None:
            scene |= shapes(backdrop, "backdrop")
        upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
        scene["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(sky_map(light)), "to_world": upright}
        if light.sun_strength > 0:
            irradiance = [light.sun_strength * c for c in light.sun_colour]
            scene["sun"] = {
                "type": "directional",
                "direction": [-c for c in to_sun],
                "irradiance": {"type": "rgb", "value": irradiance},
            }
    return scene


def _sensor(camera: Camera, *, samples: int, seed: int, alpha: bool = False) -> mi.Sensor:
    sampler = {"type": "independent", "sample_count": samples, "seed": seed}
    values = {**sensor_dict(camera), "sampler": sampler}
    if alpha:
        values["film"] = {**values["film"], "pixel_format": "rgba"}
    return mi.load_dict(values)


def _load(scene: dict[str, Any] | Path) -> mi.Scene:
    if isinstance(scene, dict):
        return mi.load_dict(scene)
    if not Path(scene).is_file():
        raise InvalidValueError(message("scene", "a Mitsuba XML file", str(scene), "check the path"))
    return mi.load_file(str(scene))


def _picture(
    scene: mi.Scene, camera: Camera, *, samples: int, seed: int, integrator: mi.Integrator | None = None
) -> Tensor:
    """One picture; the mean of passes that are clipped on their own, so that no single bright path leaves a speck.

    With an `integrator`, which has to hide emitters, there is a fourth channel: the share of paths that met a surface.
    The colours are then those of the surfaces alone.
    """
    passes, channels = min(PASSES, samples), 3 if integrator is None else 4
    total = np.zeros((camera.height, camera.width, channels))
    for number in range(passes):
        share = (samples * (number + 1)) // passes - (samples * number) // passes
        sensor = _sensor(camera, samples=share, seed=seed, alpha=integrator is not None)
        given = {} if integrator is None else {"integrator": integrator}
        film = mi.render(scene, sensor=sensor, spp=share, seed=seed * PASSES + number, **given)
        total += np.clip(np.array(film)[..., :channels], 0, BRIGHTEST) * (share / samples)
    if integrator is None:
        return torch.from_numpy(to_srgb(total))
    alpha = np.clip(total[..., 3:], 0, 1)
    colours = to_srgb(total[..., :3] / np.maximum(alpha, 1e-6))
    return torch.from_numpy(np.concatenate([colours, alpha.astype(np.float32)], axis=-1))


def check_camera(camera: Camera) -> None:
    """Raise if no picture can be taken from a camera.

    Raises:
        InvalidValueError: Its pixels are not square.
    """
    with scalar_variant():
        sensor_dict(camera)


class PathTracer:
    """A loaded mesh scene that takes pictures one at a time; each depends on its camera, samples and seed alone."""

    def __init__(self, scene: dict[str, Any] | Path, *, samples: int = 32, alpha: bool = False) -> None:
        """Load a scene.

        Args:
            scene: A Mitsuba scene dictionary (see `mesh_scene`) or the path of a Mitsuba XML file
                (sensors in it are not used).
            samples: Paths a pixel.
            alpha: Whether pictures have a fourth channel. Sky and lamps are then not to be seen, and a path tracer
                takes the place of the integrator of an XML file.

        Raises:
            InvalidValueError: no samples, or no such file.
        """
        if samples < 1:
            raise InvalidValueError(message("samples", "a positive number of paths a pixel", samples, "use 16 or more"))
        self.samples = samples
        with scalar_variant():
            self._scene = _load(scene)
            hidden = {"type": "path", "max_depth": MAX_DEPTH, "hide_emitters": True}
            self._integrator = mi.load_dict(hidden) if alpha else None

    @property
    def bounds(self) -> Floats:
        """(2, 3) lowest and highest corner of the box around all shapes."""
        box = self._scene.bbox()
        return np.array([np.array(box.min).ravel(), np.array(box.max).ravel()], np.float32)

    def picture(self, camera: Camera, *, seed: int) -> Tensor:
        """(H, W, 3 or 4) float32, sRGB in [0, 1] and alpha, whose colours are not multiplied with it.

        Raises:
            InvalidValueError: The camera's pixels are not square.
        """
        with scalar_variant():
            return _picture(self._scene, camera, samples=self.samples, seed=seed, integrator=self._integrator)

    def surface(self, camera: Camera, *, seed: int) -> tuple[Tensor, Tensor]:
        """What one ray a pixel meets first.

        Returns:
            (H, W, 3) points in world units, and (H, W) distances from the camera, 0 where a ray meets nothing.

        Raises:
            InvalidValueError: The camera's pixels are not square.
        """
        with scalar_variant():
            sensor = _sensor(camera, samples=1, seed=seed)
            integrator = mi.load_dict({"type": "aov", "aovs": "point:position,far:depth"})
            film = np.array(mi.render(self._scene, sensor=sensor, integrator=integrator, spp=1, seed=seed), np.float32)
        return torch.from_numpy(film[..., :3].copy()), torch.from_numpy(film[..., 3].copy())


def capture(
    scene: dict[str, Any] | Path,
    cameras: Sequence[Camera],
    *,
    samples: int = 32,
    seed: int = 0,
    on_step: OnStep | None = None,
) -> list[View]:
    """Path-traced views of a mesh scene.

    Args:
        scene: A Mitsuba scene dictionary (see `mesh_scene`) or the path of a Mitsuba XML file
            (sensors in it are not used).
        cameras: Where to take pictures from; fx must equal fy.
        samples: Paths a pixel.
        seed: Seed of the sampler; picture i uses seed + i.
        on_step: Called after each picture.

    Returns:
        One view a camera, sRGB in [0, 1].

    Raises:
        InvalidValueError: no samples, a camera with pixels that are not square, or no such file.
    """
    views = []
    with scalar_variant():
        tracer = PathTracer(scene, samples=samples)
        for number, camera in enumerate(cameras):
            views.append(View(camera, tracer.picture(camera, seed=seed + number)))
            if on_step is not None:
                on_step(number + 1, len(cameras))
    return views


def first_hits(scene: mi.Scene, camera: Camera, *, seed: int = 0) -> Floats:
    """(H, W) distance from the camera along one ray a pixel, 0 where it meets nothing; rays depend on the seed only."""
    sensor = _sensor(camera, samples=1, seed=seed)
    film = mi.render(scene, sensor=sensor, integrator=mi.load_dict({"type": "depth"}), spp=1, seed=seed)
    return np.array(film, dtype=np.float32)[..., 0]


def depth_maps(scene: dict[str, Any] | Path, cameras: Sequence[Camera], *, seed: int = 0) -> list[Tensor]:
    """Of each camera, (H, W) float32 distance from its centre to the first surface, 0 where there is none."""
    with scalar_variant():
        loaded = _load(scene)
        return [torch.from_numpy(first_hits(loaded, camera, seed=seed)) for camera in cameras]


def _in_frame(asset: Asset, camera: Camera) -> float:
    pixels, depth = project_points(torch.from_numpy(asset.body.vertices), camera)
    size = torch.tensor([camera.width, camera.height])
    return float((((pixels >= 0) & (pixels <= size)).all(1) & (depth > 0)).float().mean())


def photograph(
    assets: Sequence[Asset],
    camera: Camera,
    *,
    light: Light | None = None,
    backdrop: Asset | None = None,
    samples: int = 32,
    seed: int = 0,
    min_pixels: int = 8,
) -> Photograph:
    """A path-traced picture of `assets` and the tight boxes of those that can be seen.

    Args:
        assets: The objects, already placed in the world.
        camera: Where from.
        light: Sun and sky.
        backdrop: Surroundings without a box.
        samples: Paths a pixel.
        seed: Seed of the sampler.
        min_pixels: Objects with fewer visible pixels get no box.
    """
    description = mesh_scene(assets, light=light, backdrop=backdrop)
    boxes, labels, visible, objects = [], [], [], []
    with scalar_variant():
        scene = _load(description)
        view = View(camera, _picture(scene, camera, samples=samples, seed=seed))
        nearest = first_hits(scene, camera, seed=seed)
        for number, asset in enumerate(assets):
            alone = first_hits(mi.load_dict({"type": "scene", **shapes(asset.body, "body")}), camera, seed=seed)
            rows, columns = np.nonzero((alone > 0) & (alone <= nearest * (1 + 1e-5)))
            if len(rows) < max(min_pixels, 1):
                continue
            boxes.append([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
            labels.append(asset.name)
            visible.append(len(rows) / int((alone > 0).sum()) * _in_frame(asset, camera))
            objects.append(number)
    return Photograph(
        view,
        torch.tensor(np.array(boxes, np.float32).reshape(-1, 4)),
        tuple(labels),
        torch.tensor(visible, dtype=torch.float32),
        tuple(objects),
    )
