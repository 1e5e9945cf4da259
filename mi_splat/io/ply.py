"""PLY files: the header within bounds, the rows of its elements, and splats as 3D
Gaussian Splatting writes them.

Every size that a header claims is held against the bytes that are there before memory
is taken for it. NumPy reads binary rows; the package plyfile (GPL, optional) reads text
and rows with lists. Of splats, also 2DGS (two scales), the column `filter_3D` of
Mip-Splatting and the 8-bit colours of nerfstudio are read, and the comments in which
Brush and Postshot say whether a splat was trained with antialiasing.
"""

from __future__ import annotations

import dataclasses
import io
import math
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.lib.recfunctions import repack_fields, structured_to_unstructured
from numpy.typing import NDArray

from mi_splat.io.documents import save_bytes
from mi_splat.io.errors import SplatFileError
from mi_splat.io.loaded import (
    HIGHER_BANDS,
    SHOWN,
    Loaded,
    Notice,
    arrays_of,
    as_scene,
    ranges,
    unit,
    validated,
)
from mi_splat.io.up_axis import commented_up
from mi_splat.maths.sh import colour_to_dc

if TYPE_CHECKING:
    from mi_splat.scene import GaussianScene

Rows = NDArray[np.void]

_HEADER_LIMIT = 64 * 1024
"""Longest header in bytes; the ones that 3DGS writes have 1.5 KB."""
_MOST_LISTS = 1 << 21
_LONGEST_LINE = 1 << 20
_MOST_TEXT = 1 << 30
"""Lists that a file may have, bytes of a line of text, and bytes of a file that plyfile
reads into objects.
"""
_ORDERS = {b"ascii": "", b"binary_little_endian": "<", b"binary_big_endian": ">"}
"""Byte order in NumPy's letters of each encoding, empty for text."""
_PLY_NAMES = {
    "i1": b"int8 char",
    "u1": b"uint8 uchar",
    "i2": b"int16 short",
    "u2": b"uint16 ushort",
}
_PLY_NAMES |= {
    "i4": b"int32 int",
    "u4": b"uint32 uint",
    "f4": b"float32 float",
    "f8": b"float64 double",
}
_KINDS = {name: kind for kind, names in _PLY_NAMES.items() for name in names.split()}


@dataclass(frozen=True, slots=True)
class Element:
    """A table: the number of its rows, and NumPy's kind of each column; of lists, that
    of their length before it.
    """

    count: int
    columns: dict[str, tuple[str, ...]]

    @property
    def kinds(self) -> dict[str, str]:
        """The columns of single numbers."""
        return {
            name: kinds[0] for name, kinds in self.columns.items() if len(kinds) == 1
        }

    @property
    def lists(self) -> int:
        """How many columns are lists."""
        return len(self.columns) - len(self.kinds)

    @property
    def least_bytes(self) -> int:
        """Bytes that it takes in a binary file; the least, with empty lists, if it has
        lists.
        """
        return self.count * sum(int(kinds[0][1:]) for kinds in self.columns.values())


@dataclass(frozen=True, slots=True)
class Header:
    """What a PLY file says about itself: byte order ("" for text), tables in file
    order, size in bytes, comments.
    """

    order: str
    elements: dict[str, Element]
    size: int
    comments: list[str]

    @property
    def is_compressed(self) -> bool:
        """Whether its vertices are those of a compressed PLY."""
        return (
            "vertex" in self.elements
            and "packed_position" in self.elements["vertex"].columns
        )

    @property
    def is_antialiased(self) -> bool:
        """Whether the comments say that a splat was trained with antialiasing; the last
        one counts.
        """
        modes = [
            match
            for comment in self.comments
            if (match := _MODE.fullmatch(comment.strip()))
        ]
        return bool(modes) and (
            (modes[-1][1] or "").lower() == "mip" or modes[-1][2] == "1"
        )


def _error(
    path: str, expected: str, got: object, do: str = "export the splat again"
) -> SplatFileError:
    return SplatFileError.of(path, expected, got, do)


