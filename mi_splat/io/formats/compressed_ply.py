"""The compressed PLY of PlayCanvas and SuperSplat: chunks of 256 Gaussians, each value
packed within its chunk's range.

Source: write-compressed-ply.ts, compressed-chunk.ts and decompress-ply.ts of
github.com/playcanvas/splat-transform. Means and log-scales take 11, 10 and 11 bits, a
quaternion 2 bits for its largest component and 10 for each other one (in the order w,
x, y, z), colour and opacity 8 bits each, the other SH coefficients a byte each over -4
to 4.
"""

import dataclasses
import io

import numpy as np
from numpy.typing import NDArray

from mi_splat.io.errors import SplatFileError
from mi_splat.io.formats.format import Saving
from mi_splat.io.loaded import (
    ROOT_HALF,
    Array,
    Arrays,
    Encoded,
    Loaded,
    Values,
    drop_largest,
    outside,
    restore_largest,
    validated,
    vanished,
)
from mi_splat.io.ply import (
    REST_COUNTS,
    Element,
    Header,
    header_bytes,
    read_header,
    read_rows,
    rest_names,
)
from mi_splat.io.up_axis import commented_up
from mi_splat.maths.sh import colour_to_dc

CHUNK = 256
"""Gaussians that share one range."""

_RANGES = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
_SCALES = [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
_COLOURS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
_PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_POSITION_BITS = (11, 10, 11)
_ROTATION_BITS = (10, 10, 10)
_COLOUR_BITS = (8, 8, 8, 8)
_SH_LIMIT = 4.0


def read_compressed_ply(file: io.FileIO, path: str) -> Loaded:
    """Read a compressed PLY, with or without ranges of colours and SH."""
    header = read_header(file, path)
    packed = _columns(file, header, "vertex", _PACKED, "u4", path).astype(np.uint32)
    chunk = header.elements.get("chunk")
    rest = header.elements.get("sh")
    coloured = chunk is not None and _COLOURS[0] in chunk.kinds
    names = [*_RANGES, *_SCALES, *(_COLOURS if coloured else [])]
    ends = _columns(file, header, "chunk", names, "f4", path).astype(np.float64)
    if len(ends) != -(-len(packed) // CHUNK):
        raise _bad(
            path,
            f"one chunk for {CHUNK} of {len(packed)} Gaussians",
            f"{len(ends)} chunks",
        )
    ends = ends[np.arange(len(packed)) // CHUNK]
    colours = _unpack(packed[:, 3], _COLOUR_BITS)
    shown = _between(ends[:, 12:18], colours[:, :3]) if coloured else colours[:, :3]
    sh = np.empty(
        (len(packed), 1 + (len(rest.columns) // 3 if rest else 0), 3), np.float32
    )
    sh[:, 0] = colour_to_dc(shown)
    if rest is not None:
        if len(rest.columns) not in REST_COUNTS[1:] or rest.count != len(packed):
            got = f"{len(rest.columns)} for {rest.count}"
            raise _bad(path, "9, 24 or 45 bytes of SH for each Gaussian", got)
        table = _columns(
            file, header, "sh", rest_names(len(rest.columns)), "u1", path
        ).astype(np.uint8)
        sh[:, 1:] = (
            _unpack_sh(table).reshape(len(table), 3, sh.shape[1] - 1).transpose(0, 2, 1)
        )
    loaded = validated(
        _between(ends[:, 0:6], _unpack(packed[:, 0], _POSITION_BITS)),
        np.exp(_between(ends[:, 6:12], _unpack(packed[:, 2], _POSITION_BITS))),
        restore_largest(
            packed[:, 1] >> 30,
            (_unpack(packed[:, 1], _ROTATION_BITS) - 0.5) / ROOT_HALF,
        ),
        colours[:, 3],
        sh,
    )
    up = commented_up(header.comments)
    return dataclasses.replace(
        loaded, is_antialiased=header.is_antialiased, stated_up=up
    )


def write_compressed_ply(arrays: Arrays, saving: Saving) -> Encoded:
    """A scene as a compressed PLY; the Gaussians are sorted along a Morton curve, so
    that chunks are small in space.
    """
    order = morton_order(arrays["means"].astype(np.float64))
    values = Values.of(arrays, order)
    parts = [values.means, values.log_scales, values.colours]
    ranges = [_chunk_ranges(part) for part in parts]
    means, logs, colours = (
        _fraction(part, ends) for part, ends in zip(parts, ranges, strict=True)
    )
    largest, others = drop_largest(values.rotations)
    packed = np.stack(
        [
            _pack(means, _POSITION_BITS),
            largest.astype(np.uint32) << 30
            | _pack(others * ROOT_HALF + 0.5, _ROTATION_BITS),
            _pack(logs, _POSITION_BITS),
            _pack(
                np.concatenate([colours, values.opacities[:, None]], axis=1),
                _COLOUR_BITS,
            ),
        ],
        axis=1,
    ).astype("<u4")
    rest = values.sh[:, 1:].transpose(0, 2, 1)
    rest = rest.reshape(len(order), 3 * rest.shape[2])
    elements = {
        "chunk": Element(
            len(ranges[0]), dict.fromkeys([*_RANGES, *_SCALES, *_COLOURS], ("f4",))
        ),
        "vertex": Element(len(order), dict.fromkeys(_PACKED, ("u4",))),
    }
    if rest.shape[1]:
        elements["sh"] = Element(
            len(order), dict.fromkeys(rest_names(rest.shape[1]), ("u1",))
        )
    data = header_bytes(elements, antialiased=saving.antialiased)
    data += (
        np.concatenate(ranges, axis=1).astype("<f4").tobytes()
        + packed.tobytes()
        + _pack_sh(rest).tobytes()
    )
    losses = [
        *outside(
            "SH clamped to -4..4", rest, -_SH_LIMIT, _SH_LIMIT, "of a coefficient"
        ),
        *vanished(values.opacities, np.rint(values.opacities * 255).astype(np.uint8)),
    ]
    return Encoded(data, tuple(losses), order)


def morton_order(means: Array) -> NDArray[np.int64]:
    """Rows along a Morton curve (Morton 1966): the bits of x, y and z of 1024 cells an
    axis, interleaved.
    """
    if not len(means):
        return np.empty(0, np.int64)
    low = means.min(axis=0)
    extent = np.maximum(means.max(axis=0) - low, np.finfo(np.float64).tiny)
    x, y, z = np.minimum((means - low) / extent * 1024, 1023).astype(np.int64).T
    bits = np.arange(10)
    spread = (((np.arange(1024)[:, None] >> bits) & 1) << 3 * bits).sum(1)
    code = spread[x] | spread[y] << 1 | spread[z] << 2
    # numbers of 16 bits are sorted by radix
    order = np.argsort((code & 0x7FFF).astype(np.uint16), kind="stable")
    return order[np.argsort((code[order] >> 15).astype(np.uint16), kind="stable")]


def _columns(
    file: io.FileIO, header: Header, name: str, columns: list[str], kind: str, path: str
) -> NDArray[np.generic]:
    """(rows, columns) values of an element that has these properties of this kind, and
    nothing else.
    """
    element = header.elements.get(name)
    if element is None or element.columns != dict.fromkeys(columns, (kind,)):
        got = "none" if element is None else f"{len(element.columns)} properties"
        raise _bad(
            path,
            f"{len(columns)} properties {columns[0]}, ... of kind {kind} in the element"
            f" {name}",
            got,
        )
    rows = read_rows(file, header, name, path)
    return np.stack([rows[column] for column in columns], axis=1)


def _bad(path: str, expected: str, got: str) -> SplatFileError:
    return SplatFileError.of(
        path, f"a compressed PLY with {expected}", got, "export the splat again"
    )


def _between(ends: Array, fraction: Array) -> Array:
    """Values out of where they lie between ends: the lower ones first, then the upper
    ones.
    """
    mixed: Array = ends[:, :3] * (1 - fraction) + ends[:, 3:] * fraction
    return mixed


def _chunk_ranges(values: Array) -> Array:
    """(chunks, 6) smallest and largest values of each chunk, as float32 holds them."""
    starts = np.arange(0, len(values), CHUNK)
    if not len(starts):
        return np.empty((0, 6))
    ends = np.concatenate(
        [np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)],
        axis=1,
    )
    return ends.astype(np.float32).astype(np.float64)


def _fraction(values: Array, ranges: Array) -> Array:
    ends = ranges[np.arange(len(values)) // CHUNK]
    extent = ends[:, 3:] - ends[:, :3]
    return np.clip(
        np.divide(
            values - ends[:, :3], extent, out=np.zeros_like(values), where=extent > 0
        ),
        0,
        1,
    )


def _pack(fraction: Array, bits: tuple[int, ...]) -> NDArray[np.uint32]:
    """Columns of numbers in 0..1 as one word, the first in the highest bits."""
    word = np.zeros(len(fraction), np.uint32)
    for column, width in zip(fraction.T, bits, strict=True):
        largest = (1 << width) - 1
        word = word << width | np.clip(
            np.floor(column * largest + 0.5), 0, largest
        ).astype(np.uint32)
    return word


def _unpack(word: NDArray[np.uint32], bits: tuple[int, ...]) -> Array:
    columns = []
    shift = sum(bits)
    for width in bits:
        shift = shift - width
        largest = (1 << width) - 1
        columns.append((word >> shift & largest) / largest)
    return np.stack(columns, axis=1)


def _pack_sh(rest: Array) -> NDArray[np.uint8]:
    packed: NDArray[np.uint8] = np.clip(
        np.trunc((rest / (2 * _SH_LIMIT) + 0.5) * 256), 0, 255
    ).astype(np.uint8)
    return packed


def _unpack_sh(packed: NDArray[np.uint8]) -> Array:
    """Middles of the 256 steps; the first and the last stand for the ends of the
    range.
    """
    table = (np.arange(256) + 0.5) / 256
    table[0], table[255] = 0, 1
    values: Array = ((table - 0.5) * 2 * _SH_LIMIT)[packed]
    return values
