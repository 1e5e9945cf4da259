"""SPZ of Niantic, versions 2 to 4: fixed-point means and one byte for nearly everything
else.

Source: src/cc/load-spz.cc and README.md of github.com/nianticlabs/spz. Values lie
attribute after attribute in the order means, opacities, colours, scales, rotations, SH.
The axes are x right, y up, z back (RUB): half a turn about x from those of the PLY. Up
to version 3, gzip is around a header of 16 bytes and the values. A file of version 4
has a header of 32 bytes, extensions, a table with two 64-bit sizes for each section,
and the sections, each in Zstandard.
"""

import dataclasses
import gzip
import io
import struct
import zlib
from dataclasses import dataclass

import numpy as np
import zstandard
from numpy.typing import NDArray

from mi_splat.io.errors import SplatFileError
from mi_splat.io.formats import axes
from mi_splat.io.formats.format import Format, Saving
from mi_splat.io.loaded import (
    HIGHER_BANDS,
    ROOT_HALF,
    Array,
    Arrays,
    Encoded,
    Loaded,
    Loss,
    Values,
    bytes_of,
    check_count,
    drop_largest,
    outside,
    read_whole,
    restore_largest,
    validated,
    vanished,
)

COLOUR_SCALE = 0.15
"""What an SH coefficient is multiplied with, where a colour would take 0.28: colours
beyond 0..1 shall fit.
"""