def read_header(file: io.FileIO, path: str) -> Header:
    """Read the header at the start of `file`."""
    start = os.pread(file.fileno(), _HEADER_LIMIT, 0)
    magic = re.match(rb"ply[ \t]*(\r\n|\n|\r)", start)
    if magic is None:
        raise _error(
            path,
            "a PLY file (first line 'ply')",
            f"a file that starts with {start[:8]!r}",
            "pass a splat",
        )
    newline = re.escape(magic[1])
    end = re.search(newline + rb"end_header[ \t\r]*" + newline, start)
    if end is None:
        do = "write or download it again, if it is truncated"
        raise _error(
            path,
            "a PLY header that ends with end_header",
            f"none in {len(start)} bytes",
            do,
        )
    header = Header("none", {}, end.end(), [])
    columns = dict[str, tuple[str, ...]]()
    for line in start[magic.end() : end.start()].split(magic[1]):
        words = line.split()
        name = _text(words[-1] if words[:1] == [b"property"] else b"".join(words[1:2]))
        match words:
            case [] | [b"obj_info", *_]:
                pass
            case [b"comment", *text]:
                header.comments.append(b" ".join(text).decode("utf-8", "replace"))
            case [b"format", encoding, b"1.0"] if (
                encoding in _ORDERS and header.order == "none"
            ):
                header = dataclasses.replace(header, order=_ORDERS[encoding])
            case [b"element", _, count] if (
                re.fullmatch(rb"\d{1,18}", count) and name not in header.elements
            ):
                columns = {}
                header.elements[name] = Element(int(count), columns)
            case [b"property", kind, _] if (
                header.elements and kind in _KINDS and name not in columns
            ):
                columns[name] = (_KINDS[kind],)
            case [b"property", b"list", length, kind, _] if (
                header.elements
                and _KINDS.get(length, "f")[0] != "f"
                and kind in _KINDS
                and name not in columns
            ):
                columns[name] = (_KINDS[length], _KINDS[kind])
            case _:
                expected = (
                    "one format, elements with a count, and properties, each with its"
                    " own name, as in PLY 1.0"
                )
                raise _error(
                    path,
                    expected,
                    repr(_text(line.strip()[:80])),
                    "repair the header or export it again",
                )
    if (
        header.order == "none"
        or not header.elements
        or not all(e.columns for e in header.elements.values())
    ):
        raise _error(
            path, "a line 'format' in the header, and elements with properties", "none"
        )
    return header


def _text(word: bytes) -> str:
    return word.decode("ascii", "backslashreplace")


def read_rows(file: io.FileIO, header: Header, name: str, path: str) -> Rows:
    """All rows of an element; of one with lists only the single numbers, and of text
    integers as float64.
    """
    size = os.fstat(file.fileno()).st_size
    number = list(header.elements).index(name)
    elements = list(header.elements.values())
    before = elements[:number]
    element = elements[number]
    later = elements[number + 1 :]
    if not header.order or any(element.lists for element in elements[: number + 1]):
        return _read_with_plyfile(file, header, name, size, path)
    end = header.size + sum(element.least_bytes for element in elements)
    if end > size or (end < size and not any(element.lists for element in later)):
        raise _mismatch(header, f"{end} bytes", f"{size} bytes", path)
    file.seek(header.size + sum(element.least_bytes for element in before))
    record = np.dtype(
        [(column, header.order + kind) for column, kind in element.kinds.items()]
    )
    rows = np.fromfile(file, record, element.count)
    if len(rows) < element.count:
        raise _error(
            path,
            f"{element.count} rows of {name}",
            f"{len(rows)}: the file shrank",
            "try again",
        )
    return rows


def _mismatch(header: Header, expected: str, got: str, path: str) -> SplatFileError:
    counts = ", ".join(
        f"{element.count} x {name}" for name, element in header.elements.items()
    )
    do = (
        "it is truncated, something was appended, or a count is wrong: write or"
        " download it again"
    )
    return _error(path, f"{expected} for {counts}", got, do)


