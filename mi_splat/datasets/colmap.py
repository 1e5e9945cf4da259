"""Reader of COLMAP models, text and binary: cameras, poses and points.

COLMAP's poses are world-to-camera with our camera axes, and (0.5, 0.5) is the centre of its first pixel as of ours.
"""

import math
import warnings
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from mi_splat.cameras import Camera
from mi_splat.datasets.colmap_files import MODELS, ONE_FOCAL, TWO_FOCALS, Lens, Model, Pose, read_model, unreadable
from mi_splat.datasets.distortion import Intrinsics
from mi_splat.datasets.frames import (
    HELD_OUT,
    DatasetError,
    DatasetWarning,
    Frame,
    Split,
    find_mask,
    held_out,
    photograph,
    pinhole_camera,
    refuse_doubles,
    report_missing,
    within,
)
from mi_splat.errors import InvalidValueError
from mi_splat.io.points import PointCloud
from mi_splat.rotation import to_matrix

TEST_LIST = "test.txt"
"""Beside a model, the names of the pictures for tests, one a line."""

_FOLDERS = ("sparse/0", "sparse", "0", ".")
_KINDS = (".bin", ".txt")
_TANGENTIAL = ("OPENCV", "FULL_OPENCV")
"""Whose third and fourth coefficient are tangential, and the sixth and later ones a divisor's."""


def find_model(path: Path) -> Path | None:
    """The cameras file of the first model in a folder, binary before text; None if there is none."""
    candidates = (path / folder / f"cameras{kind}" for folder in _FOLDERS for kind in _KINDS)
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def read_colmap(
    root: Path, cameras_file: Path, split: Split | None, every: int, downscale: int = 1
) -> tuple[list[Frame], PointCloud | None]:
    """The frames of a split in the order of names, and the points."""
    folder = cameras_file.parent
    others = [other for other in sorted(folder.parent.glob("[0-9]*")) if other != folder and find_model(other)]
    if folder.name == "0" and others and root != folder:
        do = f"{folder} is read; to read another, pass its folder"
        warnings.warn(f"{folder.parent} has {len(others) + 1} models: {do}", DatasetWarning, stacklevel=3)
    model = read_model(cameras_file)
    poses, source = _poses(model, cameras_file), _images_file(cameras_file)
    images, lenses = _images_folder(root, folder), _lenses(model, cameras_file)
    frames: dict[str, Frame] = {}
    for pose in poses:
        picture = within(images, pose.name, str(source))
        mask, lens = find_mask(images.parent / "masks", Path(pose.name)), lenses[pose.lens]
        photo = photograph(picture, mask, lens.size, downscale)
        if photo is not None:
            where = f"{source}, {pose.name}"
            frames[pose.name] = photo.frame(_to_world(pose, where), lens, downscale, where)
    missing = [images / pose.name for pose in poses if pose.name not in frames]
    report_missing(missing, len(poses), source)
    read_poses = [pose for pose in poses if pose.name in frames]
    return [frames[pose.name] for pose in _split(read_poses, folder / TEST_LIST, split, every)], model.points


def read_model_cameras(cameras_file: Path, split: Split | None = None) -> dict[str, Camera]:
    """The cameras of a model by the names of their pictures, which need not be there."""
    model = read_model(cameras_file)
    lenses, source = _lenses(model, cameras_file), _images_file(cameras_file)
    poses, images = _poses(model, cameras_file), _images_folder(cameras_file.parent, cameras_file.parent)
    if split is not None:
        poses = [pose for pose in poses if (images / pose.name).is_file()] or poses
    cameras = {}
    for pose in _split(poses, cameras_file.with_name(TEST_LIST), split, HELD_OUT):
        where = f"{source}, {pose.name}"
        cameras[pose.name] = pinhole_camera(_to_world(pose, where), lenses[pose.lens], where)
    return cameras


def _poses(model: Model, cameras_file: Path) -> list[Pose]:
    """The poses of a model in the order of names."""
    source = _images_file(cameras_file)
    if not model.poses:
        raise DatasetError.of(str(source), "at least one picture", "none", "register pictures first")
    poses = sorted(model.poses.values(), key=lambda pose: pose.name)
    refuse_doubles((pose.name for pose in poses), source)
    return poses


def _lenses(model: Model, cameras_file: Path) -> dict[int, Intrinsics]:
    """The lenses that poses have, by their numbers."""
    return {
        number: _intrinsics(model.lenses, number, cameras_file) for number in {p.lens for p in model.poses.values()}
    }


def _images_file(cameras_file: Path) -> Path:
    """The file of a model's poses, beside that of its cameras."""
    return cameras_file.with_name(f"images{cameras_file.suffix}")


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
        raise DatasetError.of(str(test_list), "names, one a line", str(error), "write it again") from error
    return [pose for pose in poses if (pose.name in tests) == (split == "test")]


def _intrinsics(lenses: Mapping[int, Lens], number: int, source: Path) -> Intrinsics:
    """What a model says of one lens."""
    if number not in lenses:
        raise DatasetError.of(str(source), f"a camera {number}", "none", "export the model again")
    lens, where = lenses[number], f"{source}, camera {number}"
    if lens.model not in (*ONE_FOCAL, *TWO_FOCALS):
        raise unreadable(where, lens.model)
    if len(lens.parameters) != MODELS[lens.model]:
        expected, got = f"{MODELS[lens.model]} parameters of {lens.model}", len(lens.parameters)
        raise DatasetError.of(where, expected, got, "export the model again")
    first = lens.parameters[:1] if lens.model in ONE_FOCAL else ()
    fx, fy, cx, cy, *rest = (*first, *lens.parameters)
    radial, tangential, divisor = rest, [0.0, 0.0], list[float]()
    if lens.model in _TANGENTIAL:
        radial, tangential, divisor = rest[:2] + rest[4:5], rest[2:4], rest[5:]
    try:
        return Intrinsics(
            focal=(fx, fy),
            principal=(cx, cy),
            size=(lens.width, lens.height),
            radial=tuple(radial),
            divisor=tuple(divisor),
            tangential=(tangential[0], tangential[1]),
            fisheye=lens.model.endswith("FISHEYE"),
        )
    except InvalidValueError as error:
        raise DatasetError(f"{where}: {error}") from error


def _to_world(pose: Pose, where: str) -> Tensor:
    """The camera-to-world matrix of a picture; its translation is not checked."""
    quaternion = torch.tensor(pose.quaternion, dtype=torch.float64)
    shift = torch.tensor(pose.translation, dtype=torch.float64)
    length = float(quaternion.norm())
    if not (math.isfinite(length) and length > 1e-6):
        raise DatasetError.of(where, "a quaternion", pose.quaternion, "register the picture again")
    rotation = to_matrix(quaternion / length)
    to_world = torch.eye(4, dtype=torch.float64)
    to_world[:3, :3], to_world[:3, 3] = rotation.T, -(rotation.T @ shift)
    return to_world
