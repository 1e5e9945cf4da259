"""Reader of COLMAP models, text and binary: pinhole cameras, poses and points.

COLMAP's poses are world-to-camera with our camera axes, and (0.5, 0.5) is the centre of its first pixel as of ours.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import torch

from mi_splat.cameras import Camera
from mi_splat.datasets import colmap_binary, colmap_text
from mi_splat.datasets.colmap_model import MODELS, Lens, Model, Pose
from mi_splat.datasets.errors import DatasetError
from mi_splat.datasets.frames import Frame, Split, find_mask, held_out, refuse_doubles
from mi_splat.datasets.pictures import picture_size
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.points import PointCloud
from mi_splat.rotation import to_matrix

TEST_LIST = "test.txt"
"""Beside a model, the names of the pictures for tests, one a line."""

_FOLDERS = ("sparse/0", "sparse", "0", ".")
_KINDS = (".bin", ".txt")


def find_model(path: Path) -> Path | None:
    """The cameras file of the first model in a folder, binary before text; None if there is none."""
    candidates = (path / folder / f"cameras{kind}" for folder in _FOLDERS for kind in _KINDS)
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def read_colmap(
    root: Path, cameras_file: Path, split: Split | None, every: int
) -> tuple[list[Frame], PointCloud | None]:
    """The frames of a split in the order of names, and the points.

    Args:
        root: The folder that was asked for; pictures are in its images/, or in that of a folder above the model.
        cameras_file: Found by `find_model`.
        split: Which part; None for all.
        every: Every so manieth picture is for tests, unless the model has a list of them.

    Raises:
        DatasetError: A file is missing, broken, or describes cameras that are no pinhole cameras.
    """
    folder = cameras_file.parent
    model = _read_model(cameras_file)
    poses = _split(_poses(model, cameras_file), folder / TEST_LIST, split, every)
    images = _images_folder(root, folder)
    cameras = _cameras(model, poses, cameras_file)
    frames = []
    for pose, camera in zip(poses, cameras, strict=True):
        picture, size = images / pose.name, (camera.width, camera.height)
        picture_size(picture, size)
        frames.append(
            Frame(camera=camera, path=picture, mask=find_mask(images.parent / "masks", Path(pose.name), size))
        )
    return frames, model.points


def read_model_cameras(cameras_file: Path) -> dict[str, Camera]:
    """The cameras of a model by the names of their pictures, which need not be there.

    Args:
        cameras_file: Found by `find_model`.

    Raises:
        DatasetError: A file is missing, broken, or describes cameras that are no pinhole cameras.
    """
    model = _read_model(cameras_file)
    poses = _poses(model, cameras_file)
    return dict(zip((pose.name for pose in poses), _cameras(model, poses, cameras_file), strict=True))


def _poses(model: Model, cameras_file: Path) -> list[Pose]:
    """The poses of a model in the order of names."""
    source = _images_file(cameras_file)
    if not model.poses:
        raise DatasetError(message(str(source), "at least one picture", "none", "register pictures first"))
    poses = sorted(model.poses.values(), key=lambda pose: pose.name)
    refuse_doubles((pose.name for pose in poses), source)
    return poses


def _cameras(model: Model, poses: list[Pose], cameras_file: Path) -> list[Camera]:
    """The camera of each pose."""
    source = _images_file(cameras_file)
    used = {pose.lens: _intrinsics(model.lenses, pose.lens, cameras_file) for pose in poses}
    return [_camera(pose, *used[pose.lens], source) for pose in poses]


def _images_file(cameras_file: Path) -> Path:
    """The file of a model's poses, beside that of its cameras."""
    return cameras_file.with_name(f"images{cameras_file.suffix}")


def _read_model(cameras_file: Path) -> Model:
    """The model of which a cameras file is part, with the system's failures as errors of this package."""
    read = colmap_binary.read_model if cameras_file.suffix == ".bin" else colmap_text.read_model
    try:
        return read(cameras_file.parent)
    except FileNotFoundError as error:
        do = "a model has three files: cameras, images, points3D"
        raise DatasetError(message(str(error.filename), "a part of the model", "no such file", do)) from error
    except OSError as error:
        got = error.strerror or str(error)
        raise DatasetError(message(str(cameras_file), "a file that can be read", got, "check the path")) from error


def _images_folder(root: Path, folder: Path) -> Path:
    """Where a model's pictures are: images/ in the folder that was asked for or above the model."""
    candidates = [parent / "images" for parent in (root, folder, folder.parent, folder.parent.parent)]
    return next((candidate for candidate in candidates if candidate.is_dir()), candidates[0])


def _split(poses: list[Pose], test_list: Path, split: Split | None, every: int) -> list[Pose]:
    """The part of a model's pictures, by its list of test pictures if it has one."""
    if split is None or not test_list.is_file():
        return held_out(poses, split, every)
    try:
        tests = {line.strip() for line in test_list.read_text("utf-8").splitlines()}
    except (OSError, ValueError) as error:
        raise DatasetError(message(str(test_list), "names, one a line", str(error), "write it again")) from error
    return [pose for pose in poses if (pose.name in tests) == (split == "test")]


def _intrinsics(
    lenses: Mapping[int, Lens], number: int, source: Path
) -> tuple[tuple[float, float], tuple[float, float], tuple[int, int]]:
    """Focal lengths, principal point and size in pixels of one camera."""
    if number not in lenses:
        raise DatasetError(message(str(source), f"a camera {number}", "none", "export the model again"))
    lens = lenses[number]
    if lens.model not in ("PINHOLE", "SIMPLE_PINHOLE"):
        do = "undistort the pictures with colmap image_undistorter and pass its output"
        raise DatasetError(message(f"{source}, camera {number}", "PINHOLE or SIMPLE_PINHOLE", lens.model, do))
    if len(lens.parameters) != MODELS[lens.model]:
        expected, got = f"{MODELS[lens.model]} parameters of {lens.model}", len(lens.parameters)
        raise DatasetError(message(f"{source}, camera {number}", expected, got, "export the model again"))
    fx, fy, cx, cy = lens.parameters if lens.model == "PINHOLE" else (lens.parameters[0], *lens.parameters)
    return (fx, fy), (cx, cy), (lens.width, lens.height)


def _camera(
    pose: Pose, focal: tuple[float, float], principal: tuple[float, float], size: tuple[int, int], source: Path
) -> Camera:
    """The camera of a picture."""
    quaternion = torch.tensor(pose.quaternion, dtype=torch.float64)
    shift = torch.tensor(pose.translation, dtype=torch.float64)
    length = float(quaternion.norm())
    where = f"{source}, {pose.name}"
    if not (math.isfinite(length) and length > 1e-6):
        raise DatasetError(message(where, "a quaternion", pose.quaternion, "register the picture again"))
    rotation = to_matrix(quaternion / length)
    to_world = torch.eye(4, dtype=torch.float64)
    to_world[:3, :3], to_world[:3, 3] = rotation.T, -(rotation.T @ shift)
    try:
        return Camera(to_world=to_world, focal=focal, width=size[0], height=size[1], principal=principal)
    except InvalidValueError as error:
        raise DatasetError(f"{where}: {error}") from error
