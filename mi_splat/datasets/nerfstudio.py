"""What nerfstudio writes beside a transforms.json: camera paths of its viewer, and the
world of its splats.

A splat of `ns-export` lies in the world of nerfstudio's trainer.
dataparser_transforms.json, in the folder of a training, says how it comes from the
world in which the cameras were found.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera
from mi_splat.cameras.lens import focal_of
from mi_splat.datasets.errors import DatasetError
from mi_splat.datasets.frames import camera_of
from mi_splat.datasets.lenses import ImageLens
from mi_splat.io.parsing import DocumentReader, Fields
from mi_splat.io.points import PointCloud
from mi_splat.maths.rotation import is_rotation

OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
"""Camera space with OpenGL's axes to ours, and back."""

WORLD = "dataparser_transforms.json"
_FOV = 75.0
"""Degrees from top to bottom, the default of nerfstudio's viewer."""
_MOST_PIXELS = 1 << 31  # a camera has a bound of its own
_COLMAP = "colmap/sparse/0"
_AS_FROM_COLMAP = [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]
"""How nerfstudio turned the world of COLMAP before its files said so."""

_WORLD = DocumentReader(
    expected="the transform and the scale of nerfstudio",
    do="copy it again from the folder of the training",
    error=DatasetError,
)


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """A similarity of the world of a file: a point p becomes scale * (turn @ p +
    shift).
    """

    turn: Tensor  # (3, 3) float64
    shift: Tensor  # (3,) float64
    scale: float

    def pose(self, to_world: Tensor) -> Tensor:
        """(4, 4) the pose of a camera in that world."""
        moved = to_world.clone()
        moved[:3, :3] = self.turn @ to_world[:3, :3]
        moved[:3, 3] = self.scale * (self.turn @ to_world[:3, 3] + self.shift)
        return moved

    def points(self, cloud: PointCloud) -> PointCloud:
        """The points in that world."""
        moved = self.scale * (cloud.points.double() @ self.turn.T + self.shift)
        return PointCloud(moved.to(cloud.points.dtype), cloud.colours)


def world_of(path: Path, document: Mapping[str, Any]) -> World | None:
    """The world of nerfstudio's trainer from that of a transforms file, if its
    description lies beside it.

    Raises:
        DatasetError: The description is broken, or turns the world inside out.
    """
    file = path.with_name(WORLD)
    if not file.is_file():
        return None
    values = Fields(_WORLD.read_json(file), str(file), DatasetError, "copy it again")
    from_original = _square(values.rows("transform", 3, 4))
    applied = document.get("applied_transform")
    if applied is None and (path.parent / _COLMAP).is_dir():
        applied = _AS_FROM_COLMAP
    if applied is not None:
        # The file's poses were turned already; the description begins before that.
        fields = Fields(
            {"applied_transform": applied}, str(path), DatasetError, "repair it"
        )
        turned = _square(fields.rows("applied_transform", 3, 4))
        if not is_rotation(turned[:3, :3]):
            raise fields.bad("applied_transform", "a rotation and a shift", applied)
        from_original = from_original @ torch.linalg.inv(turned)
    scale = values.number("scale")
    if document.get("applied_scale") is not None:
        fields = Fields(document, str(path), DatasetError, "repair it")
        applied_scale = fields.number("applied_scale")
        if not applied_scale > 0:
            raise fields.bad("applied_scale", "a number above 0", applied_scale)
        scale /= applied_scale
    turn = from_original[:3, :3]
    shift = from_original[:3, 3]
    if not (is_rotation(turn) and 0 < scale < math.inf):
        raise DatasetError.of(
            str(file),
            "a rotation and a positive scale",
            from_original.tolist(),
            "copy it again",
        )
    return World(turn, shift, scale)


def _square(rows: list[list[float]]) -> Tensor:
    return torch.tensor([*rows, [0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)


def is_camera_path(document: Mapping[str, Any]) -> bool:
    """Whether a document is a camera path of nerfstudio's viewer."""
    return any(
        isinstance(document.get(name), list) for name in ("camera_path", "keyframes")
    )


def camera_path(
    document: Mapping[str, Any], path: Path, size: tuple[int, int]
) -> list[Camera]:
    """The cameras of a camera path, or of its keyframes if it was not played.

    Args:
        document: The file's content.
        path: For errors.
        size: Width and height where the file has none; the width follows the aspect of
            a camera.
    """
    name = "camera_path" if document.get("camera_path") else "keyframes"
    whole = Fields(document, str(path), DatasetError, "export the camera path again")
    cameras = []
    for entry in whole.objects(name):
        height = int(_number(whole, "render_height", size[1]))
        aspect = _number(entry, "aspect", size[0] / size[1])
        wide = height * aspect
        if not 0 < wide < _MOST_PIXELS:
            raise entry.bad("aspect", f"a width of 1 to {_MOST_PIXELS} pixels", aspect)
        width = int(_number(whole, "render_width", round(wide)))
        angle = _number(entry, "fov", _number(whole, "default_fov", _FOV))
        if not 0 < angle < 180:
            raise entry.bad("fov", "degrees between 0 and 180", angle)
        focal = focal_of(math.radians(angle), height)
        lens = ImageLens(
            focal=(focal, focal),
            principal=(width / 2, height / 2),
            size=(width, height),
        )
        key = "camera_to_world" if "camera_to_world" in entry.values else "matrix"
        cameras.append(camera_of(_matrix(entry, key) @ OPENGL, lens, entry.where))
    if not cameras:
        raise DatasetError.of(
            str(path),
            "at least one camera",
            "none",
            "add keyframes in nerfstudio's viewer",
        )
    return cameras


def _number(fields: Fields, key: str, usual: float) -> float:
    """A number of a file, or the usual one if the file does not say it."""
    if fields.values.get(key) is None:
        return usual
    return fields.number(key)


def _matrix(entry: Fields, key: str) -> Tensor:
    """(4, 4) float64 of 16 numbers by rows, or by columns as older viewers wrote
    keyframes, even as text.
    """
    value = entry.values.get(key)
    if isinstance(value, str):
        try:
            value = json.loads(value[:10_000])
        except (ValueError, RecursionError) as error:
            raise entry.bad(key, "16 numbers", value) from error
    numbers = Fields(
        {key: value}, entry.where, DatasetError, "export the camera path again"
    ).numbers(key, 16, 16)
    matrix = torch.tensor(numbers, dtype=torch.float64).reshape(4, 4)
    is_by_columns = bool(matrix[3, :3].any()) and not bool(matrix[:3, 3].any())
    if is_by_columns:
        return matrix.T.contiguous()
    return matrix
