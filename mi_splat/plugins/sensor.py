"""Mitsuba's perspective sensor as the rasteriser's camera and as ours.

Mitsuba's camera looks along its +z with x to the left and y up; ours (OpenCV) has x right and y down.
"""

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.plugins.own_values import own_values
from mi_splat.rasterization.pinhole import Pinhole

_LENS = ("x_fov", "principal_point_offset_x", "principal_point_offset_y")
_MITSUBA_TO_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])


def is_pinhole(sensor: Any) -> bool:
    """Whether a sensor is a perspective one, of which `camera` can be had."""
    return _has_lens(own_values(sensor))


def _has_lens(values: dict[str, Any]) -> bool:
    return all(name in values for name in _LENS)


def _intrinsics(sensor: Any) -> tuple[Any, float, tuple[float, float], Any, Any]:
    """Pose (OpenCV, rigid), focal length and principal point in pixels of the whole film, crop offset, crop size."""
    values = own_values(sensor)
    if not _has_lens(values):
        raise InvalidValueError.of(
            f'sensor "{sensor.id()}"', "a perspective sensor", sensor.class_name(), "change its type to perspective"
        )
    pose = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4) @ _MITSUBA_TO_OPENCV
    pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
    film = sensor.film()
    width, height = (int(v) for v in film.size())
    focal = 0.5 * width / math.tan(math.radians(float(np.array(values["x_fov"]).item())) / 2)
    offset = [float(np.array(values[f"principal_point_offset_{axis}"]).item()) for axis in "xy"]
    principal = ((0.5 - offset[0]) * width, (0.5 - offset[1]) * height)
    return pose, focal, principal, film.crop_offset(), film.crop_size()


def identity(sensor: Any) -> tuple[tuple[Any, ...], list[Any]]:
    """What `pinhole` depends on, without reading it: a key, and the arrays to hold for as long as the key is in use.

    Reading a sensor's arrays waits for every kernel in flight. Dr.Jit's arrays never change under a given index while
    someone holds them, so indices tell as well whether anything has changed.
    """
    values = own_values(sensor)
    held = [sensor.world_transform().matrix, *(values[name] for name in _LENS if name in values)]
    film = sensor.film()
    sizes = (tuple(film.size()), tuple(film.crop_offset()), tuple(film.crop_size()))
    return (*(dr.detach(array).index for array in _flat(held)), *sizes), held


def _flat(arrays: list[Any]) -> list[Any]:
    """The entries of the matrix that comes first, then the other arrays."""
    matrix, *others = arrays
    return [*(matrix[i, j] for i in range(4) for j in range(4)), *others]


def pinhole(sensor: Any, *, near: float, antialiased: bool = False) -> Pinhole:
    """The kernels' camera for a perspective sensor; a crop window shows the same pixels as the whole film would."""
    pose, focal, principal, offset, crop = _intrinsics(sensor)
    width, height = (int(v) for v in sensor.film().size())
    return Pinhole(
        to_camera=np.linalg.inv(pose),
        focal=(focal, focal),
        principal=(principal[0] - float(offset[0]), principal[1] - float(offset[1])),
        size=(int(crop[0]), int(crop[1])),
        field=(0.5 * width / focal, 0.5 * height / focal),
        near=near,
        antialiased=antialiased,
    )


def camera(sensor: Any) -> Camera:
    """Our camera for a perspective sensor (of its crop window, if it has one)."""
    pose, focal, principal, offset, crop = _intrinsics(sensor)
    centre = (principal[0] - float(offset[0]), principal[1] - float(offset[1]))
    size = (int(crop[0]), int(crop[1]))
    centred = np.allclose(centre, (size[0] / 2, size[1] / 2), rtol=0, atol=1e-6)
    return Camera(
        to_world=torch.from_numpy(pose),
        focal=focal,
        width=size[0],
        height=size[1],
        principal=None if centred else centre,
    )


def sensor_dict(camera: Camera) -> dict[str, Any]:
    """A perspective sensor for `mi.load_dict` that takes our camera's picture through a box filter."""
    if not math.isclose(camera.fx, camera.fy, rel_tol=1e-6):
        raise InvalidValueError.of(
            "camera.focal", "fx equal to fy", (camera.fx, camera.fy), "resample to square pixels first"
        )
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": math.degrees(2 * math.atan(camera.width / 2 / camera.fx)),
        "principal_point_offset_x": 0.5 - camera.cx / camera.width,
        "principal_point_offset_y": 0.5 - camera.cy / camera.height,
        "near_clip": 0.01,
        "far_clip": 2000.0,
        "to_world": mi.ScalarTransform4f(camera.to_world.numpy() @ _MITSUBA_TO_OPENCV),
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
    }
