"""Reader of the transforms.json family: Blender and NeRF, with one file a split or one for all pictures.

Poses in these files are camera-to-world with OpenGL's axes (x right, y up, z backward); the world is left as it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mi_splat.cameras import Camera
from mi_splat.datasets.errors import DatasetError
from mi_splat.datasets.frames import Frame, Split, find_mask, find_picture, held_out, refuse_doubles
from mi_splat.datasets.pictures import picture_size
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.parsing import DocumentReader

OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
"""Camera space with OpenGL's axes to ours, and back."""

SINGLE, PARTS = "transforms.json", {"train": "transforms_train.json", "test": "transforms_test.json"}
POINTS = ("points3D.ply", "points3d.ply")
"""Names of a point cloud beside the file, if the file names none."""

WORLD_OFFSET = "world_offset"
"""Key of what has to be added to a file's coordinates to get those of the world that was photographed."""

_TRANSFORMS = DocumentReader(
    expected="JSON with a list of frames",
    do="repair it or write it again",
    error=DatasetError,
)
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_LARGEST = 1e12
_PINHOLE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")


def find_transforms(path: Path) -> Path | None:
    """The first transforms file of a folder, or `path` itself if it is a JSON file; None if there is none."""
    if path.suffix.lower() == ".json":
        return path
    return next((path / name for name in (PARTS["train"], SINGLE, PARTS["test"]) if (path / name).is_file()), None)


def read_transforms(path: Path, split: Split | None, every: int) -> tuple[list[Frame], Path | None]:
    """The frames of a split, and the file of the point cloud.

    Args:
        path: A file found by `find_transforms`.
        split: Which part; None for all. A file named for a split belongs to that alone.
        every: In a file for all pictures, those whose index in the order of names is a multiple are for tests.

    Raises:
        DatasetError: A file is missing, broken, or describes cameras that are no pinhole cameras.
    """
    its_part = next((part for part, name in PARTS.items() if name == path.name), None)
    if its_part is None:
        document = _document(path)
        frames = _split(document, _frames(document, path), split, every)
        return frames, _points_file(document, path)
    files = {part: path.with_name(name) for part, name in PARTS.items()}
    wanted = files.values() if split is None else [files[split]]
    documents = {file: _document(file) for file in wanted if split is not None or file.is_file()}
    frames = [frame for file, document in documents.items() for frame in _frames(document, file)]
    refuse_doubles((str(frame.path) for frame in frames), path)
    return frames, next((points for file, doc in documents.items() if (points := _points_file(doc, file))), None)


def read_cameras(path: Path, size: tuple[int, int]) -> list[Camera]:
    """The cameras of a transforms file in its order, whose pictures need not be there.

    Args:
        path: The JSON file.
        size: Width and height in pixels of the cameras for which the file gives none.

    Raises:
        DatasetError: The file is missing or broken.
    """
    document = _document(path)
    cameras = []
    for number, entry in enumerate(document["frames"]):
        where = f"{path}, frame {number}"
        if not isinstance(entry, dict):
            raise DatasetError(message(where, "an object with a transform_matrix", "none", "repair it"))
        values = {**document, **entry}
        cameras.append(_camera(values, _size(values, where) or size, where))
    return cameras


def read_world_offset(path: Path) -> tuple[float, float, float]:
    """What a transforms file says has to be added to its coordinates; zero if it says nothing.

    Raises:
        DatasetError: The file is missing or broken.
    """
    values = _document(path).get(WORLD_OFFSET, [0.0, 0.0, 0.0])
    if not isinstance(values, list) or len(values) != 3:
        raise DatasetError(message(f"{path}: {WORLD_OFFSET}", "three numbers", repr(values)[:60], "repair it"))
    x, y, z = (_number({"value": value}, "value", f"{path}: {WORLD_OFFSET}") or 0.0 for value in values)
    return x, y, z


def _document(path: Path) -> dict[str, Any]:
    """The file's JSON object."""
    if not path.exists():
        do = "write it, or choose another split"
        raise DatasetError(message(str(path), "a transforms file", "no such file", do))
    document = _TRANSFORMS.read_json(path)
    if not isinstance(document.get("frames"), list):
        raise DatasetError(message(str(path), "an object with a list of frames", "none", "pass a NeRF transforms file"))
    if not document["frames"]:
        raise DatasetError(message(str(path), "at least one frame", "an empty list", "add pictures to it"))
    return document


def _frames(document: Mapping[str, Any], path: Path) -> list[Frame]:
    """All frames of a file, pictures checked."""
    frames = []
    for number, entry in enumerate(document["frames"]):
        if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str) or not entry["file_path"]:
            do = "give every frame its file_path"
            raise DatasetError(message(f"{path}, frame {number}", "an object with a file_path", "none", do))
        where = f"{path}, frame {number} ({entry['file_path']})"
        picture = find_picture(path.parent / entry["file_path"])
        values = {**document, **entry}
        claimed = _size(values, where)
        size = picture_size(picture, claimed)
        frames.append(Frame(camera=_camera(values, size, where), path=picture, mask=_mask(entry, path, picture, size)))
    refuse_doubles((str(frame.path) for frame in frames), path)
    return frames


