"""The `.ksplat` file of GaussianSplats3D, versions 0.1 and up, compression levels 0 to 2; it is only read.

Source: src/loaders/SplatBuffer.js of github.com/mkkellogg/GaussianSplats3D. A header of 4096 bytes, headers of
1024 bytes for sections, and for each section: sizes of the buckets that are not full, centres of the buckets, and the
Gaussians. At levels 1 and 2 a mean is three 16-bit steps around the centre of its bucket, and scale and quaternion are
half floats.
"""

import io
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_splat.io.errors import SplatFileError
from mi_splat.io.loaded import Array, Loaded, read_whole, validated
from mi_splat.sh import colour_to_dc

_HEADER_SIZE, _SECTION_SIZE, _MOST_SECTIONS = 4096, 1024, 4096
_HEADER = struct.Struct("<BB2xII4xIH14xff")
_SECTION = struct.Struct("<IIIIfH2xI4xIIH")
_REST = (0, 9, 24, 45)
_FLOATS = ("<f4", "<f2", "<f2")
_SH_KINDS = ("<f4", "<f2", "u1")
_DEFAULT_RANGES, _DEFAULT_SH = (1, 32767, 32767), 1.5
_AGAIN = "write or download it again"


@dataclass(frozen=True, slots=True)
class _Section:
    """Where the data of a section begin, and what its header says."""

    offset: int
    count: int
    capacity: int
    bucket_size: int
    buckets: int
    block: float
    storage: int
    steps: int
    full: int
    partial: int
    degree: int


def read_ksplat(file: io.FileIO, path: str) -> Loaded:
    """Read a `.ksplat` file."""
    data = read_whole(file)
    if len(data) < _HEADER_SIZE:
        raise _bad(path, f"a header of {_HEADER_SIZE} bytes", f"{len(data)} bytes")
    major, minor, capacity, filled, count, level, low, high = _HEADER.unpack_from(data)
    if (major, minor < 1, level > 2) != (0, False, False):
        raise _bad(path, "version 0.1 and level 0, 1 or 2", f"version {major}.{minor} and level {level}")
    if filled > capacity or capacity > _MOST_SECTIONS or _HEADER_SIZE + capacity * _SECTION_SIZE > len(data):
        raise _bad(path, "headers of sections inside of the file", f"{capacity} of them")
    bounds = (low or -_DEFAULT_SH, high or _DEFAULT_SH)
    offset, sections = _HEADER_SIZE + capacity * _SECTION_SIZE, []
    for number in range(capacity):
        start = _HEADER_SIZE + number * _SECTION_SIZE
        section = _Section(offset, *_SECTION.unpack_from(data, start))
        if number < (filled or capacity):
            offset = _end(section, level, len(data), path)
            sections.append(section)
    if sum(section.count for section in sections) != count:
        raise _bad(path, f"{count} Gaussians in the sections", sum(section.count for section in sections))
    degree = max((section.degree for section in sections), default=0)
    return _joined([_gaussians(data, section, level, bounds, degree, path) for section in sections], degree)


def _bad(path: str, expected: str, got: object) -> SplatFileError:
    return SplatFileError.of(path, expected, got, _AGAIN)


def _record(level: int, degree: int) -> np.dtype[np.void]:
    means, sh = "<f4" if level == 0 else "<u2", (_SH_KINDS[level], (_REST[degree],))
    scalar = _FLOATS[level]
    fields = [("means", means, (3,)), ("scales", scalar, (3,)), ("rotations", scalar, (4,)), ("colours", "u1", (4,))]
    return np.dtype([*fields, ("sh", *sh)])


def _end(section: _Section, level: int, size: int, path: str) -> int:
    """Where the data of a section end, after its numbers were held against each other and the file."""
    if section.degree >= len(_REST) or section.count > section.capacity:
        raise _bad(path, "SH degree 0 to 3 and counts within capacity", f"{section.degree} and {section.count}")
    if level and section.buckets and section.storage < 12:
        raise _bad(path, "12 bytes for the centre of a bucket", section.storage)
    buckets = 4 * section.partial + section.storage * section.buckets
    end = section.offset + buckets + _record(level, section.degree).itemsize * section.capacity
    if end > size:
        raise _bad(path, f"at least {end} bytes", f"{size}: it is truncated")
    if level and section.count and section.full + section.partial > section.buckets:
        raise _bad(path, f"{section.full + section.partial} buckets", section.buckets)
    return end


def _gaussians(
    data: bytes, section: _Section, level: int, bounds: tuple[float, float], degree: int, path: str
) -> tuple[Array, ...]:
    offset = section.offset + 4 * section.partial + section.storage * section.buckets
    rows = np.frombuffer(data, _record(level, section.degree), section.count, offset)
    means = rows["means"].astype(np.float64)
    if level and section.count:
        steps = section.steps or _DEFAULT_RANGES[level]
        means = (means - steps) * (section.block / 2 / steps) + _centres(data, section, path)
    sh = np.zeros((section.count, (degree + 1) ** 2, 3))
    sh[:, 0] = colour_to_dc(rows["colours"][:, :3] / 255.0)
    rest = rows["sh"].astype(np.float64)
    if level == 2:
        rest = bounds[0] + rest / 255 * (bounds[1] - bounds[0])
    for band in range(1, section.degree + 1):  # each band has all of red, then green, then blue
        first, last = 3 * (band**2 - 1), 3 * ((band + 1) ** 2 - 1)
        sh[:, band**2 : (band + 1) ** 2] = rest[:, first:last].reshape(-1, 3, 2 * band + 1).transpose(0, 2, 1)
    return means, rows["scales"], rows["rotations"], rows["colours"][:, 3] / 255.0, sh


def _centres(data: bytes, section: _Section, path: str) -> Array:
    """(count, 3) centre of the bucket of each Gaussian: full buckets first, then those with sizes of their own."""
    sizes = np.frombuffer(data, "<u4", section.partial, section.offset).astype(np.int64)
    first = min(section.full * section.bucket_size, section.count)
    indices = np.arange(first) // max(1, section.bucket_size)
    ends = np.cumsum(sizes)
    beyond = np.arange(section.count - first)
    if len(beyond) and (not len(ends) or ends[-1] < len(beyond)):
        raise _bad(path, f"buckets for {len(beyond)} Gaussians", int(ends[-1]) if len(ends) else 0)
    indices = np.concatenate([indices, section.full + np.searchsorted(ends, beyond, side="right")])
    raw = np.frombuffer(data, np.uint8, section.storage * section.buckets, section.offset + 4 * section.partial)
    if len(indices) and int(indices.max()) >= section.buckets:
        raise _bad(path, f"more than {int(indices.max())} buckets", section.buckets)
    centres: NDArray[np.float32] = np.ascontiguousarray(raw.reshape(section.buckets, -1)[:, :12]).view("<f4")
    chosen: Array = centres[indices].astype(np.float64)
    return chosen


def _joined(parts: list[tuple[Array, ...]], degree: int) -> Loaded:
    if not parts:
        parts = [tuple(np.zeros((0, *shape)) for shape in ((3,), (3,), (4,), (), ((degree + 1) ** 2, 3)))]
    means, scales, rotations, opacities, sh = (np.concatenate(column) for column in zip(*parts, strict=True))
    return validated(means, scales, rotations, opacities, sh)
