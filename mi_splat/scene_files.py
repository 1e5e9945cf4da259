"""Scene files as values: an XML scene of splats or a bare splat file, and cameras for it."""

import dataclasses
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from mi_splat import variant
from mi_splat._lazy import Previewed
from mi_splat.bounds import bounds, near_plane
from mi_splat.cameras import Camera, orbit_pose
from mi_splat.errors import InvalidValueError, MiSplatError, listed, message
from mi_splat.io.errors import SplatFileError, SplatFileWarning, path_name
from mi_splat.io.scene_parts import check_scene_file
from mi_splat.io.splat_files import load_stored
from mi_splat.rendering import RenderSettings
from mi_splat.scene import GaussianScene, merge


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class SplatScene(Previewed):
    """A splat scene file as values.

    Attributes:
        scene: All its Gaussians, shape after shape in file order.
        objects: Rows of each `gaussians` shape, by its id.
        cameras: One per sensor, by its id.
        settings: Those of its `splat_tile` or `splat_ray` integrator, or the defaults where it has another one. Where
            the file states no near plane, it is that of `near_plane` for the scene and its cameras.
    """

    scene: GaussianScene
    objects: dict[str, slice]
    cameras: dict[str, Camera]
    settings: RenderSettings

    def __repr__(self) -> str:
        objects, cameras = (listed(names) for names in (self.objects, self.cameras))
        return f"SplatScene({len(self.scene):,} Gaussians, objects: {objects}, cameras: {cameras})"


def read_scene(path: str | Path) -> SplatScene:
    """Read a Mitsuba scene file (XML) whose shapes are splats.

    Args:
        path: The XML file; files that it names are looked for beside it.

    Returns:
        The splat, its objects and cameras by name, and the settings of its renderer.

    Raises:
        InvalidValueError: The file is missing, is not a Mitsuba scene, or holds no `gaussians` shape or no sensor, or
            other shapes.
        SplatFileError: A splat that it names cannot be read.
    """
    variant.use()
    return values_of(load_mitsuba_scene(path), path)


def load_mitsuba_scene(path: str | Path, **parameters: Any) -> Any:
    """A Mitsuba scene from a file; `parameters` take the place of its default values."""
    import mitsuba as mi

    path = Path(path_name(path))
    if not path.is_file():
        raise InvalidValueError.of("scene", "a Mitsuba XML file", f"no file {path}", "check the path")
    check_scene_file(path, parameters)
    try:
        # Not parallel: rare failures were seen with threads; their cause is not known.
        loaded = mi.load_file(str(path), parallel=False, **parameters)
    except RuntimeError as error:
        raise _reason(error, path) from None
    if not isinstance(loaded, mi.Scene):
        raise InvalidValueError.of(str(path), "a <scene>", type(loaded).__name__, "wrap it in <scene>")
    return loaded


def values_of(loaded: Any, path: str | Path, *, among: Literal["nothing", "surfaces"] = "nothing") -> SplatScene:
    """The splats, cameras and settings of a Mitsuba scene as values."""
    from mi_splat.plugins import sensor as sensors
    from mi_splat.plugins.gaussian_shapes import GaussianShapes

    shapes = GaussianShapes(loaded, among=among)
    if not shapes.arrays or not loaded.sensors():
        raise InvalidValueError.of(
            str(path), "a gaussians shape and a sensor", "a scene without one of them", "add it to the file"
        )
    scenes = shapes.scenes()
    ends = torch.tensor([0] + [len(scene) for scene in scenes]).cumsum(0).tolist()
    scene = merge(*scenes)
    cameras = dict[str, Camera]()
    for sensor in loaded.sensors():
        try:
            cameras[sensor.id()] = sensors.camera(sensor)
        except InvalidValueError as error:
            raise InvalidValueError(f'{path}, sensor "{sensor.id()}": {error}') from error
    return SplatScene(
        scene=scene,
        objects={name: slice(start, end) for name, start, end in zip(shapes.names, ends[:-1], ends[1:], strict=True)},
        cameras=cameras,
        settings=_settings_of(loaded.integrator(), near_plane(scene, tuple(cameras.values())), path),
    )


