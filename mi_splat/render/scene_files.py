"""Scene files as values: an XML scene of splats or a bare splat file, and cameras for
it.
"""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np
import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera
from mi_splat.cameras.framing import near_plane
from mi_splat.errors import InvalidValueError, MiSplatError, listed, message
from mi_splat.fields import named_path
from mi_splat.io import save_splat
from mi_splat.io.documents import file_name, save_text
from mi_splat.io.errors import SplatFileError, SplatFileWarning, path_name
from mi_splat.io.loaded import Loaded
from mi_splat.io.scene_parts import SceneParts
from mi_splat.io.splat_files import load_stored
from mi_splat.io.up_axis import UpAxis, up_axis
from mi_splat.render import variant
from mi_splat.render.renderer import RenderSettings
from mi_splat.scene import GaussianScene, check_scene, merge


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class SplatScene:
    """A splat scene file as values.

    Attributes:
        scene: All its Gaussians, shape after shape in file order.
        objects: Rows of each `gaussians` shape, by its id.
        cameras: One per sensor, by its id.
        settings: Those of its `splat_tile` or `splat_ray` integrator, or the defaults
            where it has another one. Where the file states no near plane, it is that of
            `near_plane` for the scene and its cameras.
        up: What is taken for up in a splat file, and why; None of a scene file, whose
            up is z.
    """

    scene: GaussianScene
    objects: dict[str, slice]
    cameras: dict[str, Camera]
    settings: RenderSettings
    up: UpAxis | None = None

    def __repr__(self) -> str:
        objects, cameras = (listed(names) for names in (self.objects, self.cameras))
        return (
            f"SplatScene({len(self.scene):,} Gaussians, objects: {objects}, cameras:"
            f" {cameras})"
        )


def read_scene(path: str | Path) -> SplatScene:
    """Read a Mitsuba scene file (XML) whose shapes are splats.

    Args:
        path: The XML file; files that it names are looked for beside it.

    Returns:
        The splat, its objects and cameras by name, and the settings of its renderer.

    Raises:
        InvalidValueError: The file is missing, is not a Mitsuba scene, or holds no
            `gaussians` shape or no sensor, or other shapes.
        SplatFileError: A splat that it names cannot be read.
    """
    variant.use()
    return values_of(load_mitsuba_scene(path), path)


def load_mitsuba_scene(path: str | Path, **parameters: Any) -> Any:
    """A Mitsuba scene from a file; `parameters` take the place of its default
    values.
    """
    import mitsuba as mi

    path = named_path(path_name(path))
    if not path.is_file():
        raise InvalidValueError.of(
            "scene", "a Mitsuba XML file", f"no file {path}", "check the path"
        )
    SceneParts(path, parameters).check()
    try:
        # Not parallel: rare failures were seen with threads; their cause is not known.
        loaded = mi.load_file(str(path), parallel=False, **parameters)
    except (RuntimeError, UnicodeDecodeError) as error:
        raise _reason(error, path) from None
    if not isinstance(loaded, mi.Scene):
        raise InvalidValueError.of(
            str(path), "a <scene>", type(loaded).__name__, "wrap it in <scene>"
        )
    return loaded


def values_of(
    loaded: Any, path: str | Path, *, among: Literal["nothing", "surfaces"] = "nothing"
) -> SplatScene:
    """The splats, cameras and settings of a Mitsuba scene as values."""
    from mi_splat.render.plugins import sensor as sensors
    from mi_splat.render.plugins.gaussian_shapes import GaussianShapes

    shapes = GaussianShapes(loaded, among=among)
    if not shapes.arrays or not loaded.sensors():
        expected = "a gaussians shape and a sensor"
        do = "add it to the file"
        raise InvalidValueError.of(
            str(path), expected, "a scene without one of them", do
        )
    scenes = shapes.scenes()
    ends = torch.tensor([0] + [len(scene) for scene in scenes]).cumsum(0).tolist()
    scene = merge(*scenes)
    cameras = dict[str, Camera]()
    for sensor in loaded.sensors():
        try:
            cameras[sensor.id()] = sensors.camera(sensor)
        except InvalidValueError as error:
            raise InvalidValueError(
                f'{path}, sensor "{sensor.id()}": {error}'
            ) from error
    return SplatScene(
        scene=scene,
        objects={
            name: slice(start, end)
            for name, start, end in zip(shapes.names, ends[:-1], ends[1:], strict=True)
        },
        cameras=cameras,
        settings=_settings_of(
            loaded.integrator(), near_plane(scene, tuple(cameras.values())), path
        ),
    )


