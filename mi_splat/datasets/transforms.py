"""Reader of the transforms.json family: Blender and NeRF, with one file a split or one
for all images.

Poses in these files are camera-to-world with OpenGL's axes (x right, y up, z backward);
the world is left as it is.
"""

import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera
from mi_splat.cameras.lens import PROJECTIONS, focal_of
from mi_splat.datasets.colmap import CUT_PANORAMAS, PANORAMA, report_ignored_distortion
from mi_splat.datasets.errors import DatasetError, DatasetWarning
from mi_splat.datasets.folders import IMAGES, MASKS, SetFiles, mask_folders
from mi_splat.datasets.frames import (
    Found,
    Frame,
    Split,
    camera_of,
    frame_of,
    held_out,
    photo_of,
    refuse_doubles,
    report_frames,
    report_missing,
)
from mi_splat.datasets.lenses import ImageLens
from mi_splat.datasets.nerfstudio import OPENGL as OPENGL
from mi_splat.datasets.nerfstudio import World, camera_path, is_camera_path, world_of
from mi_splat.errors import InvalidValueError
from mi_splat.io.parsing import DocumentReader, Fields
from mi_splat.io.points import PointCloud, load_points

SINGLE = "transforms.json"
PARTS = {"train": "transforms_train.json", "test": "transforms_test.json"}
POINTS = ("points3D.ply", "points3d.ply")
"""Names of a point cloud beside the file, if the file names none."""

_TRANSFORMS = DocumentReader(
    expected="JSON with a list of frames",
    do="repair it or write it again",
    error=DatasetError,
)
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_FISHEYE = (
    "OPENCV_FISHEYE",
    "FISHEYE",
    "SIMPLE_FISHEYE",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
)
_RATIONAL = "FULL_OPENCV"
_PERSPECTIVE = (
    *("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL"),
    _RATIONAL,
)
_IN_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""OpenCV's order of the coefficients of a perspective lens."""
_DIVISOR = ("k4", "k5", "k6")
"""Of the rational model. By k4 alone, programs mean different things."""
_ABOVE = 1
"""Folders above a file from which its images may come: some tools keep it beside
their folder.
"""


def find_transforms(path: Path) -> Path | None:
    """The first transforms file of a folder, or `path` itself if it is a JSON file;
    None if there is none.
    """
    if path.suffix.lower() == ".json":
        return path
    return next(
        (
            path / name
            for name in (PARTS["train"], SINGLE, PARTS["test"])
            if (path / name).is_file()
        ),
        None,
    )


def read_transforms(path: Path, split: Split | None, every: int) -> Found:
    """The frames of a split, and the points."""
    if path.name not in PARTS.values():
        document = _document(path)
        entries = _entries(document, path)
        frames = [
            frame for _, frame in _split(document, entries, split, every) if frame
        ]
        return Found(
            frames,
            frozenset(picture for picture, _ in entries),
            _points({path: document}),
        )
    files = {part: path.with_name(name) for part, name in PARTS.items()}
    wanted = files.values() if split is None else [files[split]]
    documents = {
        file: _document(file) for file in wanted if split == "train" or file.is_file()
    }
    entries = [
        entry
        for file, document in documents.items()
        for entry in _entries(document, file)
    ]
    refuse_doubles((str(picture) for picture, _ in entries), path)
    frames = [frame for _, frame in entries if frame]
    return Found(
        frames, frozenset(picture for picture, _ in entries), _points(documents)
    )


def _points(documents: Mapping[Path, Mapping[str, Any]]) -> PointCloud | None:
    """The point cloud of the first file that has one."""
    for path, document in documents.items():
        file = _points_file(document, path)
        if file is not None:
            points = load_points(file)
            world = world_of(path, document)
            if world is None:
                return points
            return world.points(points)
    return None


def read_cameras(path: Path, size: tuple[int, int]) -> list[Camera]:
    """The cameras of a transforms file in its order, whose images need not be there;
    distortion is ignored.

    Camera paths of nerfstudio's viewer are read, too. `size` is that of images where
    the file says none.
    """
    values = _TRANSFORMS.read_json(path) if path.is_file() else {}
    if is_camera_path(values):
        return camera_path(values, path, size)
    document = _document(path)
    world = world_of(path, document)
    cameras = []
    bent = set[str]()
    for number, entry in enumerate(document["frames"]):
        where = f"{path}, frame {number}"
        if not isinstance(entry, dict):
            raise DatasetError.of(
                where, "an object with a transform_matrix", "none", "repair it"
            )
        values = {**document, **entry}
        # a frame's own values come before those of the file
        own = _size(values, where) or size
        pose = _pose(values.get("transform_matrix"), where, world)
        cameras.append(camera_of(pose, _pinhole_part(values, own, where), where))
        bent |= _bent(values, where)
    report_ignored_distortion(bent, path)
    return cameras