def _mask(entry: Mapping[str, Any], path: Path, picture: Path, size: tuple[int, int]) -> Path | None:
    """The mask that the frame names, or that lies in a folder masks/."""
    if isinstance(entry.get("mask_path"), str):
        named: Path = path.parent / entry["mask_path"]
        picture_size(named, size)
        return named
    name = Path(*Path(entry["file_path"]).parent.parts, picture.name)
    return find_mask(path.parent / "masks", name.relative_to("images") if name.parts[0] == "images" else name, size)


def _number(values: Mapping[str, Any], key: str, where: str) -> float | None:
    """A finite number of the file, None if it is not there."""
    value = values.get(key)
    if value is None:
        return None
    usable = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _LARGEST
    if not usable:  # nan is not smaller than anything
        raise DatasetError(message(f"{where}: {key}", "a finite number", repr(value)[:60], "repair it"))
    return float(value)


def _size(values: Mapping[str, Any], where: str) -> tuple[int, int] | None:
    """The width and height that the file claims; None if it leaves them to the picture."""
    width, height = (_number(values, key, where) for key in ("w", "h"))
    if width is None or height is None:
        return None
    if width != int(width) or height != int(height):
        raise DatasetError(message(f"{where}: w and h", "integers", (width, height), "repair them"))
    return int(width), int(height)


def _camera(values: Mapping[str, Any], size: tuple[int, int], where: str) -> Camera:
    """The camera of a frame whose own values come before those of the file."""
    distortion = [key for key in _DISTORTION if (_number(values, key, where) or 0.0) != 0.0]
    model = str(values.get("camera_model", _PINHOLE_MODELS[0])).upper()
    if distortion or model not in _PINHOLE_MODELS or values.get("is_fisheye"):
        lens = (
            f"distortion {', '.join(distortion)}"
            if distortion
            else f"camera model {values.get('camera_model', 'fisheye')}"
        )
        do = "undistort the pictures first, for instance with colmap image_undistorter"
        raise DatasetError(message(where, "a pinhole camera", lens, do))
    focal = [_focal(values, axis, pixels, where) for axis, pixels in zip("xy", size, strict=True)]
    known = [value for value in focal if value is not None]
    if not known:
        raise DatasetError(message(where, "fl_x or camera_angle_x", "neither", "add one of the two"))
    fx, fy = (known[0] if value is None else value for value in focal)
    cx, cy = (_number(values, key, where) for key in ("cx", "cy"))
    principal = (size[0] / 2 if cx is None else cx, size[1] / 2 if cy is None else cy)
    pose = _pose(values.get("transform_matrix"), where)
    try:
        return Camera(to_world=pose, focal=(fx, fy), width=size[0], height=size[1], principal=principal)
    except InvalidValueError as error:
        raise DatasetError(f"{where}: {error}") from error


def _pose(matrix: object, where: str) -> Tensor:
    """The camera-to-world matrix with our axes; its values are not checked."""
    try:
        pose = torch.tensor(matrix, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        do = "give every frame a 4 x 4 transform_matrix"
        raise DatasetError(message(where, "a matrix of numbers", "something else", do)) from error
    if pose.shape == (3, 4):
        pose = torch.cat([pose, torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)])
    return pose @ OPENGL if pose.shape == (4, 4) else pose


def _focal(values: Mapping[str, Any], axis: str, pixels: int, where: str) -> float | None:
    """The focal length in pixels along an axis, from itself or from the field of view in radians."""
    focal, angle = _number(values, f"fl_{axis}", where), _number(values, f"camera_angle_{axis}", where)
    if focal is not None or angle is None:
        return focal
    if not 0 < angle < math.pi:
        do = "give it in radians"
        raise DatasetError(message(f"{where}: camera_angle_{axis}", "an angle between 0 and pi", angle, do))
    return 0.5 * pixels / math.tan(0.5 * angle)


def _split(document: Mapping[str, Any], frames: list[Frame], split: Split | None, every: int) -> list[Frame]:
    """The part of a single file: what its own lists of names say, or each `every`-th in the order of names."""
    listed = document.get(f"{split}_filenames")
    if split is not None and isinstance(listed, list):
        names = {Path(str(name)).with_suffix("").as_posix() for name in listed}
        entries = zip(document["frames"], frames, strict=True)
        return [frame for entry, frame in entries if Path(entry["file_path"]).with_suffix("").as_posix() in names]
    return held_out(sorted(frames, key=lambda frame: str(frame.path)), split, every)


def _points_file(document: Mapping[str, Any], path: Path) -> Path | None:
    """The point cloud that the file names, or one beside it under a usual name."""
    named = document.get("ply_file_path")
    if isinstance(named, str):
        return path.parent / named
    return next((path.parent / name for name in POINTS if (path.parent / name).is_file()), None)