def _settings_of(integrator: Any, near: float, path: str | Path) -> RenderSettings:
    """Render settings of a scene's integrator; `near` where the file states none."""
    from mi_splat.render.plugins.settings import IntegratorSettings

    settings = getattr(integrator, "settings", None)
    if isinstance(settings, IntegratorSettings):
        if "near" in settings.given:
            return settings.values
        return replace(settings.values, near=near)
    if type(integrator).__name__ != "BasicVolumetricPrimitiveRadianceFieldIntegrator":
        got = f"{integrator.class_name()}, which shows splats as grey lumps in Mitsuba"
        do = (
            'they are drawn with splat_tile here: write <integrator type="splat_tile"/>'
        )
        text = message(str(path), "the integrator splat_tile or splat_ray", got, do)
        warnings.warn(text, SplatFileWarning, stacklevel=4)
    return RenderSettings(near=near)


def _reason(error: RuntimeError | UnicodeDecodeError, path: Path) -> MiSplatError:
    """Mitsuba wraps what a plugin raises in text; give back the last line of it, which
    is ours if we raised it.
    """
    text = str(error)
    # Mitsuba quotes bytes of a file that are no text
    if isinstance(error, UnicodeDecodeError):
        text = error.object.decode("utf-8", "replace")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    ours = [
        line
        for line in lines
        if line.startswith(("SplatFileError:", "InvalidValueError:"))
    ]
    if ours:
        return SplatFileError(ours[-1].split(": ", 1)[1])
    return InvalidValueError.of(
        str(path),
        "a Mitsuba scene",
        lines[-1] if lines else "an error",
        "mend the file",
    )


def open_scene(
    path: Path, device: str = "cpu", *, stored: Loaded | None = None
) -> SplatScene:
    """The scene in `path`, to be rendered as detectors and PNG files want it: three
    channels, sRGB.
    """
    if path.suffix.lower() == ".xml":
        loaded = read_scene(path)
        loaded = replace(
            loaded, settings=replace(loaded.settings, alpha=False, linear=False)
        )
    else:
        stored = (stored or load_stored(path)).settle(str(path), "raise", stacklevel=2)
        scene = stored.scene
        settings = RenderSettings(
            near=near_plane(scene), antialiased=stored.is_antialiased
        )
        objects = {path.stem: slice(0, len(scene))}
        loaded = SplatScene(
            scene=scene,
            objects=objects,
            cameras={},
            settings=settings,
            up=up_axis(path, stored),
        )
    if device == "cpu":
        return loaded
    variant.check_device(device)
    settings = replace(loaded.settings, variant=variant.use("cuda_ad_rgb"))
    return replace(loaded, scene=loaded.scene.to(device), settings=settings)


def resized(camera: Camera, size: tuple[int, int]) -> Camera:
    """The same camera with another image size; what it saw from left to right, it
    still sees.
    """
    if size == (camera.width, camera.height):
        return camera
    width, height = size
    factor = width / camera.width
    x = (camera.cx - camera.width / 2) * factor
    y = (camera.cy - camera.height / 2) * factor
    across, down = camera.lens.scale
    lens = replace(
        camera.lens,
        focal=(across * factor, down * factor),
        size=size,
        principal=(width / 2 + x, height / 2 + y),
    )
    return replace(camera, lens=lens)


def write_scene(loaded: SplatScene, scene: GaussianScene, path: Path) -> list[Path]:
    """Write a changed scene with the parts, cameras and settings that it was read
    with.
    """
    if len(scene) != len(loaded.scene):
        do = "pass the scene whose parts these are"
        raise InvalidValueError.of(
            "scene", f"{len(loaded.scene):,} Gaussians", f"{len(scene):,}", do
        )
    from mi_splat.render.plugins.sensor import mitsuba_pose, sensor_dict

    variant.use()
    root = ElementTree.Element("scene", version="3.0.0")
    settings = loaded.settings
    if settings.method == "tile":
        names = ["near", "background"]
    else:
        names = ["background", "colour_to_mean", "linear"]
    given = {
        name: getattr(settings, name)
        for name in [*names, *(["antialiased"] if settings.antialiased else [])]
    }
    _element(root, "integrator", {"type": f"splat_{settings.method}", **given})
    files: list[Path] = []
    for name, rows in loaded.objects.items():
        file = path.with_name(f"{path.stem}_{file_name(name)}.ply")
        if file in files:  # two names may differ in what a file name cannot hold
            file = file.with_stem(f"{file.stem}_{len(files)}")
        save_splat(scene.select(rows), file)
        shape = ElementTree.SubElement(root, "shape", type="gaussians", id=name)
        ElementTree.SubElement(shape, "string", name="filename", value=file.name)
        files.append(file)
    for name, camera in loaded.cameras.items():
        sensor = {
            **sensor_dict(camera, f"camera {name}"),
            "to_world": mitsuba_pose(camera),
        }
        _element(root, "sensor", sensor, id=name)
    ElementTree.indent(root, "    ")
    save_text(ElementTree.tostring(root, encoding="unicode") + "\n", path)
    return [*files, path]


