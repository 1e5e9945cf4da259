"""Splats as PLY files, in the forms in which programs write them."""

import struct
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.gaussians import ply_header, splat_names, splat_rows

ROWS = splat_rows(40, 1)
LISTS = [list(range(i % 4)) for i in range(len(ROWS))]
HEAD = ply_header(ROWS)
BODY = ROWS.tobytes()
TEXT_HEAD = ply_header(ROWS, "ascii")
LINE = b" ".join([b"0.5"] * len(splat_names(1))) + b"\n"
FACE = b"element face 2\nproperty list char int indices\n"


def text(rows: Iterable[Any]) -> bytes:
    """Rows as lines of decimals that hold a float32 exactly."""
    return b"".join(
        b" ".join(b"%.9g" % float(value) for value in row) + b"\n" for row in rows
    )


def reordered(rows: NDArray[np.void], names: Sequence[str]) -> NDArray[np.void]:
    """Rows with their properties in another order, or with some of them."""
    other = np.zeros(len(rows), [(name, rows.dtype[name]) for name in names])
    for name in names:
        other[name] = rows[name]
    return other


def widened(
    rows: NDArray[np.void], names: Sequence[str], order: str = "<"
) -> NDArray[np.void]:
    """Rows in which some properties are doubles."""
    return rows.astype(
        [
            (name, f"{order}f{8 if name in names else 4}")
            for name in rows.dtype.names or ()
        ]
    )


def encoded(rows: NDArray[np.void], encoding: str) -> bytes:
    """A file of rows in one of PLY's encodings."""
    if encoding == "ascii":
        return ply_header(rows, encoding) + text(rows)
    record = rows.dtype.newbyteorder(">" if "big" in encoding else "<")
    return ply_header(rows, encoding) + rows.astype(record).tobytes()


def with_elements(
    after: bytes, data: bytes, before: bytes = b"", data_before: bytes = b""
) -> bytes:
    """The ordinary file with further elements around the vertices."""
    head = HEAD.replace(b"element vertex", before + b"element vertex").replace(
        b"end_header", after + b"end_header"
    )
    return head + data_before + BODY + data


def listed(encoding: str, rows: Any = ROWS, lists: Any = LISTS) -> bytes:
    """A splat whose vertices carry a list of shorts before their other properties."""
    head = ply_header(rows, encoding).replace(
        b"property", b"property list char short seen\nproperty", 1
    )
    data = b""
    order = ">" if "big" in encoding else "<"
    for row, values in zip(rows, lists, strict=True):
        if encoding == "ascii":
            data += (
                b" ".join(
                    b"%.9g" % number
                    for number in [len(values), *values, *map(float, row)]
                )
                + b"\n"
            )
        else:
            data += struct.pack(f"{order}b{len(values)}h", len(values), *values)
            data += row.astype(rows.dtype.newbyteorder(order)).tobytes()
    return head + data
