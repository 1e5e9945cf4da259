"""Tables of raw rows as CSV files: the same bytes for the same rows, and the same numbers back."""

from __future__ import annotations

import csv
import gzip
import io
import math
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from mi_splat.errors import InvalidValueError, message

Cell = str | int | float | bool | None
Row = Mapping[str, Cell]

PLAIN_BYTES = 1 << 16
"""Length from which on a table is compressed."""
MOST_BYTES = 1 << 28
"""Most that a table may be, unpacked: one that is larger is not read."""
MOST_ROWS = 4_000_000

_WHOLE = re.compile(r"-?[0-9]{1,18}")
_NUMBER = re.compile(r"-?[0-9]+(\.[0-9]+)?(e[+-]?[0-9]{1,3})?")


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """A column of a table.

    Attributes:
        name: At its head.
        kind: What its cells hold; a truth is true or false.
        unit: Of a number; empty for none.
        meaning: In words.
        optional: Whether a cell may be empty, which stands for None.
    """

    name: str
    kind: Literal["text", "whole", "number", "truth"]
    meaning: str
    unit: str = ""
    optional: bool = False

    def as_dict(self) -> dict[str, object]:
        """As JSON can hold it."""
        return asdict(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Rows of raw results.

    Attributes:
        columns: What a row has.
        rows: A cell for each column.
    """

    columns: tuple[Column, ...]
    rows: tuple[Row, ...]


def table_bytes(table: Table) -> bytes:
    """A table as the bytes of a CSV file; equal tables have equal bytes.

    Raises:
        InvalidValueError: A cell is not of the kind of its column.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([column.name for column in table.columns])
    for number, row in enumerate(table.rows, start=2):
        writer.writerow([_written(column, row[column.name], f"row {number}") for column in table.columns])
    return text.getvalue().encode()


def write_table(table: Table, folder: Path, name: str) -> Path:
    """Write a table as NAME.csv, or NAME.csv.gz if it is long; returns the file."""
    data = table_bytes(table)
    if len(data) < PLAIN_BYTES:
        path = folder / f"{name}.csv"
        path.write_bytes(data)
        return path
    path = folder / f"{name}.csv.gz"
    packed = io.BytesIO()
    with gzip.GzipFile(filename="", mode="wb", compresslevel=9, fileobj=packed, mtime=0) as file:
        file.write(data)
    path.write_bytes(packed.getvalue())
    return path


def read_table(path: Path, columns: Sequence[Column]) -> Table:
    """A table from its file.

    Args:
        path: NAME.csv or NAME.csv.gz.
        columns: What it must have, in this order.

    Raises:
        InvalidValueError: The file is missing, too large or no CSV, its columns are others, or a cell is not of the
            kind of its column.
    """
    text = _text(path)
    try:
        lines = iter(csv.reader(io.StringIO(text, newline=""), strict=True))
        head = next(lines, [])
        names = [column.name for column in columns]
        if head != names:
            missing = next((name for name in names if name not in head), "another order")
            raise _broken(path, f"the columns {', '.join(names)}", f"others ({missing})")
        rows = tuple(_rows(lines, columns, path))
    except csv.Error as error:
        raise _broken(path, "a CSV file", error) from error
    return Table(columns=tuple(columns), rows=rows)


def _rows(lines: Iterator[list[str]], columns: Sequence[Column], path: Path) -> Iterator[Row]:
    for number, cells in enumerate(lines, start=2):
        if len(cells) != len(columns):
            raise _broken(path, f"{len(columns)} cells in row {number}", len(cells))
        if number > MOST_ROWS:
            raise _broken(path, f"at most {MOST_ROWS:,} rows", "more")
        yield {
            column.name: _read(column, cell, f"{path}, row {number}")
            for column, cell in zip(columns, cells, strict=True)
        }


def _text(path: Path) -> str:
    """The text of a file, unpacked; never more than `MOST_BYTES`."""
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise _broken(path, f"at most {MOST_BYTES:,} bytes", "more")
        return data.decode()
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise _broken(path, "a table of an artifact", error) from error


def _written(column: Column, value: Cell, where: str) -> str:
    """A cell as it stands in the file."""
    kinds = {"text": str, "whole": int, "number": float, "truth": bool}
    if value is None and column.optional:
        return ""
    if column.kind == "number" and type(value) is int:
        value = float(value)
    fits = type(value) is kinds[column.kind] and (column.kind != "text" or value != "")
    if not fits or (isinstance(value, float) and not math.isfinite(value)):
        expected = f"a {column.kind} in column {column.name}"
        raise InvalidValueError(message(where, expected, repr(value), "make the result again"))
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)


def _read(column: Column, text: str, where: str) -> Cell:
    """The value of a cell."""
    if text == "" and column.optional:
        return None
    if column.kind == "text" and text:
        return text
    if column.kind == "whole" and _WHOLE.fullmatch(text):
        return int(text)
    if column.kind == "number" and _NUMBER.fullmatch(text) and math.isfinite(float(text)):
        return float(text)
    if column.kind == "truth" and text in ("true", "false"):
        return text == "true"
    what = {"number": "a finite number", "whole": "a whole number", "truth": "true or false", "text": "a text"}
    got = f"{text[:40]!r} in column {column.name}"
    raise InvalidValueError(message(where, what[column.kind], got, "get the artifact again"))


def _broken(path: Path, expected: object, got: object) -> InvalidValueError:
    return InvalidValueError(message(str(path), expected, got, "get the artifact again"))