def _element(
    parent: ElementTree.Element, tag: str, values: dict[str, Any], **attributes: str
) -> None:
    """What `mi.load_dict` takes, as XML; matrices of NumPy are transforms."""
    node = ElementTree.SubElement(parent, tag, {"type": values["type"], **attributes})
    kinds = {
        bool: "boolean",
        int: "integer",
        float: "float",
        str: "string",
        tuple: "rgb",
    }
    for name, value in values.items():
        if isinstance(value, dict):
            _element(node, name, value)
        elif isinstance(value, np.ndarray):
            transform = ElementTree.SubElement(node, "transform", name=name)
            ElementTree.SubElement(
                transform, "matrix", value=" ".join(map(repr, value.ravel().tolist()))
            )
        elif name != "type":
            if isinstance(value, tuple):
                text = ", ".join(map(repr, value))
            else:
                text = str(value)
            text = text.lower() if isinstance(value, bool) else text
            ElementTree.SubElement(node, kinds[type(value)], name=name, value=text)


SPLATS = ("gaussians", "ellipsoids")
"""Types of shapes that are splats."""

SAMPLES = 64
"""Samples a pixel where none are asked for."""


def holds_surfaces(path: Path) -> bool:
    """Whether a scene file names shapes that are no splats; False where it cannot be
    read.
    """
    try:
        elements = SceneParts(path).elements
    except InvalidValueError:
        return False
    return any(
        element.get("type") not in SPLATS
        for element in elements
        if element.tag == "shape"
    )


class MixedScene:
    """A Mitsuba scene of splats among surfaces, with the integrator `splat_ray`; its
    images have no gradient.

    `parameters` take the place of the file's default values, for instance `sun_z=0.25`.
    """

    def __init__(
        self,
        path: Path,
        *,
        samples: int = SAMPLES,
        seed: int = 0,
        linear: bool = False,
        **parameters: Any,
    ) -> None:
        if samples < 1:
            raise InvalidValueError.of(
                "samples", "at least 1", samples, "64 are little noise"
            )
        variant.use()
        self._loaded = load_mitsuba_scene(path, **parameters)
        if type(self._loaded.integrator()).__name__ != "SplatRay":
            do = 'write <integrator type="splat_ray"/>'
            raise InvalidValueError.of(
                str(path), "the integrator splat_ray", "another one", do
            )
        self.splats: SplatScene = values_of(self._loaded, path, among="surfaces")
        self.samples = samples
        self.seed = seed
        self.linear = linear

    def __call__(self, scene: GaussianScene, camera: Camera) -> Tensor:
        """Render one image."""
        import mitsuba as mi

        from mi_splat.render.plugins.sensor import sensor_dict
        from mi_splat.render.tile.colour import srgb_value

        self._put(scene)
        film = {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "pixel_format": "rgb",
        }
        sensor = mi.load_dict({**sensor_dict(camera), "film": film})
        picture = self._loaded.integrator().render(
            self._loaded, sensor, seed=self.seed, spp=self.samples
        )
        flat = picture.array if self.linear else srgb_value(picture.array)
        values = torch.from_numpy(flat.numpy().copy()).reshape(
            camera.height, camera.width, 3
        )
        if self.linear:
            return values
        return values.clamp(0.0, 1.0)

    def depths(self, camera: Camera) -> Tensor:
        """(H, W) depth of the nearest surface at the centre of each pixel, world units;
        infinite if none.
        """
        import mitsuba as mi

        from mi_splat.oracle import pixel_rays

        surfaces = self._loaded.integrator()._mixed(self._loaded).surfaces
        origin, directions, lengths = pixel_rays(camera)
        ray = mi.Ray3f(
            mi.Point3f(*map(float, origin)),
            mi.Vector3f(*directions.T.astype("float32")),
        )
        distances = torch.from_numpy(
            surfaces.ray_intersect_preliminary(ray).t.numpy() / lengths
        )
        return distances.reshape(camera.height, camera.width)

    def _put(self, scene: GaussianScene) -> None:
        """Put Gaussians into the shapes of the file."""
        import mitsuba as mi

        from mi_splat.render.plugins.shape import ellipsoid_arrays

        check_scene("scene", scene)
        if len(scene) != len(self.splats.scene):
            expected = f"{len(self.splats.scene):,} Gaussians"
            do = "take a changed copy of the file's own"
            raise InvalidValueError.of("scene", expected, f"{len(scene):,}", do)
        params = mi.traverse(self._loaded)
        for name, rows in self.splats.objects.items():
            for key, value in ellipsoid_arrays(
                scene.select(torch.arange(len(scene))[rows])
            ).items():
                params[f"{name}.{key}"] = mi.Float(value.array)
        params.update()
