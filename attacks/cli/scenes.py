"""Reads what a command was given, a scene XML or a bare splat file, and finds cameras for it."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import torch

from mi_splat.cameras import Camera, orbit_pose
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import load_splat
from mi_splat.rendering import RenderSettings, Stage, read_stage
from mi_splat.scene import GaussianScene


def open_stage(path: Path) -> Stage:
    """The scene in `path`, to be rendered as detectors and PNG files want it: three channels, sRGB.

    A bare splat file becomes a stage of one part without cameras, in front of black.

    Raises:
        MiSplatError: The file cannot be read, or is of neither kind.
    """
    if path.suffix.lower() == ".xml":
        stage = read_stage(path)
        return dataclasses.replace(stage, settings=dataclasses.replace(stage.settings, alpha=False, linear=False))
    if path.suffix.lower() != ".ply":
        do = "pass a Mitsuba scene or a 3DGS splat"
        raise InvalidValueError(message(str(path), "a file that ends in .xml or .ply", path.suffix or "no ending", do))
    scene = load_splat(path)
    return Stage(scene=scene, parts={path.stem: slice(0, len(scene))}, cameras={}, settings=RenderSettings())


def choose_camera(stage: Stage, name: str | None, path: Path) -> Camera:
    """The camera called `name` of a stage, or its first if None.

    Raises:
        InvalidValueError: There is no such camera.
    """
    if name is None and stage.cameras:
        return next(iter(stage.cameras.values()))
    if name not in stage.cameras:
        expected = f"one of {', '.join(stage.cameras)}" if stage.cameras else "none, since it has no cameras"
        raise InvalidValueError(message(f"camera of {path}", expected, name, "name one that is there"))
    return stage.cameras[name]


def bounds(scene: GaussianScene) -> tuple[tuple[float, float, float], float]:
    """Middle and radius, world units, of the box around the middle 98 % of the means along each axis.

    The rest are often floaters far away, which would make everything else tiny.

    Raises:
        InvalidValueError: The scene is empty.
    """
    if not len(scene):
        raise InvalidValueError(message("scene", "Gaussians to look at", "none", "pass another file"))
    ordered = scene.means.double().sort(dim=0).values
    last = len(ordered) - 1
    low, high = ordered[round(0.01 * last)], ordered[round(0.99 * last)]
    x, y, z = ((low + high) / 2).tolist()
    return (x, y, z), max(float(torch.linalg.vector_norm(high - low)) / 2, float(scene.scales.mean()))


def orbit_camera(
    scene: GaussianScene,
    *,
    azimuth: float,
    elevation: float,
    distance: float | None,
    fov: float,
    size: tuple[int, int],
) -> Camera:
    """A camera that looks at the middle of a scene.

    Args:
        scene: What to look at.
        azimuth: Degrees from +x towards +y.
        elevation: Degrees above the ground.
        distance: World units; None is as near as shows all of `bounds`.
        fov: Degrees over the shorter side of the picture.
        size: Width and height in pixels.

    Raises:
        InvalidValueError: The scene is empty, or a number is out of range.
    """
    if not 0 < fov < 180:
        raise InvalidValueError(message("fov", "degrees between 0 and 180", fov, "45 is usual"))
    if min(size) < 1:
        raise InvalidValueError(message("size", "positive numbers of pixels", size, "for instance 640 480"))
    middle, radius = bounds(scene)
    half = math.radians(fov) / 2
    if distance is None:
        distance = radius / math.sin(half)
    pose = orbit_pose(middle, azimuth=azimuth, elevation=elevation, distance=distance)
    return Camera(to_world=pose, focal=min(size) / 2 / math.tan(half), width=size[0], height=size[1])


def resized(camera: Camera, size: tuple[int, int]) -> Camera:
    """The same camera with another picture size; what it saw from left to right, it still sees.

    Raises:
        InvalidValueError: The size is not positive.
    """
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
