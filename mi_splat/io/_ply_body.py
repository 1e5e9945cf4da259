"""The rows of one element of a PLY file, as structured NumPy arrays of bounded size.

Every size that the header claims is held against the bytes that are there before anything is allocated.
"""

from __future__ import annotations

import io
import os
import struct
import threading
from collections.abc import Callable, Iterator
from itertools import islice
from typing import NoReturn

import numpy as np

from mi_splat.errors import message
from mi_splat.io._blocks import BLOCK_BYTES, Rows, for_each_block
from mi_splat.io._ply_header import Element, Header
from mi_splat.io.errors import SplatFileError

LINE_LIMIT = 1 << 20
"""Longest line of a text file in bytes."""

_STRUCT = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I"}
_AGAIN = "write or download it again"


def locate(file: io.FileIO, header: Header, name: str, path: str) -> int:
    """Where the rows of the element `name` begin, after the sizes of all elements were held against the file's.

    Text has no fixed size: there, only the least that the rows need is checked, and the rest by `read_rows`.

    Raises:
        SplatFileError: The file is larger or smaller than its header says.
    """
    size = os.fstat(file.fileno()).st_size
    if not header.order:
        least = header.size - 1 + sum(element.count * 2 * len(element.properties) for element in header.elements)
        if least > size:
            _mismatch(path, header, f"at least {least} bytes of text", f"{size} bytes", "it is truncated")
        return header.size
    position, begin = header.size, 0
    for element in header.elements:
        if element.name == name:
            begin = position
        if element.has_lists and position <= size:
            position = _walk(file, element, header.order, position, size, path)
        else:
            position += element.count * sum(int(column.kind[1:]) for column in element.properties)
    if position > size:
        _mismatch(path, header, f"{position} bytes", f"{size} bytes", "it is truncated")
    if position < size:
        _mismatch(path, header, f"{position} bytes", f"{size} bytes", "something was appended, or the count is wrong")
    return begin


def read_rows(file: io.FileIO, header: Header, element: Element, path: str, work: Callable[[int, Rows], None]) -> None:
    """Call `work(first, rows)` for blocks of rows of an element without lists.

    Args:
        file: The file, open for unbuffered reading.
        header: Its header.
        element: One of its elements.
        path: For messages.
        work: Gets the index of the first row and a structured array with the element's properties in file order, in the
            file's kinds and byte order (text: the machine's, and float64 for integers); the array is used again.
            Blocks come in any order, and from several threads.

    Raises:
        SplatFileError: The file is larger or smaller than its header says, or text does not parse.
    """
    offset = locate(file, header, element.name, path)
    if not header.order:
        _read_text(file, header, element, path, work)
        return
    record = np.dtype([(column.name, header.order + column.kind) for column in element.properties])
    lock = threading.Lock()

    def load(first: int, rows: Rows) -> None:
        with lock:
            file.seek(offset + first * record.itemsize)
            _fill(file, rows.view(np.uint8).data, path)
        work(first, rows)

    for_each_block(element.count, record, load)


def _fill(file: io.FileIO, view: memoryview, path: str) -> None:
    """Read until `view` is full."""
    while view:
        got = file.readinto(view)
        if not got:
            raise SplatFileError(
                message(path, f"{len(view)} more bytes", "the end of the file", "it shrank: try again")
            )
        view = view[got:]


def _walk(file: io.FileIO, element: Element, order: str, position: int, size: int, path: str) -> int:
    """Where an element with lists ends: its rows have to be visited one by one."""
    if element.count > size - position:
        _mismatch(path, element, f"at least {element.count} bytes", f"{size - position} bytes", "it is truncated")
    steps = [(column.length_kind, int(column.kind[1:])) for column in element.properties]
    with _buffered(file, position) as reader:
        for row in range(element.count):
            for length_kind, step in steps:
                if length_kind:
                    field = reader.read(int(length_kind[1:]))
                    position += len(field)
                    step *= _length(field, order, length_kind, row, element, path)
                position += step
                reader.seek(position)
            if position > size:
                _mismatch(path, element, "all its rows", f"the end of the file in row {row}", "it is truncated")
    return position


