"""Tables of raw rows whose columns each kind of result names itself."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from attacks.observe.rows import Cell, Column, Row, broken, packed, read_cell, read_cells, written

__all__ = ["Cell", "Column", "Row", "Table", "read_table", "table_bytes", "write_table"]

PLAIN_BYTES = 1 << 16
"""Length from which on a table is compressed."""


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
        writer.writerow([written(column, row[column.name], f"row {number}") for column in table.columns])
    return text.getvalue().encode()


def write_table(table: Table, folder: Path, name: str) -> Path:
    """Write a table as NAME.csv, or NAME.csv.gz if it is long; returns the file."""
    data = table_bytes(table)
    plain = len(data) < PLAIN_BYTES
    path = folder / (f"{name}.csv" if plain else f"{name}.csv.gz")
    path.write_bytes(data if plain else packed(data))
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
    head, lines = read_cells(path)
    names = [column.name for column in columns]
    if head != names:
        missing = next((name for name in names if name not in head), "another order")
        raise broken(path, f"the columns {', '.join(names)}", f"others ({missing})")
    rows = tuple(
        {
            column.name: read_cell(column, cell, f"{path}, row {number}")
            for column, cell in zip(columns, cells, strict=True)
        }
        for number, cells in enumerate(lines, start=2)
    )
    return Table(columns=tuple(columns), rows=rows)