_USUAL_VERSION = 3
_HIGHEST = (1 << 23) - 1
_MOST_BITS = 23
_FEWEST_BITS = 4
_MAGNITUDE = 511
_ANTIALIASED = 0x1
_RUB = 4
_RDF = 6
"""Numbers of the axes that a file has unless it names others, and of those of the
PLY.
"""
_UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Quarter turn about x from axes whose z points up or down to those of which y does."""


def read_spz(file: io.FileIO, path: str) -> Loaded:
    """Read an SPZ file of version 2, 3 or 4."""
    data = read_whole(file)
    unpack_file = _unpack_zstandard if data.startswith(_MAGIC) else _unpack_gzip
    head, parts, number = unpack_file(data, path)
    count = head.count
    degree = min(head.degree, 3)
    sh = np.empty((count, (degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (parts["colours"].reshape(count, 3) / 255.0 - 0.5) / COLOUR_SCALE
    rest = parts["sh"].reshape(count, (head.degree + 1) ** 2 - 1, 3)
    sh[:, 1:] = (rest[:, : sh.shape[1] - 1].astype(np.float32) - 128) / 128
    unpack = _unpack_first_three if head.version < 3 else _unpack_smallest_three
    loaded = validated(
        _unpack_means(parts["means"], count) / 2.0**head.bits,
        np.exp(parts["scales"].reshape(count, 3) / 16.0 - 10),
        unpack(parts["rotations"].reshape(count, 3 if head.version < 3 else 4)),
        parts["opacities"] / 255.0,
        sh,
    )
    loaded = _in_ply_axes(loaded, number or _RUB, path)
    notices = (HIGHER_BANDS,) if head.degree > degree else ()
    return dataclasses.replace(
        loaded, is_antialiased=bool(head.flags & _ANTIALIASED), notices=notices
    )


def _in_ply_axes(loaded: Loaded, number: int, path: str) -> Loaded:
    """Turn from one of the 16 axes that the format can name to those of the PLY."""
    if number > 8:  # y and z are exchanged
        loaded = axes.transformed(loaded, _UPRIGHT, path)
    bits = ((number - 1) ^ (_RDF - 1)) & 7  # right or left, up or down, front or back
    x, y, z = (-1.0 if bits >> axis & 1 else 1.0 for axis in range(3))
    return dataclasses.replace(loaded, arrays=axes.flipped(loaded.arrays, (x, y, z)))


def write_spz(arrays: Arrays, saving: Saving) -> Encoded:
    """A scene as an SPZ file, in the scene's order.

    The point of the means is put as far to the left as they allow, and SH keep all 8
    bits of their bytes.
    """
    version = saving.version or _USUAL_VERSION
    pack_rotations = _pack_first_three if version < 3 else _pack_smallest_three
    values = Values.of(axes.flipped(arrays, axes.X))
    bits = _fraction_bits(values.means)
    limit = _HIGHEST / 2.0**bits
    rest = values.sh[:, 1:]
    opacities = bytes_of(values.opacities * 255)
    sections = {
        "means": _pack_means(np.clip(values.means, -limit, limit) * 2.0**bits),
        "opacities": opacities,
        "colours": bytes_of(values.sh[:, 0] * COLOUR_SCALE * 255 + 127.5),
        "scales": bytes_of((values.log_scales + 10) * 16),
        "rotations": pack_rotations(values.rotations),
        "sh": bytes_of(np.rint(rest * 128) + 128),
    }
    flags = _ANTIALIASED if saving.antialiased else 0
    header = SpzHeader(
        version=version,
        count=len(values.means),
        degree=values.degree,
        bits=bits,
        flags=flags,
    )
    return Encoded(_packed(header, sections), tuple(_losses(values, opacities, limit)))


def _losses(values: Values, opacities: NDArray[np.uint8], limit: float) -> list[Loss]:
    low = -0.5 / COLOUR_SCALE
    high = 0.5 / COLOUR_SCALE
    half = 0.5 / (255 * COLOUR_SCALE)
    return [
        *outside(
            f"means clipped to {limit:.0f}", values.means, -limit, limit, "world units"
        ),
        *outside(
            "log-scales clamped to -10..5.94",
            values.log_scales,
            -10 - 1 / 32,
            5.9375 + 1 / 32,
            "of a logarithm",
        ),
        *outside(
            "first SH clamped to -3.33..3.33",
            values.sh[:, 0],
            low - half,
            high + half,
            "of a coefficient",
        ),
        *outside(
            "SH clamped to -1..0.99",
            values.sh[:, 1:],
            -1 - 1 / 256,
            127.5 / 128,
            "of a coefficient",
        ),
        *vanished(values.opacities, opacities),
    ]


def _fraction_bits(means: Array) -> int:
    """The most bits after the point with which all means fit into 24 bits."""
    largest = float(np.abs(means).max(initial=0.0))
    return next(
        (
            bits
            for bits in range(_MOST_BITS, _FEWEST_BITS, -1)
            if round(largest * 2**bits) <= _HIGHEST
        ),
        4,
    )


def _pack_means(means: Array) -> NDArray[np.uint8]:
    """(N, 9) three little-endian bytes for each coordinate."""
    whole = np.rint(means).astype("<i4")
    return np.ascontiguousarray(
        whole.view(np.uint8).reshape(len(means), 3, 4)[:, :, :3]
    )


def _unpack_means(packed: NDArray[np.uint8], count: int) -> Array:
    wide = np.zeros((count, 3, 4), np.uint8)
    wide[:, :, 1:] = packed.reshape(count, 3, 3)
    # the sign is in the highest of the three bytes
    return (wide.view("<i4")[:, :, 0] >> 8).astype(np.float64)


def _pack_first_three(rotations: Array) -> NDArray[np.uint8]:
    """(N, 3) x, y and z where w is not negative."""
    return bytes_of(
        rotations[:, 1:] * np.where(rotations[:, :1] < 0, -127.5, 127.5) + 127.5
    )


def _unpack_first_three(packed: NDArray[np.uint8]) -> Array:
    vector = packed / 127.5 - 1
    return np.concatenate(
        [np.sqrt(np.maximum(0, 1 - (vector**2).sum(1, keepdims=True))), vector], axis=1
    )


def _pack_smallest_three(rotations: Array) -> NDArray[np.uint8]:
    """(N, 4) two bits for the largest of x, y, z, w, and sign and nine bits for each of
    the others.
    """
    largest, others = drop_largest(rotations[:, [1, 2, 3, 0]])
    size = np.floor(_MAGNITUDE * np.abs(others) / ROOT_HALF + 0.5).astype(np.uint32)
    a, b, c = (np.minimum(size, _MAGNITUDE) | (others < 0).astype(np.uint32) << 9).T
    word: NDArray[np.uint32] = largest.astype(np.uint32) << 30 | a << 20 | b << 10 | c
    packed: NDArray[np.uint8] = word.astype("<u4").view(np.uint8).reshape(-1, 4)
    return packed


def _unpack_smallest_three(packed: NDArray[np.uint8]) -> Array:
    word = np.ascontiguousarray(packed).view("<u4")[:, 0]
    fields = np.stack([(word >> shift) & 0x3FF for shift in (20, 10, 0)], axis=1)
    others = (
        (fields & _MAGNITUDE) * (ROOT_HALF / _MAGNITUDE) * np.where(fields >> 9, -1, 1)
    )
    return restore_largest(word >> 30, others)[:, [3, 0, 1, 2]]


_HEADER = struct.Struct("<4sIIBBBB")
_MAGIC = b"NGSP"
_EXTENDED = 0x2
_LONG_HEADER = struct.Struct("<4sIIBBBBI12x")
_SIZES = struct.Struct("<QQ")
_RECORD = struct.Struct("<II")
_SH_RANGE_RECORD = 0xADBE0001
_AXES_RECORD = 0xADBE0003
_EXTENSION_LIMIT = 1 << 16
_WINDOW_LIMIT = 1 << 25
_MOST_AXES = 16
_AGAIN = "write or download it again"


@dataclass(frozen=True, slots=True)
class SpzHeader:
    """Numbers at the start of a file: version, Gaussians, SH degree, bits after the
    point of the means, flags.
    """

    version: int
    count: int
    degree: int
    bits: int
    flags: int

    def sizes(self) -> dict[str, int]:
        """Bytes of each section, in the order of the file."""
        rotations = 3 if self.version < 3 else 4
        each = {
            "means": 9,
            "opacities": 1,
            "colours": 3,
            "scales": 3,
            "rotations": rotations,
        }
        each["sh"] = 3 * ((self.degree + 1) ** 2 - 1)
        return {name: size * self.count for name, size in each.items()}


_Content = tuple[SpzHeader, dict[str, NDArray[np.uint8]], int]
"""The header of a file, the bytes of its sections, and the number of its axes, 0 if it
names none.
"""


def _packed(head: SpzHeader, sections: dict[str, NDArray[np.uint8]]) -> bytes:
    """The bytes of a file, the same ones each time."""
    plain = {name: sections[name].tobytes() for name in head.sizes()}
    if head.version < 4:
        start = _HEADER.pack(
            _MAGIC, head.version, head.count, head.degree, head.bits, head.flags, 0
        )
        return gzip.compress(start + b"".join(plain.values()), 6, mtime=0)
    kept = [part for part in plain.values() if part]
    compressor = zstandard.ZstdCompressor(level=12)
    packed = [compressor.compress(part) for part in kept]
    start = _LONG_HEADER.pack(
        _MAGIC,
        head.version,
        head.count,
        head.degree,
        head.bits,
        head.flags,
        len(kept),
        _LONG_HEADER.size,
    )
    table = b"".join(
        _SIZES.pack(len(small), len(part))
        for small, part in zip(packed, kept, strict=True)
    )
    return start + table + b"".join(packed)


def _bad(path: str, expected: str, got: object, do: str = _AGAIN) -> SplatFileError:
    return SplatFileError.of(path, expected, got, do)


def _checked(
    fields: tuple[int, ...], versions: tuple[int, ...], size: int, path: str
) -> SpzHeader:
    """The header of these fields, if it can be that of a file of `size` bytes."""
    head = SpzHeader(*fields)
    if head.version not in versions:
        expected = f"version {' or '.join(map(str, versions))} in this kind of SPZ file"
        raise _bad(
            path, expected, head.version, "convert it to .ply with splat-transform"
        )
    if head.degree > 4 or head.bits > 24:
        got = f"{head.degree} and {head.bits}"
        raise _bad(path, "an SH degree of 0 to 4 and 0 to 24 bits after the point", got)
    check_count(head.count, size, path)
    return head


def _unpack_gzip(data: bytes, path: str) -> _Content:
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        start = stream.decompress(data, _HEADER.size)
        if len(start) < _HEADER.size or not start.startswith(_MAGIC):
            raise _bad(path, "an SPZ file inside of the gzip stream", repr(start[:8]))
        _, *fields, _ = _HEADER.unpack(start)
        head = _checked(tuple(fields), (2, 3), len(data), path)
        wanted = sum(head.sizes().values())
        body = stream.decompress(stream.unconsumed_tail, wanted) if wanted else b""
        rest = stream.decompress(stream.unconsumed_tail, _EXTENSION_LIMIT)
    except zlib.error as error:
        raise _bad(path, "an intact gzip stream", error) from None
    if len(body) < wanted or not stream.eof:
        got = f"{len(body)} and {'no ' if not stream.eof else ''}end of the stream"
        raise _bad(path, f"{wanted} bytes for {head.count} Gaussians", got)
    if stream.unused_data or (rest and not head.flags & _EXTENDED):
        raise _bad(
            path, f"{wanted} bytes for {head.count} Gaussians", "more after them"
        )
    return head, _split(body, head), _axes(rest, path)


def _unpack_zstandard(data: bytes, path: str) -> _Content:
    """Version 4: a plain header, and one Zstandard frame for each section."""
    if len(data) < _LONG_HEADER.size:
        raise _bad(path, f"a header of {_LONG_HEADER.size} bytes", f"{len(data)} bytes")
    _, *fields, streams, offset = _LONG_HEADER.unpack_from(data)
    head = _checked(tuple(fields), (4,), len(data), path)
    wanted = [size for size in head.sizes().values() if size]
    if streams not in (len(wanted), len(head.sizes())):
        raise _bad(path, f"{len(wanted)} sections", streams)
    wanted += [0] * (streams - len(wanted))
    begin = offset + streams * _SIZES.size
    if offset < _LONG_HEADER.size or begin > len(data):
        raise _bad(
            path,
            "a table of sections inside of the file",
            f"its start at byte {offset} of {len(data)}",
        )
    parts = []
    for number, size in enumerate(wanted):
        packed, plain = _SIZES.unpack_from(data, offset + number * _SIZES.size)
        if plain != size or packed > len(data) - begin:
            got = f"{plain} bytes, packed in {packed} of the {len(data) - begin} left"
            raise _bad(path, f"{size} bytes in section {number}", got)
        parts.append(_frame(data[begin : begin + packed], size, path) if size else b"")
        begin += packed
    if begin != len(data):
        raise _bad(path, f"{begin} bytes", f"{len(data)}: something was appended")
    records = data[_LONG_HEADER.size : offset] if head.flags & _EXTENDED else b""
    return head, _split(b"".join(parts), head), _axes(records, path)


def _frame(packed: bytes, size: int, path: str) -> bytes:
    """The content of one Zstandard frame of `size` bytes; larger windows than 32 MiB
    are refused.
    """
    try:
        limited = zstandard.ZstdDecompressor(max_window_size=_WINDOW_LIMIT)
        with limited.stream_reader(packed, read_across_frames=False) as reader:
            plain = reader.read(size)
            more = reader.read(1)
    except zstandard.ZstdError as error:
        raise _bad(path, "an intact Zstandard stream", error) from None
    if len(plain) != size or more:
        raise _bad(
            path, f"{size} bytes in a section", f"{'more' if more else len(plain)}"
        )
    return plain


def _split(body: bytes, head: SpzHeader) -> dict[str, NDArray[np.uint8]]:
    sizes = head.sizes()
    parts = np.split(
        np.frombuffer(body, np.uint8), np.cumsum(list(sizes.values()))[:-1]
    )
    return dict(zip(sizes, parts, strict=True))


def _axes(records: bytes, path: str) -> int:
    """The number of the axes that the extensions name, 0 if they name none; other
    extensions are passed over.
    """
    offset = 0
    number = 0
    while offset < len(records):
        if len(records) - offset < _RECORD.size:
            raise _bad(
                path, "whole extension records", f"{len(records) - offset} bytes of one"
            )
        kind, length = _RECORD.unpack_from(records, offset)
        offset += _RECORD.size
        if length > len(records) - offset or (kind == _AXES_RECORD and length != 4):
            raise _bad(
                path, "extension records inside of the file", f"one of {length} bytes"
            )
        if kind == _SH_RANGE_RECORD:
            do = "write it again with a released version of the program"
            raise _bad(
                path,
                "SH over -1 to 1",
                "the withdrawn extension SPZ_ADOBE_sh_quantization",
                do,
            )
        if kind == _AXES_RECORD:
            (number,) = struct.unpack_from("<I", records, offset)
            if number > _MOST_AXES:
                raise _bad(path, f"axes with a number up to {_MOST_AXES}", number)
        offset += length
    return int(number)


SPZ = Format(
    name="spz",
    suffixes=(".spz",),
    magic=(b"NGSP", b"\x1f\x8b"),
    read=read_spz,
    write=write_spz,
    keeps_antialiasing=True,
    in_archives=True,
    versions=(2, 3, 4),
)
