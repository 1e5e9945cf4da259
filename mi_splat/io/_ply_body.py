"""The rows of one element of a PLY file, as structured NumPy arrays of bounded size.

Every size that the header claims is held against the bytes that are there before anything is allocated.
"""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_splat.errors import message
from mi_splat.io._ply_header import Element, Header
from mi_splat.io.errors import SplatFileError

Rows = NDArray[np.void]

CHUNK_BYTES = 1 << 20
LINE_LIMIT = 1 << 20
"""Longest line of a text file in bytes."""

_STRUCT = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}


def chunks(file: io.FileIO, header: Header, name: str, path: str) -> Iterator[Rows]:
    """The rows of the element `name`, which has no list properties, a bounded number at a time.

    Args:
        file: The file, open for unbuffered reading.
        header: Its header.
        name: An element of the header.
        path: For messages.

    Yields:
        Structured arrays with the element's properties in file order; the memory is used again for the next one.

    Raises:
        SplatFileError: The file is larger or smaller than its header says, or text does not parse.
    """
    reader = _binary_chunks if header.order else _text_chunks
    return reader(file, header, name, path)


def _binary_chunks(file: io.FileIO, header: Header, name: str, path: str) -> Iterator[Rows]:
    element = next(element for element in header.elements if element.name == name)
    file.seek(_offset(file, header, name, path))
    dtype = np.dtype([(column.name, header.order + column.kind) for column in element.properties])
    at_once = max(1, CHUNK_BYTES // dtype.itemsize)
    buffer = np.empty(min(at_once, element.count), dtype)
    for first in range(0, element.count, at_once):
        rows = buffer[: min(at_once, element.count - first)]
        _fill(file, memoryview(rows.view(np.uint8)), path)
        yield rows


def _fill(file: io.FileIO, view: memoryview, path: str) -> None:
    """Read until `view` is full."""
    while view:
        got = file.readinto(view)
        if not got:
            raise SplatFileError(
                message(path, f"{len(view)} more bytes", "the end of the file", "it shrank: try again")
            )
        view = view[got:]


def _offset(file: io.FileIO, header: Header, name: str, path: str) -> int:
    """Where the element `name` begins, after the size of every element has been checked against the file's."""
    size = os.fstat(file.fileno()).st_size
    position, begin = header.size, 0
    for element in header.elements:
        if element.name == name:
            begin = position
        if element.has_lists:
            position = _walk(file, element, header.order, position, size, path)
        else:
            position += element.count * sum(int(column.kind[1:]) for column in element.properties)
        if position > size:
            _mismatch(path, header, f"at least {position} bytes", f"{size} bytes", "it is truncated")
    if position != size:
        _mismatch(path, header, f"{position} bytes", f"{size} bytes", "something was appended, or the count is wrong")
    return begin


def _walk(file: io.FileIO, element: Element, order: str, position: int, size: int, path: str) -> int:
    """Where an element with lists ends: its rows have to be visited one by one."""
    if element.count > size - position:
        _mismatch(path, element, f"at least {element.count} bytes of rows", f"{size - position}", "it is truncated")
    file.seek(position)
    reader = io.BufferedReader(file)
    try:
        for row in range(element.count):
            for column in element.properties:
                step = int(column.kind[1:])
                if column.length_kind:
                    field = reader.read(int(column.length_kind[1:]))
                    position += len(field)
                    if len(field) < int(column.length_kind[1:]):
                        _mismatch(path, element, f"row {row}", "the end of the file", "it is truncated")
                    (length,) = struct.unpack(order + _STRUCT[column.length_kind], field)
                    if length < 0:
                        _mismatch(path, element, "list lengths >= 0", f"{length} in row {row}", "it is damaged")
                    step *= length
                position += step
                if position > size:
                    _mismatch(path, element, f"row {row}", "the end of the file", "it is truncated")
                reader.seek(step, os.SEEK_CUR)
    finally:
        reader.detach()
    return position


def _text_chunks(file: io.FileIO, header: Header, name: str, path: str) -> Iterator[Rows]:
    size = os.fstat(file.fileno()).st_size - header.size
    least = sum(element.count * 2 * len(element.properties) for element in header.elements) - 1
    if least > size:
        _mismatch(path, header, f"at least {least} bytes of text", f"{size} bytes", "it is truncated")
    file.seek(header.size)
    reader = io.BufferedReader(file)
    try:
        lines = _lines(reader, path)
        for element in header.elements:
            if element.name == name:
                yield from _parse(lines, element, path)
            else:
                skipped = sum(1 for _ in islice(lines, element.count))
                _check_rows(skipped, element, path)
        if next(lines, None) is not None:
            _mismatch(
                path, header, "the end of the file", "more lines", "something was appended, or the count is wrong"
            )
    finally:
        reader.detach()


def _lines(reader: io.BufferedReader, path: str) -> Iterator[bytes]:
    """Lines that are not blank."""
    while line := reader.readline(LINE_LIMIT):
        if len(line) == LINE_LIMIT:
            raise SplatFileError(
                message(path, f"lines under {LINE_LIMIT} bytes", "a longer one", "export the splat as binary PLY")
            )
        if not line.isspace():
            yield line


def _parse(lines: Iterator[bytes], element: Element, path: str) -> Iterator[Rows]:
    """Rows of numbers from lines of text, as float64 whatever the header says."""
    columns = len(element.properties)
    dtype = np.dtype([(column.name, "f8") for column in element.properties])
    at_once = max(1, CHUNK_BYTES // dtype.itemsize)
    for first in range(0, element.count, at_once):
        wanted = min(at_once, element.count - first)
        tokens = [line.split() for line in islice(lines, wanted)]
        _check_rows(first + len(tokens), element, path, first + wanted)
        for row, words in enumerate(tokens):
            if len(words) != columns:
                expected = f"{columns} numbers in row {first + row} of {element.name}"
                raise SplatFileError(message(path, expected, len(words), "export the splat again"))
        yield _numbers(tokens, first, path).view(dtype).reshape(-1)


def _numbers(tokens: list[list[bytes]], first: int, path: str) -> NDArray[np.float64]:
    """(rows, columns) values of split lines."""
    table = np.empty((len(tokens), len(tokens[0])))
    for row, words in enumerate(tokens):
        try:
            table[row] = [float(word) for word in words]
        except ValueError as error:
            expected = f"numbers in row {first + row}"
            raise SplatFileError(message(path, expected, str(error)[:80], "export the splat again")) from error
    return table


def _check_rows(found: int, element: Element, path: str, wanted: int | None = None) -> None:
    """Raise if the text ended before the rows did."""
    if found < (element.count if wanted is None else wanted):
        expected = f"{element.count} rows of {element.name}"
        raise SplatFileError(message(path, expected, f"{found}", "it is truncated: write or download it again"))


def _mismatch(path: str, where: Header | Element, expected: str, found: str, why: str) -> Any:
    """Raise for a file whose size is not what its header says."""
    elements = where.elements if isinstance(where, Header) else (where,)
    counts = ", ".join(f"{element.count} x {element.name}" for element in elements)
    raise SplatFileError(message(path, f"{expected} for {counts}", found, f"{why}: write or download it again"))
