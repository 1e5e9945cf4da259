"""What NumPy cannot take in one piece, text and rows with lists, read by the package plyfile.

plyfile believes a header: it reserves memory for all the rows that one claims, and takes negative list lengths for an
end of the file. So it never sees a user's file. `_ply_body` holds sizes and list lengths against the bytes that are
there; then plyfile gets a block of rows at a time, under a header of our own.
"""

import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from types import ModuleType

import numpy as np

from mi_splat.io.errors import SplatFileError
from mi_splat.io.ply.blocks import BLOCK_BYTES, Rows
from mi_splat.io.ply.header import ORDERS, Element, Property

LINE_LIMIT = 1 << 20
"""Longest line of a text file in bytes."""

_NAMES = {"i": "int", "u": "uint", "f": "float"}


def require_plyfile(path: str, needed_for: str) -> ModuleType:
    """The package plyfile."""
    try:
        import plyfile
    except ImportError as error:
        do = "pip install plyfile, or export the file as binary without lists"
        raise SplatFileError.of(path, f"the package plyfile, to read {needed_for}", "none", do) from error
    module: ModuleType = plyfile
    return module


def scalar_record(element: Element, order: str) -> np.dtype[np.void]:
    """The properties of an element that are single numbers; in text, where order is "", integers are float64."""
    scalars = [column for column in element.properties if not column.length_kind]
    return np.dtype([(column.name, order + _kind_of_value(column, order)) for column in scalars])


def read_binary(data: bytes, count: int, element: Element, order: str, path: str) -> Rows:
    """Rows with lists."""
    return _parse(require_plyfile(path, f"rows of {element.name} with lists"), data, count, element, order)


def read_text(
    reader: io.BufferedReader,
    elements: Sequence[Element],
    wanted: Element,
    path: str,
    work: Callable[[int, Rows], None],
) -> None:
    """Call `work(first, rows)` for blocks of the rows of one element of a text file, in their order."""
    plyfile = require_plyfile(path, "text")
    lines = _lines(reader, path)
    for element in elements:
        done = 0
        if element is wanted:
            for block in _blocks(lines, element):
                _check_ascii(block, done, element, path)
                try:
                    rows = _parse(plyfile, b"".join(block), len(block), element, "")
                except plyfile.PlyElementParseError as error:
                    _refuse(block[error.row], done + error.row, element, error.message, path)
                except OverflowError as error:  # of which plyfile does not say where it was
                    expected = f"list lengths in rows {done} to {done + len(block) - 1} of {element.name}"
                    raise SplatFileError.of(path, expected, str(error), "export the file again") from error
                work(done, rows)
                done += len(block)
        else:
            done = sum(1 for _ in islice(lines, element.count))
        if done < element.count:
            expected = f"{element.count} rows of {element.name}"
            raise SplatFileError.of(path, expected, done, "it is truncated: write or download it again")
    if next(lines, None) is not None:
        expected = f"the end of the file after {', '.join(f'{e.count} x {e.name}' for e in elements)}"
        do = "something was appended, or the count is wrong: write or download it again"
        raise SplatFileError.of(path, expected, "more lines", do)


def _lines(reader: io.BufferedReader, path: str) -> Iterator[bytes]:
    """Lines that are not blank."""
    while line := reader.readline(LINE_LIMIT):
        if len(line) == LINE_LIMIT:
            raise SplatFileError.of(path, f"lines under {LINE_LIMIT} bytes", "a longer one", "export it as binary")
        if not line.isspace():
            yield line


def _blocks(lines: Iterator[bytes], element: Element) -> Iterator[list[bytes]]:
    """The lines of an element in pieces that take about `BLOCK_BYTES`, as text and as numbers."""
    row_bytes = 8 * len(element.properties)
    block, size = list[bytes](), 0
    for line in islice(lines, element.count):
        block.append(b" ".join(line.split()) + b"\n")  # else a carriage return within a line would begin another
        size += max(len(line), row_bytes)
        if size >= BLOCK_BYTES:
            yield block
            block, size = [], 0
    if block:
        yield block


def _check_ascii(block: Sequence[bytes], first: int, element: Element, path: str) -> None:
    """Raise for the first line that holds other bytes; plyfile would not say which it is."""
    for row, line in enumerate(block):
        if not line.isascii():
            _refuse(line, first + row, element, "other bytes than ASCII", path)


def _refuse(line: bytes, row: int, element: Element, why: str, path: str) -> None:
    """Raise for a line of text that does not parse."""
    fields, expected = line.split(), f"numbers in row {row} of {element.name}"
    if not element.has_lists and len(fields) != len(element.properties):
        expected, got = f"{len(element.properties)} {expected}", str(len(fields))
    else:
        got = f"{line[:60].decode('ascii', 'backslashreplace').strip()!r} ({why})"
    raise SplatFileError.of(path, expected, got, "export the file again")


def _parse(plyfile: ModuleType, data: bytes, count: int, element: Element, order: str) -> Rows:
    """`count` rows out of their bytes, as text if order is "", under a header that is made here."""
    encoding = next(name for name, letter in ORDERS.items() if letter == order).decode()
    head = ["ply", f"format {encoding} 1.0", f"element rows {count}"]
    head += [_declaration(column, order) for column in element.properties]
    stream = io.BytesIO("\n".join([*head, "end_header", ""]).encode() + data)
    with np.errstate(over="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # NumPy's, about lists without values
        table = plyfile.PlyData.read(stream, mmap=False)["rows"].data
    rows = np.empty(count, scalar_record(element, order))
    for name in rows.dtype.names or ():
        rows[name] = table[name]
    return rows


def _kind_of_value(column: Property, order: str) -> str:
    """NumPy kind in which values are read; text says 255.0 for an integer, too."""
    return column.kind if order or column.kind[0] == "f" else "f8"


def _declaration(column: Property, order: str) -> str:
    """A column's line in the header."""
    kinds = [column.length_kind] if column.length_kind else []
    kinds_named = [f"{_NAMES[kind[0]]}{8 * int(kind[1:])}" for kind in (*kinds, _kind_of_value(column, order))]
    return " ".join(["property", *(["list"] if kinds else []), *kinds_named, column.name])