def _settings_of(integrator: Any, near: float, path: str | Path) -> RenderSettings:
    """Render settings of a scene's integrator; `near` where the file states none."""
    if type(integrator).__name__ == "SplatRay":
        return RenderSettings(
            method="ray",
            background=integrator.background,
            near=near,
            colour_to_mean=integrator.colour_to_mean,
            alpha=integrator.alpha,
            linear=integrator.linear,
        )
    if type(integrator).__name__ != "SplatTile":
        if type(integrator).__name__ != "BasicVolumetricPrimitiveRadianceFieldIntegrator":
            got = f"{integrator.class_name()}, which shows splats as grey lumps in Mitsuba"
            do = 'they are drawn with splat_tile here: write <integrator type="splat_tile"/>'
            text = message(str(path), "the integrator splat_tile or splat_ray", got, do)
            warnings.warn(text, SplatFileWarning, stacklevel=4)
        return RenderSettings(near=near)
    return RenderSettings(
        background=integrator.background,
        near=integrator.near if integrator.near_is_set else near,
        alpha=integrator.alpha,
        linear=integrator.linear,
        antialiased=integrator.antialiased,
    )


def _reason(error: RuntimeError, path: Path) -> MiSplatError:
    """Mitsuba wraps what a plugin raises in text; give back the last line of it, which is ours if we raised it."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    ours = [line for line in lines if line.startswith(("SplatFileError:", "InvalidValueError:"))]
    if ours:
        return SplatFileError(ours[-1].split(": ", 1)[1])
    return InvalidValueError.of(str(path), "a Mitsuba scene", lines[-1] if lines else "an error", "mend the file")


def open_scene(path: Path, device: str = "cpu") -> SplatScene:
    """The scene in `path`, to be rendered as detectors and PNG files want it: three channels, sRGB.

    A bare splat file becomes a scene of one object without cameras, in front of black, drawn in the mode (plain or
    antialiased) that the file says it was trained in.
    """
    if path.suffix.lower() == ".xml":
        loaded = read_scene(path)
        loaded = dataclasses.replace(loaded, settings=dataclasses.replace(loaded.settings, alpha=False, linear=False))
    else:
        stored = load_stored(path).settle(str(path), "raise", stacklevel=2)
        scene = stored.scene
        settings = RenderSettings(near=near_plane(scene), antialiased=stored.is_antialiased)
        loaded = SplatScene(scene=scene, objects={path.stem: slice(0, len(scene))}, cameras={}, settings=settings)
    if device == "cpu":
        return loaded
    variant.check_device(device)
    settings = dataclasses.replace(loaded.settings, variant=variant.use("cuda_ad_rgb"))
    return dataclasses.replace(loaded, scene=loaded.scene.to(device), settings=settings)


def orbit_camera(
    scene: GaussianScene,
    *,
    azimuth: float,
    elevation: float,
    distance: float | None,
    fov: float,
    size: tuple[int, int],
    centre: Sequence[float] | None = None,
) -> Camera:
    """A camera that looks at the middle of a scene, or at another point."""
    if not 0 < fov < 180:
        raise InvalidValueError.of("fov", "degrees between 0 and 180", fov, "45 is usual")
    if min(size) < 1:
        raise InvalidValueError.of("size", "positive numbers of pixels", size, "for instance (640, 480)")
    middle, radius = bounds(scene)
    half = math.radians(fov) / 2
    if distance is None:
        distance = radius / math.sin(half)
    target = middle if centre is None else centre
    pose = orbit_pose(target, azimuth=azimuth, elevation=elevation, distance=distance)
    return Camera(to_world=pose, focal=min(size) / 2 / math.tan(half), width=size[0], height=size[1])


def resized(camera: Camera, size: tuple[int, int]) -> Camera:
    """The same camera with another picture size; what it saw from left to right, it still sees."""
    if size == (camera.width, camera.height):
        return camera
    width, height = size
    factor = width / camera.width
    offset = ((camera.cx - camera.width / 2) * factor, (camera.cy - camera.height / 2) * factor)
    return Camera(
        to_world=camera.to_world,
        focal=(camera.fx * factor, camera.fy * factor),
        width=width,
        height=height,
        principal=(width / 2 + offset[0], height / 2 + offset[1]),
    )