def _document(path: Path) -> dict[str, Any]:
    if not path.exists():
        raise DatasetError.of(
            str(path),
            "a transforms file",
            "no such file",
            "write it, or choose another split",
        )
    document = _TRANSFORMS.read_json(path)
    if not isinstance(document.get("frames"), list):
        raise DatasetError.of(
            str(path),
            "an object with a list of frames",
            "none",
            "pass a NeRF transforms file",
        )
    if not document["frames"]:
        raise DatasetError.of(
            str(path), "at least one frame", "an empty list", "add images to it"
        )
    return document


def _entries(
    document: Mapping[str, Any], path: Path
) -> list[tuple[Path, Frame | None]]:
    """Every image that a file lists, and its frame if the image is there."""
    entries = []
    files = SetFiles(path.parent, above=_ABOVE)
    world = world_of(path, document)
    masks_missing = []
    for number, entry in enumerate(document["frames"]):
        if (
            not isinstance(entry, dict)
            or not isinstance(entry.get("file_path"), str)
            or not entry["file_path"]
        ):
            do = "give every frame its file_path"
            raise DatasetError.of(
                f"{path}, frame {number}", "an object with a file_path", "none", do
            )
        where = f"{path}, frame {number} ({entry['file_path'][:200]})"
        picture = files.find(entry["file_path"], where)
        frame = None
        if picture.is_file():
            values = {**document, **entry}
            mask, is_missing = _mask(entry, files, picture, where)
            masks_missing += [picture] if is_missing else []
            photo = photo_of(picture, _size(values, where))
            pose = _pose(values.get("transform_matrix"), where, world)
            frame = frame_of(photo, mask, pose, _lens(values, photo.size, where), where)
        entries.append((picture, frame))
    refuse_doubles((str(picture) for picture, _ in entries), path)
    report_missing(
        [picture for picture, frame in entries if frame is None], len(entries), path
    )
    report_frames([frame for _, frame in entries if frame is not None], path)
    if masks_missing:
        text = (
            f"{path}: {len(masks_missing)} of {len(entries)} masks missing; these"
            " images count as a whole"
        )
        warnings.warn(text, DatasetWarning, stacklevel=4)
    return entries


def _mask(
    entry: Mapping[str, Any], files: SetFiles, picture: Path, where: str
) -> tuple[Path | None, bool]:
    """The mask that the frame names, or that lies in a folder masks/; and whether one
    is named and missing.
    """
    named = entry.get("mask_path")
    if isinstance(named, str) and named:
        mask = files.find(named, f"{where}: mask_path", folder=MASKS)
        if mask.is_file():
            return (mask, False)
        return (None, True)
    name = PurePosixPath(entry["file_path"].replace("\\", "/")).with_name(picture.name)
    return files.mask(mask_folders(files.start / IMAGES), str(name)), False


def _number(values: Mapping[str, Any], key: str, where: str) -> float | None:
    """A number of the file, None if it is not there."""
    if values.get(key) is None:
        return None
    return Fields(values, where, DatasetError, "repair it").number(key)


def _size(values: Mapping[str, Any], where: str) -> tuple[int, int] | None:
    """The width and height that the file claims; None if it leaves them to the
    image.
    """
    width, height = (_number(values, key, where) for key in ("w", "h"))
    if width is None or height is None:
        return None
    if width != int(width) or height != int(height):
        raise DatasetError.of(
            f"{where}: w and h", "integers", (width, height), "repair them"
        )
    return int(width), int(height)


def _model(values: Mapping[str, Any]) -> str:
    """The camera model in capitals; the perspective one of OpenCV if none is named."""
    named = str(values.get("camera_model") or _PERSPECTIVE[0]).upper()[:60]
    if values.get("is_fisheye") and named in _PERSPECTIVE:
        return _FISHEYE[0]
    return named


def _bent(values: Mapping[str, Any], where: str) -> set[str]:
    """The camera model, if straight lines are not straight in its images."""
    model = _model(values)
    if _projection(model):
        return set()
    is_bent = model not in _PERSPECTIVE or any(
        _number(values, key, where) for key in _DISTORTION
    )
    if is_bent:
        return {model}
    return set()


def _projection(model: str) -> str | None:
    """The projection without distortion that a camera model is, other than the
    perspective one.
    """
    name = model.lower()
    if model in _PERSPECTIVE or name not in PROJECTIONS:
        return None
    return name


