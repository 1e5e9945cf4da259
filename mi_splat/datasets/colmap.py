"""Reader of COLMAP models, text and binary: cameras, poses and points.

COLMAP's poses are world-to-camera with our camera axes, and (0.5, 0.5) is the centre of
its first pixel as of ours.
"""

import math
import struct
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera
from mi_splat.datasets.errors import DatasetError, DatasetWarning
from mi_splat.datasets.folders import SetFiles, image_folder, mask_folders
from mi_splat.datasets.frames import (
    HELD_OUT,
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
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.points import PointCloud
from mi_splat.maths.rotation import to_matrix


@dataclass(frozen=True, slots=True)
class Model:
    """A camera model of COLMAP: how many parameters it has, and how many of them are
    focal lengths.
    """

    parameters: int
    focals: int
    is_read: bool = True  # whether its distortion can be undone


MODELS = {
    "SIMPLE_PINHOLE": Model(3, 1),
    "PINHOLE": Model(4, 2),
    "SIMPLE_RADIAL": Model(4, 1),
    "RADIAL": Model(5, 1),
    "OPENCV": Model(8, 2),
    "OPENCV_FISHEYE": Model(8, 2),
    "FULL_OPENCV": Model(12, 2),
    "FOV": Model(5, 2, is_read=False),
    "SIMPLE_RADIAL_FISHEYE": Model(4, 1),
    "RADIAL_FISHEYE": Model(5, 1),
    "THIN_PRISM_FISHEYE": Model(12, 2, is_read=False),
    "RAD_TAN_THIN_PRISM_FISHEYE": Model(16, 2, is_read=False),
    "SIMPLE_DIVISION": Model(4, 1, is_read=False),
    "DIVISION": Model(5, 2, is_read=False),
    "SIMPLE_FISHEYE": Model(3, 1),
    "FISHEYE": Model(4, 2),
    "EUCM": Model(6, 2, is_read=False),
    "EQUIRECTANGULAR": Model(2, 0, is_read=False),
}
"""COLMAP's camera models, in the order of its ids."""
PANORAMA = "EQUIRECTANGULAR"
CUT_PANORAMAS = (
    "cut the panoramas into perspective images, for instance with `ns-process-data"
    " images --camera-type equirectangular --images-per-equirect 8` of nerfstudio"
)
"""What to do about panoramas, which no pinhole camera sees."""


@dataclass(frozen=True, slots=True)
class ModelCamera:
    """A camera of a model: image size in pixels, name of the distortion model, its
    parameters.
    """

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Pose:
    """An image of a model: quaternion (w, x, y, z) and translation from world to
    camera, camera id, file name.
    """

    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    lens: int
    name: str


Entry = TypeVar("Entry", ModelCamera, Pose)


def read_model(
    cameras_file: Path,
) -> tuple[list[Pose], dict[int, ModelCamera], PointCloud | None]:
    """The poses of a model in the order of names, the cameras that they have by their
    numbers, and points if it has.
    """
    suffix = cameras_file.suffix
    read = _Binary if suffix == ".bin" else _Text
    images = cameras_file.with_name(f"images{suffix}")
    points3d = cameras_file.with_name(f"points3D{suffix}")
    try:
        lenses = _by_id(read(cameras_file).lenses(), cameras_file)
        poses = _by_id(read(images).poses(), images)
        if points3d.is_file():
            rows = np.array(list(read(points3d).points()), np.float64)
        else:
            rows = None
    except FileNotFoundError as error:
        do = "a model has three files: cameras, images, points3D"
        raise DatasetError.of(
            str(error.filename), "a part of the model", "no such file", do
        ) from error
    except OSError as error:
        got = error.strerror or str(error)
        raise DatasetError.of(
            str(cameras_file), "a file that can be read", got, "check the path"
        ) from error
    if not poses:
        raise DatasetError.of(
            str(images), "at least one image", "none", "register images first"
        )
    ordered = sorted(poses.values(), key=lambda pose: pose.name)
    refuse_doubles((pose.name for pose in ordered), images)
    used = {
        number: _camera_of(lenses, number, cameras_file)
        for number in {pose.lens for pose in ordered}
    }
    if rows is None:
        return ordered, used, None
    points, colours = torch.from_numpy(rows.reshape(-1, 6)).tensor_split(2, dim=1)
    try:
        return ordered, used, PointCloud(points, colours / 255)
    except InvalidValueError as error:
        raise DatasetError(f"{points3d}: {error}") from error


def _by_id(entries: Iterator[tuple[int, Entry]], path: Path) -> dict[int, Entry]:
    """Entries by their ids, each of which has to come once."""
    table: dict[int, Entry] = {}
    for number, entry in entries:
        if number in table:
            raise DatasetError.of(
                str(path), "every id once", f"{number} twice", "export the model again"
            )
        table[number] = entry
    return table


class _Binary:
    """A binary file; 2D points, errors and tracks are passed over."""

    def __init__(self, path: Path) -> None:
        self._path, self._data, self._at = path, path.read_bytes(), 0

    def lenses(self) -> Iterator[tuple[int, ModelCamera]]:
        """Ids and cameras."""
        models = list(MODELS.items())
        for _ in self._records():
            number, model, width, height = self._take("iiQQ")
            if not 0 <= model < len(models):
                raise _unknown(f"{self._path}, camera {number}", f"number {model}")
            name, kind = models[model]
            yield (
                number,
                ModelCamera(name, width, height, self._take(f"{kind.parameters}d")),
            )

    def poses(self) -> Iterator[tuple[int, Pose]]:
        """Ids and images."""
        for _ in self._records():
            number, *values, lens = self._take("i7di")
            end = self._data.find(b"\0", self._at)
            name = self._data[self._at : end].decode("utf-8", "replace")
            self._at = end + 1 if end >= 0 else len(self._data)
            yield number, Pose(tuple(values[:4]), tuple(values[4:]), lens, name)
            (points,) = self._take("Q")
            self._at += 24 * points

    def points(self) -> Iterator[tuple[float, ...]]:
        """Coordinates and bytes of the colours."""
        for _ in self._records():
            _, *values, _, track = self._take("Q3d3BdQ")
            yield tuple(values)
            self._at += 8 * track

    def _records(self) -> Iterator[int]:
        """The numbers of the file's records, all of whose bytes have to be read."""
        yield from range(self._take("Q")[0])
        if self._at != len(self._data):
            raise self._fault(f"{self._at} bytes")

    def _take(self, form: str) -> tuple[Any, ...]:
        try:
            values = struct.unpack_from(f"<{form}", self._data, self._at)
        except (struct.error, OverflowError) as error:
            raise self._fault("more records") from error
        self._at += struct.calcsize(f"<{form}")
        return values

    def _fault(self, expected: str) -> DatasetError:
        got = f"{len(self._data)} bytes"
        do = "it is truncated or no COLMAP file: export again"
        return DatasetError.of(str(self._path), expected, got, do)


class _Text:
    """A text file; 2D points, errors and tracks are passed over."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def lenses(self) -> Iterator[tuple[int, ModelCamera]]:
        """Ids and cameras."""
        for line, fields in self._rows():
            with self._expected("CAMERA_ID MODEL WIDTH HEIGHT PARAMS...", line, fields):
                number, width, height = (int(fields[i]) for i in (0, 2, 3))
                lens = ModelCamera(
                    fields[1], width, height, tuple(map(float, fields[4:]))
                )
            yield number, lens

    def poses(self) -> Iterator[tuple[int, Pose]]:
        """Ids and images."""
        rows = self._rows(split=9, empty=True)
        for line, fields in rows:
            if not fields:
                continue
            with self._expected(
                "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", line, fields
            ):
                values = tuple(map(float, fields[1:8]))
                number = int(fields[0])
                pose = Pose(values[:4], values[4:], int(fields[8]), fields[9])
            yield number, pose
            line, points = next(rows, (line, []))
            points = " ".join(points).split()
            if len(points) % 3 or not all(
                field.lstrip("-").isdigit() for field in points[2::3]
            ):
                raise self._fault(
                    "a line of 2D points (X Y POINT3D_ID), which may be empty",
                    line,
                    points,
                )

    def points(self) -> Iterator[tuple[float, ...]]:
        """Coordinates and bytes of the colours."""
        for line, fields in self._rows(split=7):
            with self._expected("POINT3D_ID X Y Z R G B ERROR TRACK...", line, fields):
                row = (*map(float, fields[1:4]), *(int(fields[i]) for i in (4, 5, 6)))
            yield row

    def _rows(
        self, split: int = -1, *, empty: bool = False
    ) -> Iterator[tuple[int, list[str]]]:
        """Numbers and fields of the lines that are no comments."""
        with self._path.open(encoding="utf-8") as file:
            try:
                for number, line in enumerate(file, start=1):
                    if not line.startswith("#") and (empty or line.strip()):
                        yield number, line.strip().split(maxsplit=split)
            except UnicodeDecodeError as error:
                do = "export the model again"
                raise DatasetError.of(
                    str(self._path), "text in UTF-8", str(error), do
                ) from error

    @contextmanager
    def _expected(self, form: str, line: int, fields: Sequence[str]) -> Iterator[None]:
        """Name the line where what is read of it is of another form."""
        try:
            yield
        except (ValueError, IndexError) as error:
            raise self._fault(form, line, fields) from error

    def _fault(self, expected: str, line: int, fields: Sequence[str]) -> DatasetError:
        got = repr(" ".join(fields)[:80])
        return DatasetError.of(
            f"{self._path}, line {line}", expected, got, "export the model again"
        )


TEST_LIST = "test.txt"
"""Beside a model, the names of the images for tests, one a line."""

_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "0", ".")
_KINDS = (".bin", ".txt")


def find_model(path: Path) -> Path | None:
    """The cameras file of the first model in a folder, binary before text; None if
    there is none.
    """
    candidates = (
        path / folder / f"cameras{kind}" for folder in _FOLDERS for kind in _KINDS
    )
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def read_colmap(
    root: Path, cameras_file: Path, split: Split | None, every: int
) -> Found:
    """The frames of a split in the order of names, and the points."""
    folder = cameras_file.parent
    others = [
        other
        for other in sorted(folder.parent.glob("[0-9]*"))
        if other != folder and find_model(other)
    ]
    if folder.name == "0" and others and root != folder:
        do = f"{folder} is read; to read another, pass its folder"
        warnings.warn(
            f"{folder.parent} has {len(others) + 1} models: {do}",
            DatasetWarning,
            stacklevel=3,
        )
    poses, cameras, points = read_model(cameras_file)
    source = _images_file(cameras_file)
    images = _images_folder(root, folder)
    lenses = {
        number: _lens(camera, number, cameras_file, images)
        for number, camera in cameras.items()
    }
    files = SetFiles(images)
    masks = mask_folders(images)
    found: dict[str, Frame] = {}
    listed = set[Path]()
    missing = []
    for pose in poses:
        where = f"{source}, {pose.name}"
        path = files.find(pose.name, str(source))
        listed.add(path)
        if not path.is_file():
            missing.append(path)
            continue
        lens = lenses[pose.lens]
        mask = files.mask(masks, pose.name)
        found[pose.name] = frame_of(
            photo_of(path, lens.size), mask, _to_world(pose, where), lens, where
        )
    report_missing(missing, len(poses), source)
    report_frames(list(found.values()), source)
    read_poses = [pose for pose in poses if pose.name in found]
    frames = [
        found[pose.name]
        for pose in _split(read_poses, folder / TEST_LIST, split, every)
    ]
    return Found(frames, frozenset(listed), points)


def read_model_cameras(
    cameras_file: Path, split: Split | None = None
) -> dict[str, Camera]:
    """The cameras of a model by the names of their images, which need not be there.

    Where an image is there, its camera is that of `read_colmap`: without distortion,
    and upright. Of the others and of lenses that cannot be undone, distortion is
    ignored.
    """
    poses, model_cameras, _ = read_model(cameras_file)
    source = _images_file(cameras_file)
    images = _images_folder(cameras_file.parent, cameras_file.parent)
    files = SetFiles(images)
    paths = {pose.name: files.find(pose.name, str(source)) for pose in poses}
    present = {name for name, path in paths.items() if path.is_file()}
    if split is not None:
        poses = [pose for pose in poses if pose.name in present] or poses
    cameras = {}
    bent = set[str]()
    for pose in _split(poses, cameras_file.with_name(TEST_LIST), split, HELD_OUT):
        where = f"{source}, {pose.name}"
        model = model_cameras[pose.lens]
        to_world = _to_world(pose, where)
        try:
            if pose.name not in present:
                raise DatasetError.of(where, "its image", "none", "use only its pose")
            lens = _lens(model, pose.lens, cameras_file, images)
            cameras[pose.name] = frame_of(
                photo_of(paths[pose.name], lens.size), None, to_world, lens, where
            ).camera
        except MiSplatError:
            pinhole = _pinhole_part(model, f"{cameras_file}, camera {pose.lens}")
            cameras[pose.name] = camera_of(to_world, pinhole, where)
            bent |= {model.model} if _is_bent(model) else set()
    report_ignored_distortion(bent, cameras_file)
    return cameras


def report_ignored_distortion(models: Collection[str], source: Path) -> None:
    """Say that poses are used without the distortion of their lenses."""
    if models:
        text = (
            f"{source}: the poses are used without the distortion of their lenses"
            f" ({', '.join(sorted(models))})"
        )
        warnings.warn(text, DatasetWarning, stacklevel=4)


def _images_file(cameras_file: Path) -> Path:
    return cameras_file.with_name(f"images{cameras_file.suffix}")


def _images_folder(root: Path, folder: Path) -> Path:
    """Where a model's images are: images/ in the folder that was asked for or above the
    model.
    """
    return image_folder((root, folder, *list(folder.parents)[:3]))


def _split(
    poses: list[Pose], test_list: Path, split: Split | None, every: int
) -> list[Pose]:
    """The part of a model's images, by its list of test images if it has one."""
    if split is None or not test_list.is_file():
        return held_out(poses, split, every)
    try:
        tests = {line.strip() for line in test_list.read_text("utf-8").splitlines()}
    except (OSError, ValueError) as error:
        raise DatasetError.of(
            str(test_list), "names, one a line", str(error), "write it again"
        ) from error
    return [pose for pose in poses if (pose.name in tests) == (split == "test")]


def _camera_of(
    cameras: Mapping[int, ModelCamera], number: int, source: Path
) -> ModelCamera:
    """A camera of a model, of a kind that is known and with all of its parameters."""
    if number not in cameras:
        raise DatasetError.of(
            str(source), f"a camera {number}", "none", "export the model again"
        )
    camera = cameras[number]
    where = f"{source}, camera {number}"
    if camera.model not in MODELS:
        raise _unknown(where, camera.model)
    count = MODELS[camera.model].parameters
    if len(camera.parameters) != count:
        expected = f"{count} parameters of {camera.model}"
        got = len(camera.parameters)
        raise DatasetError.of(where, expected, got, "export the model again")
    return camera


def _unknown(where: str, model: str) -> DatasetError:
    """The error for a camera model that COLMAP 4.2 does not have."""
    do = "undistort the images with the program that wrote the model"
    return DatasetError.of(
        where, f"a camera model, one of {', '.join(MODELS)}", model, do
    )


def _pinhole_part(camera: ModelCamera, where: str) -> ImageLens:
    """The focal lengths and the principal point of a camera, without its distortion."""
    focals = MODELS[camera.model].focals
    if not focals:
        raise DatasetError.of(
            where, "a camera with a focal length", camera.model, CUT_PANORAMAS
        )
    fx, fy, cx, cy = (*camera.parameters[:1], *camera.parameters)[
        focals - 1 : focals + 3
    ]
    return ImageLens(
        focal=(fx, fy), principal=(cx, cy), size=(camera.width, camera.height)
    )


def _coefficients(camera: ModelCamera) -> tuple[float, ...]:
    """What a camera has beside focal lengths and principal point."""
    focals = MODELS[camera.model].focals
    if focals:
        return camera.parameters[focals + 2 :]
    return ()


def _is_bent(camera: ModelCamera) -> bool:
    return camera.model.endswith("FISHEYE") or any(_coefficients(camera))


def _lens(camera: ModelCamera, number: int, source: Path, images: Path) -> ImageLens:
    """The lens of a camera, whose distortion can be undone."""
    where = f"{source}, camera {number}"
    pinhole = _pinhole_part(camera, where)
    coefficients = _coefficients(camera)
    if not MODELS[camera.model].is_read:
        readable = [name for name, model in MODELS.items() if model.is_read]
        paths = ", ".join(
            repr(str(path)) for path in ("undistorted", source.parent, images)
        )
        do = (
            "pip install pycolmap, and undistort the set:"
            f" pycolmap.undistort_images({paths})"
        )
        raise DatasetError.of(
            where, f"a camera model of {', '.join(readable)}", camera.model, do
        )
    try:
        return replace(
            pinhole, distortion=coefficients, fisheye=camera.model.endswith("FISHEYE")
        )
    except InvalidValueError as error:
        raise DatasetError(f"{where}: {error}") from error


def _to_world(pose: Pose, where: str) -> Tensor:
    """The camera-to-world matrix of an image; its translation is not checked."""
    quaternion = torch.tensor(pose.quaternion, dtype=torch.float64)
    shift = torch.tensor(pose.translation, dtype=torch.float64)
    length = float(quaternion.norm())
    if not (math.isfinite(length) and length > 1e-6):
        raise DatasetError.of(
            where, "a quaternion", pose.quaternion, "register the image again"
        )
    rotation = to_matrix(quaternion / length)
    to_world = torch.eye(4, dtype=torch.float64)
    to_world[:3, :3], to_world[:3, 3] = rotation.T, -(rotation.T @ shift)
    return to_world
