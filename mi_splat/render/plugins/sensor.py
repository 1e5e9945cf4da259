"""Mitsuba's perspective sensor as the rasteriser's camera and as ours.

Mitsuba's camera looks along its +z with x to the left and y up; ours (OpenCV) has x
right and y down.
"""

import functools
import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from numpy.typing import NDArray

from mi_splat.cameras.camera import Camera
from mi_splat.cameras.lens import Lens, angle_of, focal_of
from mi_splat.errors import InvalidValueError
from mi_splat.render.tile.pinhole import Pinhole


@functools.cache
def _collector(variant: str) -> Any:
    """The callback's class for one variant; its base class exists only once a variant
    is set.
    """

    class OwnValues(mi.TraversalCallback):  # type: ignore[misc]
        """Keeps what an object says that its values are, and looks at no object in
        it.
        """

        def __init__(self) -> None:
            super().__init__()
            self.values: dict[str, tuple[Any, Any]] = {}

        def put(self, name: str, value: Any, flags: Any, kind: Any = None) -> None:
            """Told of everything by name."""
            if not isinstance(value, mi.Object):
                self.values[name] = value, kind

        put_value = put

        def put_object(self, name: str, node: Any, flags: Any) -> None:
            """Told of the objects in it."""

    return OwnValues


def own_values(node: Any) -> dict[str, Any]:
    """What `mi.traverse(node)` has without a dot in its name: the values of the object,
    not of those in it.
    """
    callback = _collector(mi.variant())()
    node.traverse(callback)
    return {
        name: value if kind is None else mi.get_property(value, kind, node)
        for name, (value, kind) in callback.values.items()
    }


_LENS = ("x_fov", "principal_point_offset_x", "principal_point_offset_y")
_MITSUBA_TO_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])


def is_pinhole(sensor: Any) -> bool:
    """Whether a sensor is a perspective one, of which `camera` can be had."""
    return own_values(sensor).keys() >= {*_LENS}


def identity(sensor: Any) -> tuple[tuple[Any, ...], list[Any]]:
    """What `pinhole` depends on, without reading it: a key, and the arrays to hold for
    as long as the key is in use.

    Reading a sensor's arrays waits for every kernel in flight. Dr.Jit's arrays never
    change under a given index while someone holds them, so indices tell as well whether
    anything has changed.
    """
    values = own_values(sensor)
    matrix = sensor.world_transform().matrix
    film = sensor.film()
    lens = [values[name] for name in _LENS if name in values]
    entries = [matrix[i, j] for i in range(4) for j in range(4)]
    sizes = (tuple(film.size()), tuple(film.crop_offset()), tuple(film.crop_size()))
    return (*(dr.detach(array).index for array in (*entries, *lens)), *sizes), [
        matrix,
        *lens,
    ]


def pinhole(sensor: Any, *, near: float, antialiased: bool = False) -> Pinhole:
    """The kernels' camera for a perspective sensor; a crop window shows the same pixels
    as the whole film would.
    """
    seen = camera(sensor)
    film = sensor.film().size()
    field = 0.5 * int(film[0]) / seen.fx, 0.5 * int(film[1]) / seen.fy
    return Pinhole(camera=seen, near=near, antialiased=antialiased, field=field)


def camera(sensor: Any) -> Camera:
    """Our camera for a perspective sensor (of its crop window, if it has one)."""
    values = own_values(sensor)
    if not values.keys() >= {*_LENS}:
        what = f'sensor "{sensor.id()}"'
        do = "change its type to perspective"
        raise InvalidValueError.of(
            what, "a perspective sensor", sensor.class_name(), do
        )
    pose = (
        np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
        @ _MITSUBA_TO_OPENCV
    )
    pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
    film = sensor.film()
    size = film.size()
    crop = film.crop_size()
    start = film.crop_offset()
    angle, *offset = (float(np.array(values[name]).item()) for name in _LENS)
    x, y = (
        (0.5 - offset[axis]) * int(size[axis]) - float(start[axis]) for axis in range(2)
    )
    width = int(crop[0])
    height = int(crop[1])
    centred = np.allclose((x, y), (width / 2, height / 2), rtol=0, atol=1e-6)
    return Camera(
        to_world=torch.from_numpy(pose),
        lens=Lens(
            focal=focal_of(math.radians(angle), int(size[0])),
            size=(width, height),
            principal=None if centred else (x, y),
        ),
    )


def perspective(camera: Camera, what: str = "camera") -> dict[str, Any]:
    """What a perspective sensor of Mitsuba says of our camera's lens."""
    if not math.isclose(camera.fx, camera.fy, rel_tol=1e-6):
        raise InvalidValueError.of(
            what,
            "square pixels",
            (camera.fx, camera.fy),
            "resample to square pixels first",
        )
    return {
        "fov_axis": "x",
        "fov": math.degrees(angle_of(camera.fx, camera.width)),
        "principal_point_offset_x": 0.5 - camera.cx / camera.width,
        "principal_point_offset_y": 0.5 - camera.cy / camera.height,
    }


def mitsuba_pose(camera: Camera) -> NDArray[np.float64]:
    """(4, 4) pose of our camera with the axes of Mitsuba's."""
    return camera.to_world.numpy() @ _MITSUBA_TO_OPENCV


def sensor_dict(camera: Camera, what: str = "camera") -> dict[str, Any]:
    """A perspective sensor for `mi.load_dict` that takes our camera's image through a
    box filter.
    """
    size = {"width": camera.width, "height": camera.height}
    formats = {"pixel_format": "rgb"}
    return {
        "type": "perspective",
        **perspective(camera, what),
        "near_clip": 0.01,
        "far_clip": 2000.0,
        "to_world": mi.ScalarTransform4f(mitsuba_pose(camera)),
        "film": {
            "type": "hdrfilm",
            **size,
            **formats,
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
    }