def _length(field: bytes, order: str, kind: str, row: int, element: Element, path: str) -> int:
    """The length of one list from its bytes."""
    if len(field) < int(kind[1:]):
        _mismatch(path, element, "all its rows", f"the end of the file in row {row}", "it is truncated")
    length = int(struct.unpack(order + _STRUCT[kind], field)[0])
    if length < 0:
        _mismatch(path, element, "list lengths >= 0", f"{length} in row {row}", "it is damaged")
    return length


def _buffered(file: io.FileIO, position: int) -> io.BufferedReader:
    """A buffered reader of `file` at `position`; closing it leaves `file` open, with its position moved."""
    reader = os.fdopen(os.dup(file.fileno()), "rb")
    reader.seek(position)
    return reader


def _read_text(file: io.FileIO, header: Header, wanted: Element, path: str, work: Callable[[int, Rows], None]) -> None:
    """`read_rows` for text."""
    with _buffered(file, header.size) as reader:
        lines = _lines(reader, path)
        for element in header.elements:
            if element is wanted:
                _parse(lines, element, path, work)
            else:
                _check_rows(sum(1 for _ in islice(lines, element.count)), element.count, element, path)
        if next(lines, None) is not None:
            _mismatch(
                path, header, "the end of the file", "more lines", "something was appended, or the count is wrong"
            )


def _lines(reader: io.BufferedReader, path: str) -> Iterator[bytes]:
    """Lines that are not blank."""
    while line := reader.readline(LINE_LIMIT):
        if len(line) == LINE_LIMIT:
            raise SplatFileError(
                message(path, f"lines under {LINE_LIMIT} bytes", "a longer one", "export it as binary")
            )
        if not line.isspace():
            yield line


def _parse(lines: Iterator[bytes], element: Element, path: str, work: Callable[[int, Rows], None]) -> None:
    """Rows of numbers from lines of text."""
    record = np.dtype([(column.name, column.kind if column.kind[0] == "f" else "f8") for column in element.properties])
    at_once = max(1, BLOCK_BYTES // record.itemsize)
    for first in range(0, element.count, at_once):
        block = [line.split() for line in islice(lines, min(at_once, element.count - first))]
        _check_rows(first + len(block), min(first + at_once, element.count), element, path)
        rows = np.empty(len(block), record)
        with np.errstate(over="ignore"):
            for row, words in enumerate(block):
                rows[row] = _numbers(words, first + row, element, path)
        work(first, rows)


def _numbers(words: list[bytes], row: int, element: Element, path: str) -> tuple[float, ...]:
    """One line of text as numbers."""
    if len(words) != len(element.properties):
        expected = f"{len(element.properties)} numbers in row {row} of {element.name}"
        raise SplatFileError(message(path, expected, len(words), "export the splat again"))
    try:
        return tuple(float(word) for word in words)
    except ValueError as error:
        expected = f"numbers in row {row} of {element.name}"
        raise SplatFileError(message(path, expected, str(error)[:80], "export the splat again")) from error


def _check_rows(found: int, wanted: int, element: Element, path: str) -> None:
    """Raise if the text ended before the rows did."""
    if found < wanted:
        expected = f"{element.count} rows of {element.name}"
        raise SplatFileError(message(path, expected, found, f"it is truncated: {_AGAIN}"))


def _mismatch(path: str, where: Header | Element, expected: str, found: str, why: str) -> NoReturn:
    """Raise for a file whose size is not what its header says."""
    elements = where.elements if isinstance(where, Header) else (where,)
    counts = ", ".join(f"{element.count} x {element.name}" for element in elements)
    raise SplatFileError(message(path, f"{expected} for {counts}", found, f"{why}: {_AGAIN}"))
