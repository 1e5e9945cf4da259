"""PLY files: the header within bounds, and the rows of its elements.

Every size that a header claims is held against the bytes that are there before memory is taken for it. NumPy reads
binary rows; the package plyfile (GPL, optional) reads text and rows with lists.
"""

from __future__ import annotations

import dataclasses
import io
import math
import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from mi_splat.io.documents import atomic_write, write_all
from mi_splat.io.errors import LFS_ADVICE, LFS_POINTER, SplatFileError
from mi_splat.io.loaded import HIGHER_BANDS, SHOWN, Loaded, judged, unit
from mi_splat.sh import colour_to_dc

if TYPE_CHECKING:
    from mi_splat.scene import GaussianScene

# Splats as 3D Gaussian Splatting writes them: PLY with log-scales, logit opacities and SH channel by channel.
#
# Also read are 2DGS (two scales), the column `filter_3D` of Mip-Splatting and the 8-bit colours of nerfstudio.
# Comments of Brush and Postshot say whether a splat was trained with antialiasing.

_MEANS, _NORMALS, _DC = ["x", "y", "z"], ["nx", "ny", "nz"], ["f_dc_0", "f_dc_1", "f_dc_2"]
_SCALES, _ROTATIONS = ["scale_0", "scale_1", "scale_2"], ["rot_0", "rot_1", "rot_2", "rot_3"]
_RGB, _FILTER = ["red", "green", "blue"], "filter_3D"
REST_COUNTS = (0, 9, 24, 45)
"""Number of f_rest_* properties for SH degree 0 to 3: all of red, then green, then blue."""
_REST_OF_DEGREE_4 = 72
_FLATNESS = 1e-3
"""Third scale of a flat Gaussian, as a share of the smaller of its other two."""
_MODE = re.compile(r"splatrendermode:\s*(\w+)|(?:postshot\.)?(?:antialiased|anti_aliasing)[ =]+(\d)", re.IGNORECASE)


def rest_names(count: int) -> list[str]:
    """Names of the SH properties after the first coefficients."""
    return [f"f_rest_{i}" for i in range(count)]


def is_antialiased(header: Header) -> bool:
    """Whether the comments say that a splat was trained with antialiasing; the last one counts."""
    modes = [match for comment in header.comments if (match := _MODE.fullmatch(comment.strip()))]
    return bool(modes) and ((modes[-1][1] or "").lower() == "mip" or modes[-1][2] == "1")


