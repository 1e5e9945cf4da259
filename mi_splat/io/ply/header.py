"""The header of a PLY file, read within fixed bounds and believed in nothing."""

import re
from dataclasses import dataclass
from typing import BinaryIO

from mi_splat.io.errors import SplatFileError

HEADER_LIMIT = 64 * 1024
"""Longest header in bytes; the ones that 3DGS writes have 1.5 KB."""

ORDERS = {b"ascii": "", b"binary_little_endian": "<", b"binary_big_endian": ">"}
"""Byte order in NumPy's letters of each encoding, empty for text."""

_KINDS = {
    **dict.fromkeys((b"char", b"int8"), "i1"),
    **dict.fromkeys((b"uchar", b"uint8"), "u1"),
    **dict.fromkeys((b"short", b"int16"), "i2"),
    **dict.fromkeys((b"ushort", b"uint16"), "u2"),
    **dict.fromkeys((b"int", b"int32"), "i4"),
    **dict.fromkeys((b"uint", b"uint32"), "u4"),
    **dict.fromkeys((b"float", b"float32"), "f4"),
    **dict.fromkeys((b"double", b"float64"), "f8"),
}


@dataclass(frozen=True, slots=True)
class Property:
    """One column of an element: NumPy kind of its values, and of its length if each value is a list."""

    name: str
    kind: str
    length_kind: str | None = None


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


@dataclass(frozen=True, slots=True)
class Header:
    """What a PLY file says about itself: byte order ("" for text), tables in file order, size in bytes."""

    order: str
    elements: tuple[Element, ...]
    size: int


def read_header(file: BinaryIO, path: str) -> Header:
    """Read the header at the start of `file`."""
    start = file.read(HEADER_LIMIT)
    if not start:
        raise SplatFileError.of(path, "a PLY file", "an empty file", "write or download it again")
    newline = _newline(start, path)
    end = re.search(re.escape(newline) + rb"end_header[ \t\r]*" + re.escape(newline), start)
    if end is None and len(start) == HEADER_LIMIT:
        got = f"no end_header in the first {HEADER_LIMIT} bytes"
        raise SplatFileError.of(path, "a PLY header", got, "check that this is a 3DGS splat file")
    if end is None:
        got, do = f"the end of the file after {len(start)} bytes", "the file is truncated: write or download it again"
        raise SplatFileError.of(path, "a PLY header that ends with end_header", got, do)
    lines = [line.split() for line in start[: end.start()].split(newline)[1:]]
    lines = [fields for fields in lines if fields and fields[0] not in (b"comment", b"obj_info")]
    return Header(_order(lines, path), _elements(lines[1:], path), end.end())


def _newline(start: bytes, path: str) -> bytes:
    """The file's own line ending, from its first line."""
    magic = re.match(rb"ply[ \t]*(\r\n|\n|\r)", start)
    if magic is None:
        got = f"a file that starts with {start[:8]!r}"
        raise SplatFileError.of(path, "a PLY file (first line 'ply')", got, "pass a 3DGS splat as .ply")
    return magic[1]


def _order(lines: list[list[bytes]], path: str) -> str:
    """Byte order from the format line, the first line that is no comment."""
    fields = lines[0] if lines else []
    if len(fields) != 3 or fields[0] != b"format" or fields[1] not in ORDERS or fields[2] != b"1.0":
        expected = "'format' with ascii, binary_little_endian or binary_big_endian and version 1.0"
        raise SplatFileError.of(path, expected, _show(fields), "export the splat again as PLY 1.0")
    return ORDERS[fields[1]]


def _elements(lines: list[list[bytes]], path: str) -> tuple[Element, ...]:
    """The tables that the header declares."""
    elements: list[Element] = []
    for fields in lines:
        if fields[0] == b"element":
            elements.append(_element(fields, path))
        elif fields[0] == b"property" and elements:
            last = elements[-1]
            elements[-1] = Element(last.name, last.count, (*last.properties, _property(fields, path)))
        else:
            expected = "'element' and then 'property' lines"
            raise SplatFileError.of(path, expected, _show(fields), "repair the header or export the splat again")
    for names, what in (
        ([element.name for element in elements], "elements"),
        *(([column.name for column in element.properties], f"properties of {element.name}") for element in elements),
    ):
        if not names:
            raise SplatFileError.of(path, f"{what} in the header", "none", "export the splat again")
        doubled = sorted({name for name in names if names.count(name) > 1}) if len(set(names)) < len(names) else []
        if doubled:
            raise SplatFileError.of(path, f"{what} with different names", f"{doubled[0]} twice", "remove one")
    return tuple(elements)


def _element(fields: list[bytes], path: str) -> Element:
    """A table from its line: element NAME COUNT."""
    if len(fields) != 3 or not re.fullmatch(rb"\d{1,18}", fields[2]):
        expected = "'element NAME COUNT' with a count of rows that is not negative"
        raise SplatFileError.of(path, expected, _show(fields), "repair the header or export the splat again")
    return Element(_name(fields[1], path), int(fields[2]), ())


def _property(fields: list[bytes], path: str) -> Property:
    """A column from its line: property KIND NAME or property list KIND KIND NAME."""
    if len(fields) == 3 and fields[1] in _KINDS:
        return Property(_name(fields[2], path), _KINDS[fields[1]])
    if len(fields) == 5 and fields[1] == b"list" and fields[2] in _KINDS and fields[3] in _KINDS:
        if _KINDS[fields[2]][0] == "f":
            raise SplatFileError.of(path, "an integer list length", _show(fields), "export the splat again")
        return Property(_name(fields[4], path), _KINDS[fields[3]], _KINDS[fields[2]])
    expected = "'property KIND NAME' or 'property list KIND KIND NAME' with PLY's number kinds"
    raise SplatFileError.of(path, expected, _show(fields), "repair the header or export the splat again")


def _name(word: bytes, path: str) -> str:
    """A name as text."""
    if not word.isascii():
        raise SplatFileError.of(path, "names in ASCII", repr(word[:40]), "rename it or export the splat again")
    return word.decode("ascii")


def _show(fields: list[bytes]) -> str:
    """A header line for a message, shortened."""
    return repr(b" ".join(fields)[:80].decode("ascii", "backslashreplace")) if fields else "no such line"
