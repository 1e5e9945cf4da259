"""What a capture takes images of: a Mitsuba mesh scene, a mesh file, or one of the
project's own scenes.
"""

import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_splat.capture.daylight import Light
from mi_splat.capture.ground import Kind, square_of_ground
from mi_splat.capture.mesh import Asset
from mi_splat.capture.mesh_files import load_mesh
from mi_splat.capture.mitsuba_scene import scene_dict
from mi_splat.capture.objects import OBJECTS, SUFFIX, object_file, shipped_file
from mi_splat.capture.path_tracer import PathTracer
from mi_splat.capture.settings import MeshSettings, SurroundingsSettings
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.scene_parts import SceneParts

SMALLEST = 0.5
LARGEST = 50.0
"""Radii in metres of a mesh: Mitsuba computes in float32 and starts secondary rays
about 1e-4 metres off a surface.
"""
SMALLEST_XML = 0.02
LARGEST_XML = 400.0
"""Radii in world units of a Mitsuba scene, which is photographed as it is, so that its
camera sees everything.
"""
FARTHEST_XML = 100.0
"""Largest coordinate of a Mitsuba scene's middle, in radii: its images are then about
60 dB from those at the origin.
"""
GROUND_SIDE = 6.5
GROUND_TILE = 1.65
"""Side of the ground and of its texture, in radii of the object: 16 m and 4 m for a
car, as in the studies of CLOAK.
"""

_SPLATS = ("gaussians", "splat_tile")
"""Plugins of this project, which show splats and not meshes."""


Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class ExampleScene:
    """One of the shipped scenes as meshes: a target object in surroundings, in
    daylight.
    """

    target: str  # names of shipped files
    surroundings: str
    light: Light
    centre: Point

    def assets(self) -> tuple[Asset, Asset]:
        """The object and its surroundings."""
        target = load_mesh(shipped_file(self.target))
        return target, load_mesh(shipped_file(self.surroundings))


EXAMPLES = {
    "car_street": ExampleScene(
        target="car",
        surroundings="street",
        light=Light(sun_azimuth=-50, sun_elevation=52, seed=900000),
        centre=(0.0, 0.0, 0.7),
    ),
    "stop_sign": ExampleScene(
        target="roadside_sign",
        surroundings="roadside",
        light=Light(sun_azimuth=35, sun_elevation=48, seed=900001),
        centre=(0.0, 0.0, 1.94),
    ),
}


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CaptureSource:
    """Something to take images of."""

    scene: dict[str, Any] | Path  # what the path tracer loads
    centre: Point  # that cameras look at, world units
    radius: float  # of what they shall see, world units
    # the object first, then its surroundings; none of an XML file
    assets: tuple[Asset, ...]
    digest: str  # SHA-256 of everything that the images show


def open_source(
    name: str,
    *,
    mesh: MeshSettings | None = None,
    surroundings: SurroundingsSettings | None = None,
) -> CaptureSource:
    """The source called `name`."""
    path = Path(name)
    suffix = path.suffix.lower()
    is_mesh = name in OBJECTS or suffix == SUFFIX
    mesh = mesh or MeshSettings()
    surroundings = surroundings or SurroundingsSettings()
    if mesh != MeshSettings() and suffix != SUFFIX:
        expected = "a mesh file to go with"
        raise InvalidValueError.of(
            "up and scale", expected, name, "leave them out"
        ).hinted("--up, --scale")
    if surroundings != SurroundingsSettings() and not is_mesh:
        expected = "a mesh file, or an object of the project, to go with"
        raise InvalidValueError.of(
            "ground and sun", expected, name, "leave them out"
        ).hinted("--ground, --sun")
    if name in EXAMPLES:
        example = EXAMPLES[name]
        return source_of(*example.assets(), example.light, centre=example.centre)
    if suffix == ".xml":
        return _xml(path)
    if is_mesh:
        return mesh_source(load_mesh(object_file(name), mesh), name, surroundings)
    names = ", ".join((*EXAMPLES, *OBJECTS))
    expected = f"one of {names}, or a file that ends in .xml or {SUFFIX}"
    raise InvalidValueError.of("scene", expected, name, "name one of these")


def source_of(
    target: Asset, surroundings: Asset, light: Light, *, centre: Point
) -> CaptureSource:
    """An object in its surroundings."""
    return CaptureSource(
        scene=scene_dict([target], light=light, backdrop=surroundings),
        centre=centre,
        radius=_extent(target)[1],
        assets=(target, surroundings) if surroundings.meshes else (target,),
        digest=digest_of((target, surroundings), light),
    )


