"""COLMAP's binary files. Counts in them are held against the bytes that are there before they are believed."""

import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from mi_splat.datasets.colmap_model import MODELS, Lens, Model, Pose, unreadable
from mi_splat.datasets.errors import DatasetError
from mi_splat.errors import InvalidValueError
from mi_splat.io.points import PointCloud

_COUNT = struct.Struct("<Q")
_LENS, _POSE, _POINT = struct.Struct("<iiQQ"), struct.Struct("<i4d3di"), struct.Struct("<Q3d3BdQ")
_POINT2D, _TRACK = 24, 8
"""Bytes of a 2D point of a picture, and of one entry of a point's track."""
_NAMES = tuple(MODELS)

Entry = TypeVar("Entry", Lens, Pose)


def read_model(folder: Path) -> Model:
    """The model in cameras.bin, images.bin and, if it is there, points3D.bin."""
    points = folder / "points3D.bin"
    return Model(
        _lenses(folder / "cameras.bin"), _poses(folder / "images.bin"), _points(points) if points.is_file() else None
    )


class _Reader:
    """Walks through the bytes of a file and never past their end."""

    def __init__(self, data: mmap.mmap | bytes, path: Path) -> None:
        self._data, self._path, self._at = data, path, 0

    def take(self, form: struct.Struct) -> tuple[int | float, ...]:
        """The next values."""
        start = self._at
        self.skip(form.size)
        return form.unpack_from(self._data, start)

    def count(self, least: int) -> int:
        """The next count, of things that have at least so many bytes each."""
        value = int(self.take(_COUNT)[0])
        left = len(self._data) - self._at
        if value * least > left:
            got = f"{value} records of {least} bytes or more in the last {left} bytes"
            raise self._fault("counts that fit the file", got)
        return value

    def text(self) -> str:
        """The next text, which ends with a zero byte."""
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise self._fault("a name that ends", "the end of the file")
        start, self._at = self._at, end + 1
        try:
            return bytes(self._data[start:end]).decode("utf-8")
        except UnicodeDecodeError as error:
            raise self._fault("names in UTF-8", str(error)) from error

    def skip(self, size: int) -> None:
        """Step over bytes, which have to be there."""
        if size > len(self._data) - self._at:
            raise self._fault("more records", "the end of the file")
        self._at += size

    def finish(self) -> None:
        """Raise unless everything was read."""
        if self._at != len(self._data):
            raise self._fault(f"{self._at} bytes", f"{len(self._data)} bytes")

    def _fault(self, expected: str, got: str) -> DatasetError:
        return DatasetError.of(str(self._path), expected, got, "it is truncated or no COLMAP file: export again")


@contextmanager
def _opened(path: Path) -> Iterator[_Reader]:
    """A reader over a file, which is mapped and not loaded; the whole of it has to be read."""
    with path.open("rb") as file:
        if path.stat().st_size == 0:  # which cannot be mapped
            raise DatasetError.of(str(path), "a COLMAP file", "an empty file", "export the model again")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            reader = _Reader(data, path)
            yield reader
            reader.finish()


def _lenses(path: Path) -> dict[int, Lens]:
    """Cameras by id."""
    lenses: dict[int, Lens] = {}
    with _opened(path) as reader:
        for _ in range(reader.count(_LENS.size)):
            number, model, width, height = (int(value) for value in reader.take(_LENS))
            if not 0 <= model < len(_NAMES):
                raise unreadable(f"{path}, camera {number}", f"number {model}")
            parameters = reader.take(struct.Struct(f"<{MODELS[_NAMES[model]]}d"))
            _add(lenses, number, Lens(_NAMES[model], width, height, parameters), path)
    return lenses


def _poses(path: Path) -> dict[int, Pose]:
    """Pictures by id; their 2D points are passed over."""
    poses: dict[int, Pose] = {}
    with _opened(path) as reader:
        for _ in range(reader.count(_POSE.size + 1 + _COUNT.size)):
            number, *values, lens = reader.take(_POSE)
            pose = Pose(tuple(values[:4]), tuple(values[4:]), int(lens), reader.text())
            reader.skip(reader.count(_POINT2D) * _POINT2D)
            _add(poses, int(number), pose, path)
    return poses


def _points(path: Path) -> PointCloud:
    """The points; their errors and tracks are passed over."""
    with _opened(path) as reader:
        total = reader.count(_POINT.size)
        points, colours = np.empty((total, 3)), np.empty((total, 3), np.float32)
        for row in range(total):
            _, *values, _, track = reader.take(_POINT)
            points[row], colours[row] = values[:3], values[3:]
            reader.skip(int(track) * _TRACK)
    try:
        return PointCloud(torch.from_numpy(points), torch.from_numpy(colours / np.float32(255)))
    except InvalidValueError as error:
        raise DatasetError(f"{path}: {error}") from error


def _add(table: dict[int, Entry], number: int, entry: Entry, path: Path) -> None:
    """Put an entry under its id, which has to be free."""
    if number in table:
        raise DatasetError.of(str(path), "every id once", f"{number} twice", "export the model again")
    table[number] = entry
