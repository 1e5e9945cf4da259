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
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.assets.mesh import Asset, Floats, Mesh
from mi_splat.cameras import Camera, View, project_points
from mi_splat.errors import InvalidValueError, message

VARIANT = "scalar_rgb"
MAX_DEPTH = 3
"""Bounces followed by the path tracer, the camera's own ray included."""
PASSES, BRIGHTEST = 4, 1.6
"""Into how many passes a picture is split, and the intensity at which each is clipped."""

Colour = tuple[float, float, float]
OnStep = Callable[[int, int], None]
"""Called after each picture with the number finished and the number wanted."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Light:
    """Daylight: a sun far away and a sky with clouds.

    Attributes:
        sun_azimuth: Degrees from world +x towards +y, where the sun stands.
        sun_elevation: Degrees above the horizon.
        sun_strength: Irradiance of the sun on a surface that faces it.
        sun_colour: Linear RGB factor.
        sky_strength: Radiance of the sky's zenith.
        zenith: Linear RGB of the sky overhead.
        horizon: Linear RGB of the sky at the horizon.
        clouds: Share of the sky covered with clouds, 0 to 1.
        seed: Which clouds.
    """

    sun_azimuth: float = 40.0
    sun_elevation: float = 45.0
    sun_strength: float = 2.6
    sun_colour: Colour = (1.0, 0.95, 0.87)
    sky_strength: float = 0.6
    zenith: Colour = (0.45, 0.68, 1.0)
    horizon: Colour = (0.85, 0.93, 1.0)
    clouds: float = 0.3
    seed: int = 0


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


def daylight(seed: int) -> Light:
    """A plausible light for `seed`: bright sun at any time of the day, haze, or an overcast sky."""
    rng = np.random.default_rng([seed, 0x11647])
    overcast = float(np.clip(rng.normal(0.35, 0.4), 0, 1))
    elevation = float(rng.uniform(12, 75))
    warm = math.exp(-elevation / 22)
    exposure = float(rng.uniform(0.75, 1.15))
    grey = np.array([0.86, 0.9, 0.95])
    zenith = np.array([0.32, 0.55, 1.0]) * (1 - overcast) + grey * overcast
    horizon = np.array([0.85 + 0.15 * warm, 0.92 - 0.05 * warm, 1.0 - 0.3 * warm]) * (1 - overcast) + grey * overcast
    return Light(
        sun_azimuth=float(rng.uniform(0, 360)),
        sun_elevation=elevation,
        sun_strength=exposure * 2.8 * (1 - overcast) ** 1.5 * (1 - 0.4 * warm),
        sun_colour=(1.0, 0.96 - 0.25 * warm, 0.9 - 0.5 * warm),
        sky_strength=exposure * (0.55 + 0.7 * overcast),
        zenith=(float(zenith[0]), float(zenith[1]), float(zenith[2])),
        horizon=(float(horizon[0]), float(horizon[1]), float(horizon[2])),
        clouds=float(rng.uniform(0, 0.8)),
        seed=seed,
    )


@contextlib.contextmanager
def scalar_variant() -> Iterator[None]:
    """Switch Mitsuba to `scalar_rgb` and back to what was set before, also after an error."""
    previous = mi.variant()
    mi.set_variant(VARIANT)
    try:
        yield
    finally:
        if previous is not None and previous != VARIANT:
            mi.set_variant(previous)


def to_linear(colour: Floats) -> Floats:
    """Linear intensities from sRGB values (IEC 61966-2-1)."""
    value = np.asarray(colour, np.float64)
    low, high = value / 12.92, (np.maximum(value, 0) + 0.055) / 1.055
    return np.where(value <= 0.04045, low, high**2.4).astype(np.float32)


def to_srgb(intensity: Floats) -> Floats:
    """The sRGB values, clipped to [0, 1], from linear intensities (IEC 61966-2-1)."""
    value = np.clip(np.asarray(intensity, np.float64), 0, 1)
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055).astype(np.float32)


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


def _shapes(asset: Asset, prefix: str) -> dict[str, Any]:
    """Mitsuba meshes of an asset, its parts gathered by material; ids are prefix_0, prefix_1, ..."""
    groups: dict[tuple[bytes | None, tuple[int, ...], float | None], list[Mesh]] = {}
    for mesh in asset.meshes:
        texture = None if _is_plain(mesh) else mesh.texture.tobytes()
        groups.setdefault((texture, mesh.texture.shape, mesh.roughness), []).append(mesh)
    return {f"{prefix}_{i}": _shape(f"{prefix}_{i}", meshes) for i, meshes in enumerate(groups.values())}


def _sky(light: Light) -> Floats:
    """(h, w, 3) linear latitude-longitude picture of the sky, zenith first, ground below the horizon."""
    height, width = 96, 192
    elevation = np.linspace(90, -90, height, dtype=np.float64)[:, None, None]
    blend = np.exp(-np.maximum(elevation, 0) / 22)
    sky = np.array(light.zenith) * (1 - blend) + np.array(light.horizon) * blend * 1.15
    rng = np.random.default_rng([light.seed, 0xC10D])
    noise = np.zeros((height, width))
    for octave in range(5):
        cells = rng.random((3 << octave, 6 << octave))
        noise += _stretch(cells, height, width) / 1.7**octave
    noise = (noise - noise.min()) / max(float(np.ptp(noise)), 1e-9)
    cover = np.clip((noise - (1 - light.clouds)) * 4, 0, 1)[..., None] * np.clip(elevation / 12, 0, 1)
    white = max(light.horizon) * 1.25
    sky = sky * (1 - cover) + cover * white * (0.75 + 0.25 * noise[..., None])
    ground = np.array([0.2, 0.19, 0.17]) * (0.5 + light.sun_strength / 5)
    return (light.sky_strength * np.where(elevation < 0, ground, sky)).astype(np.float32)


def _stretch(cells: NDArray[np.float64], height: int, width: int) -> NDArray[np.float64]:
    """Smooth enlargement of a small grid, periodic in the horizontal direction."""
    rows, columns = cells.shape
    y = np.linspace(0, rows - 1, height)
    x = np.arange(width) * columns / width
    i, j = np.minimum(y.astype(int), rows - 2), x.astype(int)
    fy, fx = (y - i)[:, None], (x - j)[None]
    fy, fx = fy * fy * (3 - 2 * fy), fx * fx * (3 - 2 * fx)
    a, b = cells[i][:, j], cells[i][:, (j + 1) % columns]
    c, d = cells[i + 1][:, j], cells[i + 1][:, (j + 1) % columns]
    result: NDArray[np.float64] = (a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy
    return result


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
            scene |= _shapes(asset, f"object{number}")
        if backdrop is not None:
            scene |= _shapes(backdrop, "backdrop")
        upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
        scene["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(_sky(light)), "to_world": upright}
        if light.sun_strength > 0:
            irradiance = [light.sun_strength * c for c in light.sun_colour]
            scene["sun"] = {
                "type": "directional",
                "direction": [-c for c in to_sun],
                "irradiance": {"type": "rgb", "value": irradiance},
            }
    return scene


def _sensor(camera: Camera, *, samples: int, seed: int) -> mi.Sensor:
    if not math.isclose(camera.fx, camera.fy, rel_tol=1e-6):
        raise InvalidValueError(
            message("camera.focal", "fx equal to fy", (camera.fx, camera.fy), "resample to square pixels first")
        )
    flip = np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba's camera space: x left, y up, z forward
    return mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "fov": math.degrees(2 * math.atan(camera.width / 2 / camera.fx)),
            "principal_point_offset_x": 0.5 - camera.cx / camera.width,
            "principal_point_offset_y": 0.5 - camera.cy / camera.height,
            "near_clip": 0.01,
            "far_clip": 2000.0,
            "to_world": mi.ScalarTransform4f(camera.to_world.numpy() @ flip),
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent", "sample_count": samples, "seed": seed},
        }
    )


def _load(scene: dict[str, Any] | Path) -> mi.Scene:
    if isinstance(scene, dict):
        return mi.load_dict(scene)
    if not Path(scene).is_file():
        raise InvalidValueError(message("scene", "a Mitsuba XML file", str(scene), "check the path"))
    return mi.load_file(str(scene))


def _picture(scene: mi.Scene, camera: Camera, *, samples: int, seed: int) -> View:
    """One picture; the mean of passes that are clipped on their own, so that no single bright path leaves a speck."""
    passes = min(PASSES, samples)
    total = np.zeros((camera.height, camera.width, 3))
    for number in range(passes):
        share = (samples * (number + 1)) // passes - (samples * number) // passes
        sensor = _sensor(camera, samples=share, seed=seed)
        film = mi.render(scene, sensor=sensor, spp=share, seed=seed * PASSES + number)
        total += np.clip(np.array(film)[..., :3], 0, BRIGHTEST) * (share / samples)
    return View(camera, torch.from_numpy(to_srgb(total)))


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
    if samples < 1:
        raise InvalidValueError(message("samples", "a positive number of paths a pixel", samples, "use 16 or more"))
    views = []
    with scalar_variant():
        loaded = _load(scene)
        for number, camera in enumerate(cameras):
            views.append(_picture(loaded, camera, samples=samples, seed=seed + number))
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
    pixels, depth = project_points(torch.from_numpy(asset.vertices), camera)
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
        view = _picture(scene, camera, samples=samples, seed=seed)
        nearest = first_hits(scene, camera, seed=seed)
        for number, asset in enumerate(assets):
            shapes = {k: v for k, v in description.items() if k.startswith(f"object{number}_")}
            alone = first_hits(mi.load_dict({"type": "scene", **shapes}), camera, seed=seed)
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