def _read_with_plyfile(
    file: io.FileIO, header: Header, name: str, size: int, path: str
) -> Rows:
    """The rows of an element where it, or one before it, is text or has lists; plyfile
    gets a checked header.
    """
    is_text = not header.order
    what = "rows with lists" if header.order else "text"
    needed = dict(
        list(header.elements.items())[: list(header.elements).index(name) + 1]
    )
    least = (
        sum(
            2 * e.count * len(e.columns) if is_text else e.least_bytes
            for e in needed.values()
        )
        - is_text
    )
    if (
        header.size + least > size
        or sum(e.count * e.lists for e in needed.values()) > _MOST_LISTS
    ):
        raise _mismatch(
            header,
            f"at least {header.size + least} bytes of {what}",
            f"{size} bytes",
            path,
        )
    if size > _MOST_TEXT:
        raise _error(
            path,
            f"at most {_MOST_TEXT:,} bytes of {what}",
            f"{size:,}",
            "export it as binary",
        )
    try:
        import plyfile
    except ImportError as error:
        do = "pip install plyfile, or export the file as binary without lists"
        raise _error(
            path, f"the package plyfile, to read {what}", "none", do
        ) from error
    file.seek(header.size)
    data = file.read()
    if is_text:
        data = re.sub(rb"[\r\n]\s*", b"\n", data.strip()) + b"\n"
        lines = data.count(b"\n") * (len(data) > 1)
        rows = sum(e.count for e in header.elements.values())
        if lines != rows:
            raise _mismatch(header, f"{rows} lines", f"{lines}", path)
        if max(map(len, data.split(b"\n"))) > _LONGEST_LINE:
            raise _error(
                path,
                f"lines of at most {_LONGEST_LINE} bytes",
                "a longer one",
                "export it as binary",
            )
    stream = io.BytesIO(header_bytes(needed, header.order) + data)
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            # NumPy's, about lists without values
            warnings.simplefilter("ignore", UserWarning)
            table: Rows = plyfile.PlyData.read(stream, mmap=False)[name].data
    except (plyfile.PlyParseError, ValueError, OverflowError) as error:
        raise _error(
            path, f"intact {what} of {name}", " ".join(str(error).split())[:100]
        ) from error
    if not is_text and len(needed) == len(header.elements) and stream.read(1):
        raise _mismatch(header, "the end of the file", "more", path)
    return repack_fields(table[list(needed[name].kinds)])  # lists of a row are objects


def header_bytes(
    elements: Mapping[str, Element], order: str = "<", *, antialiased: bool = False
) -> bytes:
    """The header of a file; of text, integers are doubles, since some programs write
    255.0 for one.
    """
    lines = [
        b"ply",
        b"format %s 1.0"
        % next(name for name, letter in _ORDERS.items() if letter == order),
    ]
    lines += [b"comment SplatRenderMode: mip"] if antialiased else []
    for name, element in elements.items():
        lines.append(f"element {name} {element.count}".encode())
        for column, (*length, kind) in element.columns.items():
            kinds = [*length, kind if order or kind[0] == "f" else "f8"]
            words = [
                b"property",
                *([b"list"] if length else []),
                *(_PLY_NAMES[kind].split()[1] for kind in kinds),
            ]
            lines.append(b" ".join([*words, column.encode()]))
    return b"\n".join([*lines, b"end_header", b""])


# Splats


_MEANS = ["x", "y", "z"]
_NORMALS = ["nx", "ny", "nz"]
_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_ROTATIONS = ["rot_0", "rot_1", "rot_2", "rot_3"]
_RGB = ["red", "green", "blue"]
_FILTER = "filter_3D"
REST_COUNTS = (0, 9, 24, 45)
"""Number of f_rest_* properties for SH degree 0 to 3: all of red, then green, then
blue.
"""
_REST_OF_DEGREE_4 = 72
_FLATNESS = 1e-3
"""Third scale of a flat Gaussian, as a share of the smaller of its other two."""
_POINT = 1e-9
"""Scale of a Gaussian that has none at all, world units: what is seen of it is the
rasteriser's low-pass filter.
"""
_OF_SPLATS = ("f_dc_", "f_rest_", "scale_", "rot_", "opacity")
_PREFIX = re.compile(
    r"^scal(ar)?_(?=n[xyz]$|f_dc_|f_rest_|scale_|rot_|opacity$|filter_3D$)"
)
_TIME = re.compile(r"t|scale_t|rot_r_\d|trbf_\w+|motion_\d+|omega_\d+|velocity_\d+")
"""Columns of splats that move: 4D Gaussian Splatting (Yang et al. 2024), Spacetime
Gaussians (Li et al. 2024).
"""
_MODE = re.compile(
    r"splatrendermode:\s*(\w+)|(?:postshot\.)?(?:antialiased|anti_aliasing)[ =]+(\d)",
    re.IGNORECASE,
)


def rest_names(count: int) -> list[str]:
    """Names of the SH properties after the first coefficients."""
    return [f"f_rest_{i}" for i in range(count)]


