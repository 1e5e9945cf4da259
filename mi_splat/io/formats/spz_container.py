"""What is around the values of an SPZ file: gzip and a header of 16 bytes up to version 3, Zstandard from version 4.

Source: src/cc/load-spz.cc and README.md of github.com/nianticlabs/spz. A version 4 file has a header of 32 bytes,
extensions, a table with two 64-bit sizes for each section, and the sections, compressed one by one.
"""

import gzip
import struct
import zlib
from dataclasses import dataclass

import numpy as np
import zstandard
from numpy.typing import NDArray

from mi_splat.io.errors import SplatFileError
from mi_splat.io.loaded import check_count

_HEADER, _MAGIC, _EXTENDED = struct.Struct("<4sIIBBBB"), b"NGSP", 0x2
_LONG_HEADER = struct.Struct("<4sIIBBBBI12x")
_SIZES = struct.Struct("<QQ")
_RECORD, _SH_RANGE_RECORD, _AXES_RECORD = struct.Struct("<II"), 0xADBE0001, 0xADBE0003
_EXTENSION_LIMIT = 1 << 16
_WINDOW_LIMIT = 1 << 25
_AGAIN = "write or download it again"


@dataclass(frozen=True, slots=True)
class SpzHeader:
    """Numbers at the start of a file: version, Gaussians, SH degree, bits after the point of the means, flags."""

    version: int
    count: int
    degree: int
    bits: int
    flags: int

    def sizes(self) -> dict[str, int]:
        """Bytes of each section, in the order of the file."""
        rotations = 3 if self.version < 3 else 4
        each = {"means": 9, "opacities": 1, "colours": 3, "scales": 3, "rotations": rotations}
        each["sh"] = 3 * ((self.degree + 1) ** 2 - 1)
        return {name: size * self.count for name, size in each.items()}


@dataclass(frozen=True, slots=True, eq=False)
class SpzContent:
    """A decompressed file: its header, the bytes of its sections, and the number of its axes, 0 if it names none."""

    header: SpzHeader
    sections: dict[str, NDArray[np.uint8]]
    axes: int


def unpack_container(data: bytes, path: str) -> SpzContent:
    """Decompress a file, never beyond the size that its number of Gaussians asks for."""
    return _unpack_zstandard(data, path) if data.startswith(_MAGIC) else _unpack_gzip(data, path)


def pack_container(content: SpzContent) -> bytes:
    """The bytes of a file, the same ones each time."""
    head = content.header
    plain = {name: content.sections[name].tobytes() for name in head.sizes()}
    if head.version < 4:
        start = _HEADER.pack(_MAGIC, head.version, head.count, head.degree, head.bits, head.flags, 0)
        return gzip.compress(start + b"".join(plain.values()), 6, mtime=0)
    kept = [part for part in plain.values() if part]
    compressor = zstandard.ZstdCompressor(level=12)
    packed = [compressor.compress(part) for part in kept]
    start = _LONG_HEADER.pack(
        _MAGIC, head.version, head.count, head.degree, head.bits, head.flags, len(kept), _LONG_HEADER.size
    )
    table = b"".join(_SIZES.pack(len(small), len(part)) for small, part in zip(packed, kept, strict=True))
    return start + table + b"".join(packed)


def _bad(path: str, expected: str, got: object, do: str = _AGAIN) -> SplatFileError:
    return SplatFileError.of(path, expected, got, do)


def _checked(fields: tuple[int, ...], versions: tuple[int, ...], size: int, path: str) -> SpzHeader:
    """The header of these fields, if it can be that of a file of `size` bytes."""
    head = SpzHeader(*fields)
    if head.version not in versions:
        expected = f"version {' or '.join(map(str, versions))} in this kind of SPZ file"
        raise _bad(path, expected, head.version, "convert it to .ply with splat-transform")
    if head.degree > 4 or head.bits > 24:
        got = f"{head.degree} and {head.bits}"
        raise _bad(path, "an SH degree of 0 to 4 and 0 to 24 bits after the point", got)
    check_count(head.count, size, path)
    return head


def _unpack_gzip(data: bytes, path: str) -> SpzContent:
    """Versions 2 and 3: one gzip stream."""
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
        raise _bad(path, f"{wanted} bytes for {head.count} Gaussians", "more after them")
    return SpzContent(head, _split(body, head), _axes(rest, path))


def _unpack_zstandard(data: bytes, path: str) -> SpzContent:
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
        raise _bad(path, "a table of sections inside of the file", f"its start at byte {offset} of {len(data)}")
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
    return SpzContent(head, _split(b"".join(parts), head), _axes(records, path))


def _frame(packed: bytes, size: int, path: str) -> bytes:
    """The content of one Zstandard frame of `size` bytes; larger windows than 32 MiB are refused."""
    try:
        limited = zstandard.ZstdDecompressor(max_window_size=_WINDOW_LIMIT)
        with limited.stream_reader(packed, read_across_frames=False) as reader:
            plain = reader.read(size)
            more = reader.read(1)
    except zstandard.ZstdError as error:
        raise _bad(path, "an intact Zstandard stream", error) from None
    if len(plain) != size or more:
        raise _bad(path, f"{size} bytes in a section", f"{'more' if more else len(plain)}")
    return plain


def _split(body: bytes, head: SpzHeader) -> dict[str, NDArray[np.uint8]]:
    """The sections of the decompressed values."""
    whole, offset, sections = np.frombuffer(body, np.uint8), 0, {}
    for name, size in head.sizes().items():
        sections[name] = whole[offset : offset + size]
        offset += size
    return sections


def _axes(records: bytes, path: str) -> int:
    """The number of the axes that the extensions name, 0 if they name none; other extensions are passed over."""
    offset, axes = 0, 0
    while offset < len(records):
        if len(records) - offset < _RECORD.size:
            raise _bad(path, "whole extension records", f"{len(records) - offset} bytes of one")
        kind, length = _RECORD.unpack_from(records, offset)
        offset += _RECORD.size
        if length > len(records) - offset or (kind == _AXES_RECORD and length != 4):
            raise _bad(path, "extension records inside of the file", f"one of {length} bytes")
        if kind == _SH_RANGE_RECORD:
            do = "write it again with a released version of the program"
            raise _bad(path, "SH over -1 to 1", "the withdrawn extension SPZ_ADOBE_sh_quantization", do)
        if kind == _AXES_RECORD:
            (axes,) = struct.unpack_from("<I", records, offset)
        offset += length
    return int(axes)