def mesh_source(
    target: Asset, name: str, surroundings: SurroundingsSettings
) -> CaptureSource:
    """A mesh in its surroundings."""
    centre, radius = _extent(target)
    if not SMALLEST <= radius <= LARGEST:
        expected = f"a radius of {SMALLEST:g} to {LARGEST:g} metres"
        raise InvalidValueError.of(
            name, expected, f"{radius:.4g}", "pass another scale"
        ).hinted("--scale")
    if surroundings.ground == "none":
        ground = Asset("none", ())
    else:
        ground = _ground(target, surroundings.ground)
    azimuth, elevation = surroundings.sun_angles or (
        Light().sun_azimuth,
        Light().sun_elevation,
    )
    return source_of(
        target,
        ground,
        Light(sun_azimuth=azimuth, sun_elevation=elevation),
        centre=centre,
    )


def _ground(target: Asset, kind: Kind) -> Asset:
    """The ground under an object."""
    (x, y, _), radius = _extent(target)
    centre = (x, y, float(target.bounds[0, 2]))
    return square_of_ground(
        kind, side=GROUND_SIDE * radius, tile=GROUND_TILE * radius, centre=centre
    )


def _xml(path: Path) -> CaptureSource:
    """A Mitsuba scene as it is, sensors apart."""
    if not path.is_file():
        raise InvalidValueError.of(
            "scene", "a Mitsuba XML file", str(path), "check the path"
        )
    parts = SceneParts(path)
    if any(
        element.tag in ("shape", "integrator") and element.get("type") in _SPLATS
        for element in parts.elements
    ):
        do = f"see it with `mi-splat render {path}`, or name a scene of meshes"
        raise InvalidValueError.of(
            str(path), "a scene of meshes", "a scene of splats", do
        )
    try:
        bounds = PathTracer(path, samples=1, alpha=True).bounds
    except RuntimeError as error:  # what Mitsuba raises for everything
        got = " ".join(str(error).split())[:300]
        do = "make it a mesh scene that Mitsuba loads in llvm_ad_rgb"
        raise MiSplatError.of(str(path), "a scene", got, do) from error
    if not np.isfinite(bounds).all():
        raise MiSplatError.of(str(path), "a scene with shapes", "none", "add some")
    centre, radius = _middle(bounds.astype(np.float64))
    if not SMALLEST_XML <= radius <= LARGEST_XML:
        expected = f"a radius of {SMALLEST_XML:g} to {LARGEST_XML:g} world units"
        raise InvalidValueError.of(
            str(path), expected, f"{radius:.4g}", "scale its shapes"
        )
    away = max(map(abs, centre)) / radius
    if away > FARTHEST_XML:
        expected = (
            f"a scene around the origin, its middle at most {FARTHEST_XML:g} radii away"
        )
        do = "subtract the middle from the transforms of its shapes"
        raise MiSplatError.of(str(path), expected, f"{away:.0f}", do)
    # another texture makes other images
    digest = _digest(file.read_bytes() for file in parts.files)
    return CaptureSource(
        scene=path, centre=centre, radius=radius, assets=(), digest=digest
    )


def _extent(asset: Asset) -> tuple[Point, float]:
    """Middle and radius of an asset's box."""
    return _middle(asset.bounds.astype(np.float64))


def _middle(bounds: NDArray[np.float64]) -> tuple[Point, float]:
    """Middle and half diagonal of a (2, 3) box."""
    x, y, z = (float(value) for value in bounds.mean(0))
    return (x, y, z), math.dist(*bounds.tolist()) / 2


def digest_of(assets: Sequence[Asset], light: Light) -> str:
    """Digest of objects in a light."""
    parts = [repr(light).encode()]
    numbers: dict[int, int] = {}  # of textures, many of which are the same array
    for mesh in (mesh for asset in assets for mesh in asset.meshes):
        parts += [mesh.vertices.tobytes(), mesh.faces.tobytes(), mesh.uvs.tobytes()]
        texture = id(mesh.texture)
        if texture not in numbers:
            numbers[texture] = len(numbers)
            parts.append(mesh.texture.tobytes())
        surface = (numbers[texture], mesh.texture.shape, mesh.roughness, mesh.smooth)
        parts.append(repr(surface).encode())
    return _digest(parts)


def _digest(parts: Iterable[bytes]) -> str:
    """SHA-256 of parts, their lengths included."""
    total = hashlib.sha256()
    for part in parts:
        total.update(len(part).to_bytes(8, "little"))
        total.update(part)
    return total.hexdigest()