def _lens(values: Mapping[str, Any], size: tuple[int, int], where: str) -> ImageLens:
    """The lens of a frame, whose distortion can be undone."""
    model = _model(values)
    projection = _projection(model)
    if projection is not None:
        return replace(_pinhole_part(values, size, where), projection=projection)
    if model not in (*_PERSPECTIVE, *_FISHEYE):
        do = CUT_PANORAMAS
        if model != PANORAMA:
            do = (
                "find the cameras again with a model that is read: `mi-splat prepare"
                " IMAGES --out SET`"
            )
        known = f"a camera_model, one of {', '.join((*_PERSPECTIVE, *_FISHEYE))}"
        raise DatasetError.of(where, known, model, do)
    found = {key: _number(values, key, where) or 0.0 for key in _DISTORTION}
    fisheye = model in _FISHEYE
    order = ("k1", "k2", "k3", "k4") if fisheye else _IN_ORDER
    is_rational = model == _RATIONAL or bool(found["k5"] or found["k6"])
    usable = order if fisheye or is_rational else _IN_ORDER[:5]
    others = [key for key, value in found.items() if value and key not in usable]
    if others:
        do = (
            "remove them if they are zero in truth, or find the cameras again:"
            " `mi-splat prepare IMAGES --out SET`"
        )
        if not fisheye:
            do = (
                f"name the camera_model {_RATIONAL} if {others[0]} is a divisor as in"
                " OpenCV, or remove it"
            )
        raise DatasetError.of(
            where, f"coefficients {', '.join(usable)} of {model}", ", ".join(others), do
        )
    try:
        pinhole = _pinhole_part(values, size, where)
        return replace(
            pinhole, distortion=tuple(found[key] for key in usable), fisheye=fisheye
        )
    except InvalidValueError as error:
        raise DatasetError(f"{where}: {error}") from error


def _pinhole_part(
    values: Mapping[str, Any], size: tuple[int, int], where: str
) -> ImageLens:
    """The focal lengths and the principal point of a frame, without its distortion."""
    focal = [
        _focal(values, axis, pixels, where)
        for axis, pixels in zip("xy", size, strict=True)
    ]
    known_focal = [value for value in focal if value is not None]
    if not known_focal:
        raise DatasetError.of(
            where, "fl_x or camera_angle_x", "neither", "add one of the two"
        )
    fx, fy = (known_focal[0] if value is None else value for value in focal)
    cx, cy = (_number(values, key, where) for key in ("cx", "cy"))
    principal = (size[0] / 2 if cx is None else cx, size[1] / 2 if cy is None else cy)
    return ImageLens(focal=(fx, fy), principal=principal, size=size)


def _pose(matrix: object, where: str, world: World | None) -> Tensor:
    """The camera-to-world matrix with our axes, in another world if there is one; its
    values are not checked.
    """
    try:
        pose = torch.tensor(matrix, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        do = "give every frame a 4 x 4 transform_matrix"
        raise DatasetError.of(
            where, "a matrix of numbers", "something else", do
        ) from error
    if pose.shape == (3, 4):
        pose = torch.cat(
            [pose, torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)]
        )
    if pose.shape != (4, 4):
        return pose
    if world is None:
        return pose @ OPENGL
    return world.pose(pose @ OPENGL)


def _focal(
    values: Mapping[str, Any], axis: str, pixels: int, where: str
) -> float | None:
    """The focal length in pixels along an axis, from itself or from the field of view
    in radians.
    """
    focal = _number(values, f"fl_{axis}", where)
    angle = _number(values, f"camera_angle_{axis}", where)
    if focal is not None or angle is None:
        return focal
    if not 0 < angle < math.pi:
        raise DatasetError.of(
            f"{where}: camera_angle_{axis}",
            "an angle between 0 and pi",
            angle,
            "give it in radians",
        )
    return focal_of(angle, pixels)


def _split(
    document: Mapping[str, Any],
    entries: list[tuple[Path, Frame | None]],
    split: Split | None,
    every: int,
) -> list[tuple[Path, Frame | None]]:
    """The part of a single file: what its own lists of names say, or each `every`-th in
    the order of names.
    """
    listed = document.get(f"{split}_filenames")
    if split is not None and isinstance(listed, list):
        names = {Path(str(name)).with_suffix("").as_posix() for name in listed}
        pairs = zip(document["frames"], entries, strict=True)
        return [
            entry
            for fields, entry in pairs
            if Path(fields["file_path"]).with_suffix("").as_posix() in names
        ]
    present = (entry for entry in entries if entry[1] is not None)
    return held_out(sorted(present, key=lambda entry: str(entry[0])), split, every)


def _points_file(document: Mapping[str, Any], path: Path) -> Path | None:
    """The point cloud that the file names, or one beside it under a usual name; None if
    it is not there.
    """
    named = document.get("ply_file_path")
    if isinstance(named, str) and named:
        file = SetFiles(path.parent, above=_ABOVE).find(
            named, f"{path}: ply_file_path", folder=""
        )
        if file.is_file():
            return file
        text = f"{path}: the point cloud {named} is missing; going on without points"
        warnings.warn(text, DatasetWarning, stacklevel=4)
        return None
    return next(
        (path.parent / name for name in POINTS if (path.parent / name).is_file()), None
    )
