"""What a capture takes pictures of: a Mitsuba mesh scene, a mesh file, or one of the project's own scenes."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mi_splat.assets import ASSETS, build
from mi_splat.assets.mesh import Asset
from mi_splat.assets.recipes import RECIPES
from mi_splat.capture.mesh_files import SUFFIXES, load_mesh
from mi_splat.capture.path_tracer import Light, PathTracer, scene_dict
from mi_splat.errors import InvalidValueError, MiSplatError, message

SMALLEST, LARGEST = 0.02, 400.0
"""Radii in world units between which the path tracer's camera sees everything."""

_FILENAME = re.compile(r'name="filename"\s+value="([^"]+)"')


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CaptureSource:
    """Something to take pictures of.

    Attributes:
        scene: What the path tracer loads: a scene dictionary or a Mitsuba XML file.
        centre: Point that cameras look at, world units.
        radius: Radius of what they shall see, world units.
        assets: The surfaces, the object first and then its surroundings; none are known of an XML file.
        digest: SHA-256 of everything that the pictures show.
    """

    scene: dict[str, Any] | Path
    centre: tuple[float, float, float]
    radius: float
    assets: tuple[Asset, ...]
    digest: str


def open_source(name: str, *, up: Literal["y", "z"] | None = None, scale: float = 1.0) -> CaptureSource:
    """The source called `name`.

    Args:
        name: A recipe of `mi_splat.assets.recipes`, an asset of the project by name and seed (`car:900004`), or the
            path of a Mitsuba scene (.xml) or of a mesh file.
        up: Axis that points up in a mesh file.
        scale: What one unit of a mesh file is in metres.

    Raises:
        MiSplatError: There is no such recipe or file, or the file is broken.
    """
    path = Path(name)
    suffix = path.suffix.lower()
    if (up is not None or scale != 1.0) and suffix not in SUFFIXES:
        do = "leave them out"
        raise InvalidValueError(message("--up and --scale", "a mesh file to go with", name, do))
    if name in RECIPES:
        return _recipe(name)
    if name.partition(":")[0] in ASSETS:
        return _asset(name)
    if suffix == ".xml":
        return _xml(path)
    if suffix in SUFFIXES:
        return _mesh(load_mesh(path, up=up, scale=scale), name)
    expected = f"one of {', '.join((*RECIPES, *ASSETS))}, or a file that ends in .xml, {', '.join(SUFFIXES)}"
    raise InvalidValueError(message("scene", expected, name, "name one of these"))


def _recipe(name: str) -> CaptureSource:
    """A scene of the project in its daylight."""
    recipe = RECIPES[name]
    return source_of(*recipe.assets(), recipe.light, centre=recipe.centre)


def source_of(target: Asset, surroundings: Asset, light: Light, *, centre: tuple[float, float, float]) -> CaptureSource:
    """An object in its surroundings.

    Args:
        target: The object, placed in the world.
        surroundings: Everything else.
        light: Sun and sky.
        centre: Point that cameras look at, metres.
    """
    return CaptureSource(
        scene=scene_dict([target], light=light, backdrop=surroundings),
        centre=centre,
        radius=_extent(target)[1],
        assets=(target, surroundings),
        digest=_digest_of((target, surroundings), light),
    )


def _asset(name: str) -> CaptureSource:
    """One of the project's assets, alone under the default sky."""
    kind, _, seed = name.partition(":")
    if not re.fullmatch(r"\d{0,9}", seed):
        raise InvalidValueError(message("scene", f"{kind} or {kind}:SEED, a whole number", name, "change the seed"))
    return _mesh(build(kind, int(seed or 0)).body, name)


def _mesh(asset: Asset, name: str) -> CaptureSource:
    """A mesh under the default sky, without a ground."""
    centre, radius = _extent(asset)
    _check_radius(radius, name, "pass another --scale")
    light = Light()
    return CaptureSource(
        scene=scene_dict([asset], light=light),
        centre=centre,
        radius=radius,
        assets=(asset,),
        digest=_digest_of((asset,), light),
    )


def _xml(path: Path) -> CaptureSource:
    """A Mitsuba scene as it is, sensors apart."""
    if not path.is_file():
        raise InvalidValueError(message("scene", "a Mitsuba XML file", str(path), "check the path"))
    try:
        bounds = PathTracer(path, samples=1).bounds
    except RuntimeError as error:  # what Mitsuba raises for everything
        found = " ".join(str(error).split())[:300]
        do = "make it a mesh scene that Mitsuba loads in scalar_rgb"
        raise MiSplatError(message(str(path), "a scene", found, do)) from error
    if not np.isfinite(bounds).all():
        raise MiSplatError(message(str(path), "a scene with shapes", "none", "add some"))
    centre, radius = _middle(bounds.astype(np.float64))
    _check_radius(radius, str(path), "scale its shapes")
    # Files that it names belong to it: another texture makes other pictures.
    content = path.read_bytes()
    named = (path.parent / name for name in _FILENAME.findall(content.decode("utf-8", "replace")))
    parts = [content, *(file.read_bytes() for file in named if file.is_file())]
    return CaptureSource(scene=path, centre=centre, radius=radius, assets=(), digest=_digest(parts))


def _extent(asset: Asset) -> tuple[tuple[float, float, float], float]:
    """Middle and radius of an asset's box."""
    return _middle(asset.bounds.astype(np.float64))


def _middle(bounds: NDArray[np.float64]) -> tuple[tuple[float, float, float], float]:
    """Middle and half diagonal of a (2, 3) box."""
    x, y, z = (float(value) for value in bounds.mean(0))
    return (x, y, z), math.dist(*bounds.tolist()) / 2


def _check_radius(radius: float, name: str, do: str) -> None:
    """Raise if the camera would cut something off, near or far."""
    if not SMALLEST <= radius <= LARGEST:
        raise InvalidValueError(message(name, f"a radius of {SMALLEST} to {LARGEST:g} metres", f"{radius:.4g}", do))


def _digest_of(assets: Iterable[Asset], light: Light) -> str:
    """Digest of assets in a light."""
    parts = [repr(light).encode()]
    for mesh in (mesh for asset in assets for mesh in asset.meshes):
        parts += [array.tobytes() for array in (mesh.vertices, mesh.faces, mesh.uvs, mesh.texture)]
        parts.append(repr((mesh.texture.shape, mesh.roughness, mesh.smooth)).encode())
    return _digest(parts)


def _digest(parts: Iterable[bytes]) -> str:
    """SHA-256 of parts, their lengths included."""
    total = hashlib.sha256()
    for part in parts:
        total.update(len(part).to_bytes(8, "little"))
        total.update(part)
    return total.hexdigest()