def read_ply(file: io.FileIO, path: str) -> Loaded:
    """Read a splat in any encoding, any kinds of numbers and any order of
    properties.
    """
    header = read_header(file, path)
    stored = header.elements.get("vertex")
    if stored is None:
        raise _error(
            path, "an element named vertex", ", ".join(header.elements), "pass a splat"
        )
    vertex = _usual_names(stored)
    scale_names, colour_names, rest = _check_properties(vertex, header, path)
    rows = read_rows(file, header, "vertex", path)
    kinds = vertex.kinds
    rows.dtype.names = tuple(kinds)
    logits = _columns(rows, ["opacity"])[:, 0]
    logs = _columns(rows, scale_names)
    if len(scale_names) == 2:
        logs = np.concatenate(
            [logs, logs.min(axis=1, keepdims=True) + math.log(_FLATNESS)], axis=1
        )
    infinite = np.isinf(logits) | np.isneginf(logs).any(axis=1)
    logs = _without_minus_infinity(logs)
    scales, opacities = _activated(logs, logits)
    if _FILTER in kinds:  # the 3D smoothing filter, Yu et al. 2024, eq. 9
        wider = np.sqrt(scales**2 + rows[_FILTER].astype(np.float64)[:, None] ** 2)
        opacities = opacities * (scales / wider).prod(axis=1)
        scales = wider
    colours = _columns(rows, colour_names)
    if colour_names == _RGB:
        full = [
            1.0 if kinds[name][0] == "f" else np.iinfo(kinds[name]).max for name in _RGB
        ]
        colours = colour_to_dc(colours / np.array(full, np.float64))
    kept = min(rest, REST_COUNTS[-1]) // 3
    sh = np.empty((len(rows), 1 + kept, 3), np.float32)
    sh[:, 0] = colours
    used = [
        name
        for channel in range(3)
        for name in rest_names(rest)[channel * rest // 3 :][:kept]
    ]
    sh[:, 1:] = _columns(rows, used).reshape(len(rows), 3, kept).transpose(0, 2, 1)
    loaded = validated(
        _columns(rows, _MEANS), scales, unit(_columns(rows, _ROTATIONS)), opacities, sh
    )
    notices = [HIGHER_BANDS] if rest == _REST_OF_DEGREE_4 else []
    notices += _moving(vertex)
    if len(scale_names) == 2:
        notices.append(
            (
                "three scales",
                "two (a 2DGS splat)",
                "its flat Gaussians are drawn as very thin ellipsoids",
            )
        )
    read = {
        *_MEANS,
        *_NORMALS,
        *scale_names,
        *_ROTATIONS,
        "opacity",
        *colour_names,
        *rest_names(rest),
        _FILTER,
    }
    unread = [name for name in vertex.columns if name not in read]
    unread += [f"element {name}" for name in header.elements if name != "vertex"]
    mode = _FILTER in kinds or header.is_antialiased
    return dataclasses.replace(
        loaded,
        is_antialiased=mode,
        infinite=tuple(np.setdiff1d(np.flatnonzero(infinite), loaded.invalid).tolist()),
        notices=tuple(notices),
        unread=tuple(unread),
        stated_up=commented_up(header.comments),
    )


def _usual_names(vertex: Element) -> Element:
    """The columns by the names of 3DGS, where CloudCompare and 3dgsconverter put
    `scalar_` and `scal_` before them.
    """
    usual = {name: _PREFIX.sub("", name) for name in vertex.columns}
    if len(set(usual.values())) < len(usual):  # the file has both names
        return vertex
    return Element(
        vertex.count, {usual[name]: kinds for name, kinds in vertex.columns.items()}
    )


def _moving(vertex: Element) -> list[Notice]:
    """A notice where the columns are those of a splat that moves."""
    times = [name for name in vertex.columns if _TIME.fullmatch(name)]
    if not times or times == ["t"]:  # which may be anything
        return []
    got = f"one that moves (4D: {', '.join(ranges(times))})"
    return [
        ("a splat of one moment", got, "the Gaussians of all times are drawn at once")
    ]


def _activated(
    logs: NDArray[np.floating], logits: NDArray[np.floating]
) -> list[NDArray[np.floating]]:
    """Scales and opacities as `mi_splat.io.parameters.activate` computes them: in
    float64, rounded once.

    An infinite logit is an opacity of 0 or 1, as SuperSplat and splat-transform read
    it.
    """
    opacities = 1 / (1 + np.exp(-logits.astype(np.float64)))
    return [np.exp(logs, dtype=np.float64), opacities]


def _without_minus_infinity(logs: NDArray[np.floating]) -> NDArray[np.floating]:
    """Logarithms of scales in which a scale of 0 is that of a flat Gaussian, or of a
    point.
    """
    empty = np.isneginf(logs)
    if not empty.any():
        return logs
    smallest = np.where(empty, np.inf, logs).min(axis=1, keepdims=True)
    flat = np.where(
        np.isposinf(smallest), math.log(_POINT), smallest + math.log(_FLATNESS)
    )
    return np.asarray(np.where(empty, flat, logs).astype(logs.dtype))


def _check_properties(
    vertex: Element, header: Header, path: str
) -> tuple[list[str], list[str], int]:
    """Names of the scales and of the colours, and the number of further SH
    properties.
    """
    kinds = vertex.kinds
    rest = sum(name.startswith("f_rest_") for name in vertex.columns)
    if any(name.startswith("f_anchor_feat") for name in vertex.columns):
        got = (
            "the anchors of a Scaffold-GS, of which a network makes Gaussians for each"
            " view"
        )
        raise _error(
            path,
            "the properties of a 3DGS splat",
            got,
            "train a plain 3DGS on the same images",
        )
    if rest not in (*REST_COUNTS, _REST_OF_DEGREE_4):
        raise _error(
            path, "0, 9, 24 or 45 properties f_rest_* (SH degree 0 to 3)", rest
        )
    scales = _SCALES if _SCALES[2] in kinds else _SCALES[:2]
    colours = _RGB if _DC[0] not in kinds and set(_RGB) <= kinds.keys() else _DC
    needed = [*_MEANS, *scales, *_ROTATIONS, "opacity", *colours, *rest_names(rest)]
    missing = [name for name in needed if name not in kinds]
    if missing:
        raise _no_splat(vertex, header, missing, path)
    for name in needed:
        if kinds[name][0] != "f" and name not in _RGB:
            raise _error(
                path, f"{name} as float or double", f"an integer ({kinds[name]})"
            )
    return scales, colours, rest


def _no_splat(
    vertex: Element, header: Header, missing: Sequence[str], path: str
) -> SplatFileError:
    """The error of a PLY without properties of a splat: it says what the file is, as
    far as its header tells.
    """
    more = f" and {len(missing) - SHOWN} more" if len(missing) > SHOWN else ""
    lacks = f"no {', '.join(missing[:SHOWN])}{more}"
    has_some = any(name.startswith(_OF_SPLATS) for name in vertex.columns)
    faces = header.elements.get("face")
    got = lacks
    do = "export the splat again"
    if faces is not None and faces.count and not has_some:
        got = f"a mesh of {faces.count:,} faces"
        do = (
            "save it as .glb, then `mi-splat capture MESH.glb` renders images to train"
            " a splat on"
        )
    elif not has_some:
        got = f"a point cloud ({lacks})"
        do = (
            "pass a splat; one is trained on images and their cameras with `mi-splat"
            " train SET`"
        )
    return _error(path, "the properties of a 3DGS splat", got, do)


def _columns(rows: Rows, names: Sequence[str]) -> NDArray[np.floating]:
    """(rows, names) values, without a copy if that can be."""
    if names:
        return np.asarray(structured_to_unstructured(rows[list(names)]))
    return np.empty((len(rows), 0), np.float32)


def write_ply(
    scene: GaussianScene, path: str | os.PathLike[str], *, antialiased: bool = False
) -> None:
    """Save a splat as 3DGS writes it: binary little-endian float32 with zero normals
    and the scene's SH degree.
    """
    values = _raw(scene)
    rest = (
        values["sh"][:, 1:]
        .transpose(0, 2, 1)
        .reshape(len(scene), 3 * (scene.sh.shape[1] - 1))
    )
    before = values["means"], np.zeros_like(values["means"]), values["sh"][:, 0], rest
    after = values["opacities"][:, None], values["scales"], values["rotations"]
    table = np.concatenate([*before, *after], axis=1, dtype="<f4")
    names = [
        *_MEANS,
        *_NORMALS,
        *_DC,
        *rest_names(rest.shape[1]),
        "opacity",
        *_SCALES,
        *_ROTATIONS,
    ]
    head = header_bytes(
        {"vertex": Element(len(scene), dict.fromkeys(names, ("f4",)))},
        antialiased=antialiased,
    )
    save_bytes(table.reshape(-1).view(np.uint8).data, path, head=head)


def through_ply(scene: GaussianScene) -> GaussianScene:
    """What `load_splat` reads from the PLY that `save_splat` writes of a scene: to the
    bit, without the file.
    """
    values = _raw(scene)
    physical = _activated(values["scales"], values["opacities"])
    loaded = validated(
        values["means"], physical[0], values["rotations"], physical[1], values["sh"]
    )
    return loaded.settle("a saved scene", "raise", stacklevel=2).scene


def _raw(scene: GaussianScene) -> dict[str, NDArray[np.float32]]:
    """The tensors of a scene as the file holds them."""
    # imports torch, which reading does without
    from mi_splat.io.parameters import to_raw_parameters

    return {
        name: value.numpy()
        for name, value in to_raw_parameters(as_scene(arrays_of(scene))).items()
    }
