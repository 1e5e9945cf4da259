"""COLMAP's text files."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from mi_splat.datasets.colmap_model import Lens, Model, Pose
from mi_splat.datasets.errors import DatasetError
from mi_splat.errors import InvalidValueError
from mi_splat.io.points import PointCloud


def read_model(folder: Path) -> Model:
    """The model in cameras.txt, images.txt and, if it is there, points3D.txt."""
    points = folder / "points3D.txt"
    return Model(
        _lenses(folder / "cameras.txt"), _poses(folder / "images.txt"), _points(points) if points.is_file() else None
    )


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Number and text of the lines that are no comments, empty ones too."""
    with path.open(encoding="utf-8") as file:
        try:
            for number, line in enumerate(file, start=1):
                if not line.startswith("#"):
                    yield number, line.strip()
        except UnicodeDecodeError as error:
            raise DatasetError.of(str(path), "text in UTF-8", str(error), "export the model again") from error


def _fault(path: Path, number: int, expected: str, line: str) -> DatasetError:
    """The error for a line that cannot be understood."""
    return DatasetError.of(f"{path}, line {number}", expected, repr(line[:80]), "export the model again")


def _lenses(path: Path) -> dict[int, Lens]:
    """Cameras by id."""
    lenses: dict[int, Lens] = {}
    for number, line in _lines(path):
        fields = line.split()
        if not fields:
            continue
        try:
            key, width, height = (int(fields[i]) for i in (0, 2, 3))
            lens = Lens(fields[1], width, height, tuple(float(field) for field in fields[4:]))
        except (ValueError, IndexError) as error:
            raise _fault(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS...", line) from error
        if key in lenses:
            raise _fault(path, number, "every id once", line)
        lenses[key] = lens
    return lenses


def _poses(path: Path) -> dict[int, Pose]:
    """Pictures by id; the line of 2D points that follows each is passed over."""
    poses: dict[int, Pose] = {}
    lines = _lines(path)
    for number, line in lines:
        fields = line.split(maxsplit=9)
        if not fields:
            continue
        try:
            key, lens = int(fields[0]), int(fields[8])
            pose = Pose(tuple(map(float, fields[1:5])), tuple(map(float, fields[5:8])), lens, fields[9])
        except (ValueError, IndexError) as error:
            raise _fault(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", line) from error
        if key in poses:
            raise _fault(path, number, "every id once", line)
        poses[key] = pose
        after, points2d = next(lines, (number, ""))
        if not _are_points2d(points2d.split()):
            raise _fault(path, after, "a line of 2D points (X Y POINT3D_ID), which may be empty", points2d)
    return poses


def _are_points2d(fields: Sequence[str]) -> bool:
    """Whether fields are triples whose third is an integer."""
    return len(fields) % 3 == 0 and all(field.lstrip("-").isdigit() for field in fields[2::3])


def _points(path: Path) -> PointCloud:
    """The points; their errors and tracks are passed over."""
    rows = []
    for number, line in _lines(path):
        fields = line.split(maxsplit=7)
        if not fields:
            continue
        try:
            rows.append([*(float(fields[i]) for i in (1, 2, 3)), *(int(fields[i]) / 255 for i in (4, 5, 6))])
        except (ValueError, IndexError) as error:
            raise _fault(path, number, "POINT3D_ID X Y Z R G B ERROR TRACK...", line) from error
    values = np.array(rows, np.float64).reshape(-1, 6)
    try:
        return PointCloud(torch.from_numpy(values[:, :3]), torch.from_numpy(values[:, 3:]))
    except InvalidValueError as error:
        raise DatasetError(f"{path}: {error}") from error