def read_splat(file: io.FileIO, header: Header, path: str) -> Loaded:
    """Read a splat in any encoding, any kinds of numbers and any order of properties."""
    vertex = header.element("vertex")
    if vertex is None:
        raise ply_error(path, "an element named vertex", ", ".join(e.name for e in header.elements), "pass a splat")
    scale_names, colour_names, rest = _check_properties(vertex, path)
    rows = read_rows(file, header, "vertex", path)
    logits, logs = _columns(rows, ["opacity"])[:, 0], _columns(rows, scale_names)
    if len(scale_names) == 2:
        logs = np.concatenate([logs, logs.min(axis=1, keepdims=True) + math.log(_FLATNESS)], axis=1)
    # As `mi_splat.io.parameters.activate`: in float64, rounded once.
    scales, opacities = np.exp(logs, dtype=np.float64), 1 / (1 + np.exp(-logits.astype(np.float64)))
    opacities[~np.isfinite(logits)] = np.nan
    kinds = vertex.kinds()
    if _FILTER in kinds:  # the 3D smoothing filter, Yu et al. 2024, eq. 9
        wider = np.sqrt(scales**2 + rows[_FILTER].astype(np.float64)[:, None] ** 2)
        opacities, scales = opacities * (scales / wider).prod(axis=1), wider
    colours = _columns(rows, colour_names)
    if colour_names == _RGB:
        colours = colour_to_dc(colours / np.array([_full(kinds[name]) for name in _RGB]))
    kept = min(rest, REST_COUNTS[-1]) // 3
    sh = np.empty((len(rows), 1 + kept, 3), np.float32)
    sh[:, 0] = colours
    used = [name for channel in range(3) for name in rest_names(rest)[channel * rest // 3 :][:kept]]
    sh[:, 1:] = _columns(rows, used).reshape(len(rows), 3, kept).transpose(0, 2, 1)
    loaded = judged(_columns(rows, _MEANS), scales, unit(_columns(rows, _ROTATIONS)), opacities, sh)
    notices = [HIGHER_BANDS] if rest == _REST_OF_DEGREE_4 else []
    if len(scale_names) == 2:
        notices.append(("three scales", "two (a 2DGS splat)", "its flat Gaussians are drawn as very thin ellipsoids"))
    read = {*_MEANS, *_NORMALS, *scale_names, *_ROTATIONS, "opacity", *colour_names, *rest_names(rest), _FILTER}
    unread = [column.name for column in vertex.properties if column.name not in read]
    unread += [f"element {element.name}" for element in header.elements if element is not vertex]
    mode = _FILTER in kinds or is_antialiased(header)
    return dataclasses.replace(loaded, is_antialiased=mode, notices=tuple(notices), unread=tuple(unread))


def _check_properties(vertex: Element, path: str) -> tuple[list[str], list[str], int]:
    """Names of the scales and of the colours, and the number of further SH properties."""
    kinds, rest = vertex.kinds(), sum(column.name.startswith("f_rest_") for column in vertex.properties)
    if rest not in (*REST_COUNTS, _REST_OF_DEGREE_4):
        raise ply_error(path, "0, 9, 24 or 45 properties f_rest_* (SH degree 0 to 3)", rest)
    scales = _SCALES if _SCALES[2] in kinds else _SCALES[:2]
    colours = _RGB if _DC[0] not in kinds and set(_RGB) <= kinds.keys() else _DC
    needed = [*_MEANS, *scales, *_ROTATIONS, "opacity", *colours, *rest_names(rest)]
    missing = [name for name in needed if name not in kinds]
    if missing:
        more = f" and {len(missing) - SHOWN} more" if len(missing) > SHOWN else ""
        do = "pass a splat: this may be a point cloud, or a mesh, of which mi-splat capture takes pictures"
        raise ply_error(path, "the properties of a 3DGS splat", f"no {', '.join(missing[:SHOWN])}{more}", do)
    for name in needed:
        if kinds[name][0] != "f" and name not in _RGB:
            raise ply_error(path, f"{name} as float or double", f"an integer ({kinds[name]})")
    return scales, colours, rest


def _columns(rows: Rows, names: Sequence[str]) -> NDArray[np.floating]:
    """(rows, names) values, without a copy if that can be."""
    if not names or rows.dtype.hasobject:  # plyfile leaves the lists of a row as objects
        return np.stack([rows[name] for name in names], axis=1) if names else np.empty((len(rows), 0), np.float32)
    return np.asarray(structured_to_unstructured(rows[list(names)]))


def _full(kind: str) -> float:
    """The value of a colour channel that is fully lit."""
    return 1.0 if kind[0] == "f" else float(np.iinfo(kind).max)


def write_splat(scene: GaussianScene, path: str | os.PathLike[str], *, antialiased: bool = False) -> None:
    """Save a splat as 3DGS writes it: binary little-endian float32 with zero normals and the scene's SH degree.

    Means and SH of a float32 scene are kept bit for bit; saving what was loaded writes the same bytes again.
    """
    import torch  # reading does without

    from mi_splat.io.parameters import to_raw_parameters

    scene = scene.unchecked(*(value.detach().to("cpu", torch.float32) for value in scene.tensors()))
    values = {name: value.numpy() for name, value in to_raw_parameters(scene).items()}
    rest = values["sh"][:, 1:].transpose(0, 2, 1).reshape(len(scene), 3 * (scene.sh.shape[1] - 1))
    before = values["means"], np.zeros_like(values["means"]), values["sh"][:, 0], rest
    after = values["opacities"][:, None], values["scales"], values["rotations"]
    table = np.concatenate([*before, *after], axis=1, dtype="<f4")
    names = [*_MEANS, *_NORMALS, *_DC, *rest_names(rest.shape[1]), "opacity", *_SCALES, *_ROTATIONS]
    with atomic_write(path) as file:
        write_all(file, memoryview(header_bytes([("vertex", len(scene), "float", names)], antialiased=antialiased)))
        write_all(file, table.reshape(-1).view(np.uint8).data)


Rows = NDArray[np.void]

HEADER_LIMIT = 64 * 1024
"""Longest header in bytes; the ones that 3DGS writes have 1.5 KB."""
_MOST_LISTS, _LONGEST_LINE, _MOST_TEXT = 1 << 21, 1 << 20, 1 << 30
"""Lists that a file may have, bytes of a line of text, and bytes of a file that plyfile reads into objects."""

_ORDERS = {b"ascii": "", b"binary_little_endian": "<", b"binary_big_endian": ">"}
"""Byte order in NumPy's letters of each encoding, empty for text."""
_INTEGERS = {
    **dict.fromkeys((b"int8", b"char"), "i1"),
    **dict.fromkeys((b"uint8", b"uchar"), "u1"),
    **dict.fromkeys((b"int16", b"short"), "i2"),
    **dict.fromkeys((b"uint16", b"ushort"), "u2"),
    **dict.fromkeys((b"int32", b"int"), "i4"),
    **dict.fromkeys((b"uint32", b"uint"), "u4"),
}
_KINDS = {
    **_INTEGERS,
    **dict.fromkeys((b"float32", b"float"), "f4"),
    **dict.fromkeys((b"float64", b"double"), "f8"),
}
_NAMES = {kind: name for name, kind in _KINDS.items()}


@dataclass(frozen=True, slots=True)
class Property:
    """One column of an element: NumPy kind of its values, and of its length if each value is a list."""

    name: str
    kind: str
    length_kind: str = ""


@dataclass(frozen=True, slots=True)
class Element:
    """One table of a PLY file."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        """Whether rows may differ in size."""
        return any(column.length_kind for column in self.properties)

    def kinds(self) -> dict[str, str]:
        """NumPy kind of each property that is a single number."""
        return {column.name: column.kind for column in self.properties if not column.length_kind}


@dataclass(frozen=True, slots=True)
class Header:
    """What a PLY file says about itself: byte order ("" for text), tables in file order, size in bytes, comments."""

    order: str
    elements: tuple[Element, ...]
    size: int
    comments: tuple[str, ...]

    def element(self, name: str) -> Element | None:
        """The element of a name."""
        return next((element for element in self.elements if element.name == name), None)


def ply_error(path: str, expected: str, got: object, do: str = "export the splat again") -> SplatFileError:
    """The error for a PLY file."""
    return SplatFileError.of(path, expected, got, do)


def read_header(file: io.FileIO, path: str) -> Header:
    """Read the header at the start of `file`."""
    start = os.pread(file.fileno(), HEADER_LIMIT, 0)
    magic = re.match(rb"ply[ \t]*(\r\n|\n|\r)", start)
    if start.startswith(LFS_POINTER):
        raise ply_error(path, "a PLY file", *LFS_ADVICE)
    if magic is None:
        raise ply_error(path, "a PLY file (first line 'ply')", f"a file that starts with {start[:8]!r}", "pass a splat")
    newline = re.escape(magic[1])
    end = re.search(newline + rb"end_header[ \t\r]*" + newline, start)
    if end is None:
        do = "write or download it again, if it is truncated"
        raise ply_error(path, "a PLY header that ends with end_header", f"none in {len(start)} bytes", do)
    order, comments, elements = "none", list[str](), list[tuple[str, int, list[Property]]]()
    for line in start[magic.end() : end.start()].split(magic[1]):
        match line.split():
            case [] | [b"obj_info", *_]:
                pass
            case [b"comment", *words]:
                comments.append(b" ".join(words).decode("utf-8", "replace"))
            case [b"format", encoding, b"1.0"] if encoding in _ORDERS and order == "none":
                order = _ORDERS[encoding]
            case [b"element", name, count] if re.fullmatch(rb"\d{1,18}", count):
                elements.append((_text(name), int(count), []))
            case [b"property", kind, name] if elements and kind in _KINDS:
                elements[-1][2].append(Property(_text(name), _KINDS[kind]))
            case [b"property", b"list", length, kind, name] if elements and length in _INTEGERS and kind in _KINDS:
                elements[-1][2].append(Property(_text(name), _KINDS[kind], _INTEGERS[length]))
            case _:
                expected = "one format, elements with a count, and their properties, as in PLY 1.0"
                raise ply_error(path, expected, repr(_text(line.strip()[:80])), "repair the header or export it again")
    if order == "none":
        raise ply_error(path, "a line 'format' in the header", "none")
    tables = tuple(Element(name, count, tuple(columns)) for name, count, columns in elements)
    for names in (
        [table.name for table in tables],
        *([column.name for column in table.properties] for table in tables),
    ):
        if not names or len(set(names)) < len(names):
            got = next((f"{name} twice" for name in names if names.count(name) > 1), "none")
            raise ply_error(path, "elements and properties with different names", got)
    return Header(order, tables, end.end(), tuple(comments))


def _text(word: bytes) -> str:
    return word.decode("ascii", "backslashreplace")


def read_rows(file: io.FileIO, header: Header, name: str, path: str) -> Rows:
    """All rows of an element; of one with lists only the single numbers, and of text integers as float64."""
    size, number = os.fstat(file.fileno()).st_size, [element.name for element in header.elements].index(name)
    needed, later = header.elements[: number + 1], header.elements[number + 1 :]
    if not header.order or any(element.has_lists for element in needed):
        return _read_with_plyfile(file, header, needed, size, path)
    end = header.size + sum(map(_least, header.elements))
    if end > size or (end < size and not any(element.has_lists for element in later)):
        raise _mismatch(header, f"{end} bytes", f"{size} bytes", path)
    element = needed[-1]
    record = np.dtype([(column, header.order + kind) for column, kind in element.kinds().items()])
    file.seek(header.size + sum(map(_least, needed[:-1])))
    rows = np.fromfile(file, record, element.count)
    if len(rows) < element.count:
        raise ply_error(path, f"{element.count} rows of {name}", f"{len(rows)}: the file shrank", "try again")
    return rows


def _least(element: Element) -> int:
    """Bytes that an element takes in a binary file; the least, with empty lists, if it has lists."""
    return element.count * sum(int((column.length_kind or column.kind)[1:]) for column in element.properties)


def _mismatch(header: Header, expected: str, got: str, path: str) -> SplatFileError:
    counts = ", ".join(f"{element.count} x {element.name}" for element in header.elements)
    do = "it is truncated, something was appended, or a count is wrong: write or download it again"
    return ply_error(path, f"{expected} for {counts}", got, do)


def _read_with_plyfile(file: io.FileIO, header: Header, elements: tuple[Element, ...], size: int, path: str) -> Rows:
    """The rows of the last one of the first elements of a file, which are text or have lists.

    plyfile believes a header, so it gets one of our own, after the sizes were held against the bytes that are there.
    """
    wanted, what = elements[-1], "rows with lists" if header.order else "text"
    least = sum(e.count * 2 * len(e.properties) if not header.order else _least(e) for e in elements)
    lists = sum(e.count * sum(bool(column.length_kind) for column in e.properties) for e in elements)
    if header.size + least - (not header.order) > size or lists > _MOST_LISTS:
        raise _mismatch(header, f"at least {header.size + least} bytes of {what}", f"{size} bytes", path)
    if size > _MOST_TEXT:
        raise ply_error(path, f"at most {_MOST_TEXT:,} bytes of {what}", f"{size:,}", "export it as binary")
    try:
        import plyfile
    except ImportError as error:
        do = "pip install plyfile, or export the file as binary without lists"
        raise ply_error(path, f"the package plyfile, to read {what}", "none", do) from error
    file.seek(header.size)
    data = file.read()
    if not header.order:
        data = re.sub(rb"[\r\n]\s*", b"\n", data.strip()) + b"\n"
        lines, rows = data.count(b"\n") * (len(data) > 1), sum(element.count for element in header.elements)
        if lines != rows:
            raise _mismatch(header, f"{rows} lines", f"{lines}", path)
        if max(map(len, data.split(b"\n"))) > _LONGEST_LINE:
            raise ply_error(path, f"lines of at most {_LONGEST_LINE} bytes", "a longer one", "export it as binary")
    encoding = next(name for name, letter in _ORDERS.items() if letter == header.order)
    head = [b"ply", b"format " + encoding + b" 1.0"]
    for element in elements:
        head.append(f"element {element.name} {element.count}".encode())
        for column in element.properties:  # text says 255.0 for an integer, too
            kind = _NAMES["f8" if not header.order and column.kind[0] != "f" else column.kind]
            length = [b"list", _NAMES[column.length_kind]] if column.length_kind else []
            head.append(b" ".join([b"property", *length, kind, column.name.encode()]))
    stream = io.BytesIO(b"\n".join([*head, b"end_header", data]))
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # NumPy's, about lists without values
            table: Rows = plyfile.PlyData.read(stream, mmap=False)[wanted.name].data
    except (plyfile.PlyParseError, ValueError, OverflowError) as error:
        raise ply_error(path, f"intact {what} of {wanted.name}", " ".join(str(error).split())[:100]) from error
    if header.order and wanted is header.elements[-1] and stream.read(1):
        raise _mismatch(header, "the end of the file", "more", path)
    return table


def header_bytes(elements: Sequence[tuple[str, int, str, Sequence[str]]], *, antialiased: bool = False) -> bytes:
    """The header of a binary file with elements of a name, a count, and properties of one kind."""
    lines = ["ply", "format binary_little_endian 1.0", *(["comment SplatRenderMode: mip"] if antialiased else [])]
    for name, count, kind, columns in elements:
        lines += [f"element {name} {count}", *(f"property {kind} {column}" for column in columns)]
    return "\n".join([*lines, "end_header", ""]).encode()
