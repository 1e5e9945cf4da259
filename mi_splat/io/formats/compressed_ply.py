"""The compressed PLY of PlayCanvas and SuperSplat: chunks of 256 Gaussians, each value packed within its chunk's range.

Source: write-compressed-ply.ts, compressed-chunk.ts and decompress-ply.ts of github.com/playcanvas/splat-transform.
Means and log-scales take 11, 10 and 11 bits, a quaternion 2 bits for its largest component and 10 for each other one
(in the order w, x, y, z), colour and opacity 8 bits each, the other SH coefficients a byte each over -4 to 4.
"""

import dataclasses
import io

import numpy as np
from numpy.typing import NDArray

from mi_splat.io.errors import SplatFileError
from mi_splat.io.formats.encoded import (
    ROOT_HALF,
    Array,
    Encoded,
    Values,
    drop_largest,
    outside,
    restore_largest,
    vanished,
)
from mi_splat.io.formats.gaussian_ply import REST_COUNTS, is_antialiased, rest_names
from mi_splat.io.loaded import Arrays, Loaded, judged
from mi_splat.io.ply import Element, Header, header_bytes, read_rows
from mi_splat.sh import colour_to_dc

CHUNK = 256
"""Gaussians that share one range."""

_RANGES = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
_SCALES = [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
_COLOURS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
_PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_WIDE, _NARROW, _BYTE, _TEN = 2047, 1023, 255, 1023
_SH_LIMIT = 4.0


def read_compressed_ply(file: io.FileIO, header: Header, path: str) -> Loaded:
    """Read a compressed PLY, with or without ranges of colours and SH."""
    elements = {element.name: element for element in header.elements}
    vertex, chunk, rest = elements["vertex"], elements.get("chunk"), elements.get("sh")
    if chunk is None:
        raise _bad(path, "an element named chunk", ", ".join(elements))
    coloured = any(column.name in _COLOURS for column in chunk.properties)
    _check(vertex, _PACKED, "u4", path)
    _check(chunk, [*_RANGES, *_SCALES, *(_COLOURS if coloured else [])], "f4", path)
    if chunk.count != -(-vertex.count // CHUNK):
        raise _bad(path, f"one chunk for {CHUNK} of {vertex.count} Gaussians", f"{chunk.count} chunks")
    names = [] if rest is None else [column.name for column in rest.properties]
    if rest is not None:
        if len(names) not in REST_COUNTS[1:] or rest.count != vertex.count:
            raise _bad(path, "9, 24 or 45 bytes of SH for each Gaussian", f"{len(names)} for {rest.count}")
        _check(rest, rest_names(len(names)), "u1", path)
    packed = _columns(file, header, vertex, _PACKED, np.uint32, path)
    ends = _columns(file, header, chunk, [*_RANGES, *_SCALES, *(_COLOURS if coloured else [])], np.float64, path)
    ends = ends[np.arange(vertex.count) // CHUNK]
    colours = _bytes(packed[:, 3])
    means = _between(ends[:, 0:3], ends[:, 3:6], _unpack(packed[:, 0]))
    scales = np.exp(_between(ends[:, 6:9], ends[:, 9:12], _unpack(packed[:, 2])))
    shown = _between(ends[:, 12:15], ends[:, 15:18], colours[:, :3]) if coloured else colours[:, :3]
    sh = np.empty((vertex.count, 1 + len(names) // 3, 3), np.float32)
    sh[:, 0] = colour_to_dc(shown)
    if rest is not None:
        table = _columns(file, header, rest, rest_names(len(names)), np.uint8, path)
        sh[:, 1:] = _unpack_sh(table).reshape(len(table), 3, len(names) // 3).transpose(0, 2, 1)
    loaded = judged(means, scales, _unpack_rotations(packed[:, 1]), colours[:, 3], sh)
    return dataclasses.replace(loaded, is_antialiased=is_antialiased(header))


def write_compressed_ply(arrays: Arrays, *, antialiased: bool = False) -> Encoded:
    """A scene as a compressed PLY; the Gaussians are sorted along a Morton curve, so that chunks are small in space."""
    order = morton_order(arrays["means"].astype(np.float64))
    values = Values.of(arrays, order)
    parts = [(values.means, 3), (values.log_scales, 3), (values.colours, 3)]
    ranges = [_chunk_ranges(part) for part, _ in parts]
    means, logs, colours = (_fraction(part, ends) for (part, _), ends in zip(parts, ranges, strict=True))
    packed = np.stack(
        [
            _pack(means),
            _pack_rotations(values.rotations),
            _pack(logs),
            _join_bytes(np.concatenate([colours, values.opacities[:, None]], axis=1)),
        ],
        axis=1,
    ).astype("<u4")
    rest = values.sh[:, 1:].transpose(0, 2, 1)
    rest = rest.reshape(len(order), 3 * rest.shape[2])
    shape = [
        ("chunk", len(ranges[0]), "float", [*_RANGES, *_SCALES, *_COLOURS]),
        ("vertex", len(order), "uint", _PACKED),
    ]
    if rest.shape[1]:
        shape.append(("sh", len(order), "uchar", rest_names(rest.shape[1])))
    data = header_bytes(shape, antialiased=antialiased)
    data += np.concatenate(ranges, axis=1).astype("<f4").tobytes() + packed.tobytes() + _pack_sh(rest).tobytes()
    losses = [
        *outside("SH clamped to -4..4", rest, -_SH_LIMIT, _SH_LIMIT, "of a coefficient"),
        *vanished(values.opacities, np.rint(values.opacities * _BYTE).astype(np.uint8)),
    ]
    return Encoded(data, tuple(losses), order)


def morton_order(means: Array) -> NDArray[np.int64]:
    """Rows along a Morton curve (Morton 1966): the bits of x, y and z of 1024 cells an axis, interleaved."""
    if not len(means):
        return np.empty(0, np.int64)
    low = means.min(axis=0)
    extent = np.maximum(means.max(axis=0) - low, np.finfo(np.float64).tiny)
    cells = np.minimum((means - low) / extent * 1024, 1023).astype(np.int64)
    code = np.zeros(len(means), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def _check(element: Element, names: list[str], kind: str, path: str) -> None:
    """Raise unless an element has properties of these names and this kind, and nothing else."""
    kinds = {column.name: column.kind for column in element.properties if not column.length_kind}
    wrong = [name for name in names if kinds.get(name) != kind]
    if wrong or len(element.properties) != len(names):
        got = f"{len(element.properties)} properties" + (f" without such a {wrong[0]}" if wrong else "")
        raise _bad(path, f"{len(names)} properties of kind {kind} in the element {element.name}", got)


def _bad(path: str, expected: str, got: str) -> SplatFileError:
    return SplatFileError.of(path, f"a compressed PLY with {expected}", got, "export the splat again")


def _columns(
    file: io.FileIO, header: Header, element: Element, names: list[str], kind: type[np.generic], path: str
) -> Array:
    """(rows, names) values of an element."""
    rows = read_rows(file, header, element.name, path)
    table: Array = np.stack([rows[name] for name in names], axis=1).astype(kind)
    return table


def _between(low: Array, high: Array, fraction: Array) -> Array:
    mixed: Array = low * (1 - fraction) + high * fraction
    return mixed


def _chunk_ranges(values: Array) -> Array:
    """(chunks, 6) smallest and largest values of each chunk, as float32 holds them."""
    starts = np.arange(0, len(values), CHUNK)
    if not len(starts):
        return np.empty((0, 6))
    ends = np.concatenate([np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)], axis=1)
    return ends.astype(np.float32).astype(np.float64)


def _fraction(values: Array, ranges: Array) -> Array:
    """Where values lie within the range of their chunk, 0 to 1."""
    ends = ranges[np.arange(len(values)) // CHUNK]
    extent = ends[:, 3:] - ends[:, :3]
    return np.clip(np.divide(values - ends[:, :3], extent, out=np.zeros_like(values), where=extent > 0), 0, 1)


def _whole(fraction: Array, largest: int) -> NDArray[np.uint32]:
    whole: NDArray[np.uint32] = np.clip(np.floor(fraction * largest + 0.5), 0, largest).astype(np.uint32)
    return whole


def _joined(*fields: tuple[NDArray[np.uint32], int]) -> NDArray[np.uint32]:
    """One number of several, each shifted to the left by so many bits."""
    word = np.zeros(len(fields[0][0]), np.uint32)
    for value, shift in fields:
        word |= value << np.uint32(shift)
    return word


def _pack(fraction: Array) -> NDArray[np.uint32]:
    """Three numbers in 11, 10 and 11 bits."""
    x, y, z = fraction.T
    return _joined((_whole(x, _WIDE), 21), (_whole(y, _NARROW), 11), (_whole(z, _WIDE), 0))


def _unpack(packed: Array) -> Array:
    word = packed.astype(np.uint32)
    return np.stack([(word >> 21) / _WIDE, ((word >> 11) & _NARROW) / _NARROW, (word & _WIDE) / _WIDE], axis=1)


def _join_bytes(fraction: Array) -> NDArray[np.uint32]:
    red, green, blue, opacity = (_whole(column, _BYTE) for column in fraction.T)
    return _joined((red, 24), (green, 16), (blue, 8), (opacity, 0))


def _bytes(packed: Array) -> Array:
    word = packed.astype(np.uint32)
    return np.stack([((word >> shift) & _BYTE) / _BYTE for shift in (24, 16, 8, 0)], axis=1)


def _pack_rotations(quaternions: Array) -> NDArray[np.uint32]:
    largest, others = drop_largest(quaternions)
    a, b, c = (_whole(column * ROOT_HALF + 0.5, _TEN) for column in others.T)
    return _joined((largest.astype(np.uint32), 30), (a, 20), (b, 10), (c, 0))


def _unpack_rotations(packed: Array) -> Array:
    word = packed.astype(np.uint32)
    others = np.stack([((word >> shift) & _TEN) / _TEN for shift in (20, 10, 0)], axis=1)
    return restore_largest(word >> 30, (others - 0.5) / ROOT_HALF)


def _pack_sh(rest: Array) -> NDArray[np.uint8]:
    packed: NDArray[np.uint8] = np.clip(np.trunc((rest / (2 * _SH_LIMIT) + 0.5) * 256), 0, 255).astype(np.uint8)
    return packed


def _unpack_sh(packed: Array) -> Array:
    """Middles of the 256 steps; the first and the last stand for the ends of the range."""
    table = (np.arange(256) + 0.5) / 256
    table[0], table[255] = 0, 1
    values: Array = ((table - 0.5) * 2 * _SH_LIMIT)[packed.astype(np.uint8)]
    return values
