"""PLY files: the header within bounds, and the rows of its elements.

Every size that a header claims is held against the bytes that are there before memory
is taken for it. NumPy reads binary rows; the package plyfile (GPL, optional) reads text
and rows with lists.
"""

from __future__ import annotations

import dataclasses
import io
import os
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray

from mi_splat.io.errors import SplatFileError

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
_MODE = re.compile(
    r"splatrendermode:\s*(\w+)|(?:postshot\.)?(?:antialiased|anti_aliasing)[ =]+(\d)",
    re.IGNORECASE,
)
"""Comments in which Brush and Postshot say whether a splat was trained with
antialiasing.
"""

REST_COUNTS = (0, 9, 24, 45)
"""Number of f_rest_* properties for SH degree 0 to 3: all of red, then green, then
blue.
"""


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


def ply_error(
    path: str, expected: str, got: object, do: str = "export the splat again"
) -> SplatFileError:
    """What is wrong with a PLY file."""
    return SplatFileError.of(path, expected, got, do)


def read_header(file: io.FileIO, path: str) -> Header:
    """Read the header at the start of `file`."""
    start = os.pread(file.fileno(), _HEADER_LIMIT, 0)
    magic = re.match(rb"ply[ \t]*(\r\n|\n|\r)", start)
    if magic is None:
        raise ply_error(
            path,
            "a PLY file (first line 'ply')",
            f"a file that starts with {start[:8]!r}",
            "pass a splat",
        )
    newline = re.escape(magic[1])
    end = re.search(newline + rb"end_header[ \t\r]*" + newline, start)
    if end is None:
        do = "write or download it again, if it is truncated"
        raise ply_error(
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
                raise ply_error(
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
        raise ply_error(
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
        raise ply_error(
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
    return ply_error(path, f"{expected} for {counts}", got, do)


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
        raise ply_error(
            path,
            f"at most {_MOST_TEXT:,} bytes of {what}",
            f"{size:,}",
            "export it as binary",
        )
    try:
        import plyfile
    except ImportError as error:
        do = "pip install plyfile, or export the file as binary without lists"
        raise ply_error(
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
            raise ply_error(
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
        raise ply_error(
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


def rest_names(count: int) -> list[str]:
    """Names of the SH properties after the first coefficients."""
    return [f"f_rest_{i}" for i in range(count)]
