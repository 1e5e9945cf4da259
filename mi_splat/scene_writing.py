"""A scene of several parts as files: a splat for each part, and the Mitsuba XML that puts them together."""

import math
from pathlib import Path
from xml.etree import ElementTree

from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.io import save_splat
from mi_splat.io.documents import file_name, save_text
from mi_splat.rendering import RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.scene_files import SplatScene

_OPENCV_TO_MITSUBA = (-1.0, -1.0, 1.0, 1.0)
"""Mitsuba's camera has x to the left and y up: factors of the columns of a pose."""


def write_scene(loaded: SplatScene, scene: GaussianScene, path: Path) -> list[Path]:
    """Write a changed scene with the parts, cameras and settings that it was read with."""
    if len(scene) != len(loaded.scene):
        do = "pass the scene whose parts these are"
        raise InvalidValueError.of("scene", f"{len(loaded.scene):,} Gaussians", f"{len(scene):,}", do)
    root = ElementTree.Element("scene", version="3.0.0")
    _integrator(root, loaded.settings)
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
        _sensor(root, name, camera)
    ElementTree.indent(root, "    ")
    save_text(ElementTree.tostring(root, encoding="unicode") + "\n", path)
    return [*files, path]


def _integrator(root: ElementTree.Element, settings: RenderSettings) -> None:
    integrator = ElementTree.SubElement(root, "integrator", type=f"splat_{settings.method}")
    if settings.method == "tile":
        ElementTree.SubElement(integrator, "float", name="near", value=repr(settings.near))
    ElementTree.SubElement(integrator, "rgb", name="background", value=", ".join(map(repr, settings.background)))
    if settings.method == "ray":
        for name in ("colour_to_mean", "linear"):
            value = str(getattr(settings, name)).lower()
            ElementTree.SubElement(integrator, "boolean", name=name, value=value)
    if settings.antialiased:
        ElementTree.SubElement(integrator, "boolean", name="antialiased", value="true")


def _sensor(root: ElementTree.Element, name: str, camera: Camera) -> None:
    """A perspective sensor that takes a camera's picture."""
    if not math.isclose(camera.fx, camera.fy, rel_tol=1e-6):
        raise InvalidValueError.of(f"camera {name}", "square pixels", (camera.fx, camera.fy), "leave this camera out")
    sensor = ElementTree.SubElement(root, "sensor", type="perspective", id=name)
    numbers = {
        "fov": math.degrees(2 * math.atan(camera.width / 2 / camera.fx)),
        "principal_point_offset_x": 0.5 - camera.cx / camera.width,
        "principal_point_offset_y": 0.5 - camera.cy / camera.height,
    }
    ElementTree.SubElement(sensor, "string", name="fov_axis", value="x")
    for key, value in numbers.items():
        ElementTree.SubElement(sensor, "float", name=key, value=repr(value))
    pose = camera.to_world * camera.to_world.new_tensor(_OPENCV_TO_MITSUBA)
    transform = ElementTree.SubElement(sensor, "transform", name="to_world")
    ElementTree.SubElement(transform, "matrix", value=" ".join(repr(value) for value in pose.flatten().tolist()))
    film = ElementTree.SubElement(sensor, "film", type="hdrfilm")
    for key, size in (("width", camera.width), ("height", camera.height)):
        ElementTree.SubElement(film, "integer", name=key, value=str(size))
    ElementTree.SubElement(film, "rfilter", type="box")
