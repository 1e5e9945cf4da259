"""The rows of one element of a PLY file, as structured NumPy arrays of bounded size.

Every size that the header claims is held against the bytes that are there before anything is allocated. NumPy reads
binary rows of one size, which is every splat that a trainer writes; text and rows with lists go on to `with_plyfile`.
"""

import io
import os
import struct
import threading
from collections.abc import Callable, Iterator
from typing import NoReturn

import numpy as np

from mi_splat.io.errors import SplatFileError
from mi_splat.io.ply.blocks import BLOCK_BYTES, Rows, for_each_block
from mi_splat.io.ply.header import Element, Header
from mi_splat.io.ply.with_plyfile import read_binary, read_text, scalar_record

_STRUCT = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I"}
_AGAIN = "write or download it again"


def locate(file: io.FileIO, header: Header, name: str, path: str) -> int:
    """Where the rows of the element `name` begin, after the sizes of all elements were held against the file's.

    Text has no fixed size: there, only the least that the rows need is checked, and the rest by `read_rows`.
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
            position = max(_row_ends(file, element, header.order, position, size, path), default=position)
        else:
            position += element.count * sum(int(column.kind[1:]) for column in element.properties)
    if position > size:
        _mismatch(path, header, f"{position} bytes", f"{size} bytes", "it is truncated")
    if position < size:
        _mismatch(path, header, f"{position} bytes", f"{size} bytes", "something was appended, or the count is wrong")
    return begin


def read_rows(file: io.FileIO, header: Header, element: Element, path: str, work: Callable[[int, Rows], None]) -> None:
    """Call `work(first, rows)` for blocks of rows of an element."""
    offset = locate(file, header, element.name, path)
    if not header.order:
        with _buffered(file, header.size) as reader:
            read_text(reader, header.elements, element, path, work)
        return
    if element.has_lists:
        _read_with_lists(file, header.order, element, offset, path, work)
        return
    record, lock = scalar_record(element, header.order), threading.Lock()

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
            _shrank(path, len(view))
        view = view[got:]


def _shrank(path: str, missing: int) -> NoReturn:
    """Raise for a file that ended although it was long enough at first."""
    raise SplatFileError.of(path, f"{missing} more bytes", "the end of the file", "it shrank: try again")


def _read_with_lists(
    file: io.FileIO, order: str, element: Element, offset: int, path: str, work: Callable[[int, Rows], None]
) -> None:
    """`read_rows` for an element with lists, whose rows begin at `offset`."""
    size = os.fstat(file.fileno()).st_size
    at_once = max(1, BLOCK_BYTES // max(1, scalar_record(element, order).itemsize))
    begin, first = offset, 0
    for done, end in enumerate(_row_ends(file, element, order, offset, size, path), start=1):
        if done - first < at_once and end - begin < BLOCK_BYTES and done < element.count:
            continue
        data = os.pread(file.fileno(), end - begin, begin)  # the descriptor's own position belongs to _row_ends
        if len(data) < end - begin:
            _shrank(path, end - begin - len(data))
        work(first, read_binary(data, done - first, element, order, path))
        begin, first = end, done


def _row_ends(file: io.FileIO, element: Element, order: str, position: int, size: int, path: str) -> Iterator[int]:
    """Where each row of an element with lists ends: rows have to be visited one by one."""
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
            yield position


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


def _mismatch(path: str, where: Header | Element, expected: str, got: str, why: str) -> NoReturn:
    """Raise for a file whose size is not what its header says."""
    elements = where.elements if isinstance(where, Header) else (where,)
    counts = ", ".join(f"{element.count} x {element.name}" for element in elements)
    raise SplatFileError.of(path, f"{expected} for {counts}", got, f"{why}: {_AGAIN}")
