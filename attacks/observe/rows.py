"""What was seen, row by row: one schema for all attacks, one writer and one bounded
reader.

A row says what one detector reports on the object of one splat (clean, attacked, with
random noise) in one view, under one condition. Every figure is counted from such rows
(`attacks.observe.rates`). A result holds them as rows.csv.xz, and beside it
detections.csv.xz, with a row for each single detection. Images that no detector
looked at are rows without a detector, in tables of their own (fidelity.csv.xz,
transition.csv.xz). All tables take their columns from `COLUMNS`; what a kind of result
does not have is left out.

Tables are CSV, compressed by xz: equal rows have equal bytes, and text of strangers is
read within bounds. Parquet takes as much space at the same precision, and its pages
allocate what they claim.
"""

import csv
import lzma
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import get_args

import polars as pl

from attacks.observe import Control
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import atomic_write
from mi_splat.io.folders import file_in

Cell = str | int | float | bool | None
Row = Mapping[str, Cell]

ROWS = "rows"
DETECTIONS = "detections"
FIDELITY = "fidelity"
TRANSITION = "transition"
PATH = "path"
"""Names of the tables of a result; their files end in `SUFFIX`.

`PATH` has rows of cameras along a path.
"""
TABLES = (ROWS, DETECTIONS, FIDELITY, TRANSITION, PATH)
SUFFIX = ".csv.xz"
FIGURES = "figures"
FIGURES_FILE = f"{FIGURES}.csv"
CLEAN = "clean"
ATTACKED = "attacked"
NOISE = "noise"
"""Names of splats in the column `splat`."""
NORM_NOISE = "norm-noise"
CONTROLS: tuple[str, ...] = get_args(Control)
"""Names of the splats with a random change."""

MOST_BYTES = 1 << 26
MOST_COLUMNS = 200
MOST_CELLS = 1 << 24
"""Most that a table may be, unpacked; the largest of docs/artifacts has 10 MB and
860,000 cells.
"""
_MOST_HEAD = 1 << 16
_MOST_MEMORY = 1 << 27

_TYPES = {
    "text": pl.String,
    "whole": pl.Int64,
    "number": pl.Float64,
    "truth": pl.Boolean,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """A column of a table."""

    # at its head; one that ends in ": " stands for a column of each attack, whose name
    # follows
    name: str
    # what its cells hold: text, whole, number or truth, which is true or false
    kind: str
    meaning: str  # in words
    unit: str = ""  # of a number; empty for none
    optional: bool = False  # whether a cell may be empty, which stands for None

    def as_dict(self) -> dict[str, object]:
        """As JSON can hold it."""
        return asdict(self)

    @property
    def words(self) -> str:
        """The meaning, and the unit if it has one."""
        if self.unit:
            return f"{self.meaning}, {self.unit}"
        return self.meaning


BOX = ("x0", "y0", "x1", "y1")
"""Columns with the box of the object."""
DETECTION_BOX = tuple(f"box_{corner}" for corner in BOX)
"""Columns with the box of a detection."""
DEPTH = "depth: "
POISON_DEPTH = "poison_depth: "
TARGET_SCORE = "target_score: "
"""Heads of the columns that each attack of a study of CLOAK has; its name follows."""

OPERATING = "operating_threshold"
"""The column with the confidence from which the detections of a row's detector
count.
"""

_MEASURE = "measure"
"""The column that only tables of figures have: in these, labels may be empty."""

_TABLE: tuple[tuple[str, ...], ...] = (
    ("part", "text", "part of the study"),
    ("axis: ", "text", "value of NAME, which the study varies"),
    ("setting", "text", "all values that the study varies"),
    ("scope", "text", "what is counted together, where that is not everything"),
    ("attack", "text", "name of the attack in its study"),
    ("trigger", "text", "attack of CLOAK whose trigger is counted"),
    ("sources", "text", "attacked detectors, joined by +"),
    (
        "seed",
        "whole?",
        "random seed of the attack or of the training; empty for ground-truth images",
    ),
    (
        "condition",
        "text?",
        "evaluation condition or set of images; empty: as attacked",
    ),
    (
        "splat",
        "text",
        "clean (control), attacked, noise, smooth-noise, norm-noise (random)",
    ),
    (
        "draw",
        "whole?",
        "index of the draw of a random change, from 0; empty for other splats",
    ),
    ("detector", "text", "name of the detector"),
    ("checked_by", "text", "name of a detector that cross-checks this one"),
    (
        "access",
        "text",
        "white-box: the evaluating detector was attacked; else black-box",
    ),
    ("view", "whole", "index of the camera in cameras.json, or of the image, from 0"),
    (
        "object",
        "whole?",
        "index of the object in the image, from 0; empty: the detection matches none",
    ),
    ("camera", "text", "name of the camera"),
    ("split", "text", "train: camera of a training image; test: any other camera"),
    ("meridian", "whole", "index of the meridian of a transition"),
    ("azimuth", "number", "azimuth of the camera, from +x towards +y", "degrees"),
    ("elevation", "number", "elevation of the camera above the ground", "degrees"),
    ("distance", "number", "distance of the camera from the centre", "world units"),
    (
        "extent",
        "number",
        "diagonal of the object's bounding box in the world",
        "world units",
    ),
    *((axis, "number", "position of the camera", "world units") for axis in "xyz"),
    (
        DEPTH,
        "number",
        (
            "depth of the camera inside the trigger region of attack NAME; negative"
            " outside"
        ),
        "degrees",
    ),
    (
        POISON_DEPTH,
        "number",
        "depth of the camera inside the region whose images attack NAME poisons",
        "degrees",
    ),
    *(
        (name, "number?", f"{name} of the object's box; empty: not visible", "pixels")
        for name in BOX
    ),
    (
        "original",
        "text?",
        (
            "class of the object, or the detector's class for the clean object; empty:"
            " unknown"
        ),
    ),
    ("target", "text?", "target class of the attack"),
    (
        "label",
        "text?",
        (
            "class of the detection: in rows the most confident one on the object;"
            " empty: none"
        ),
    ),
    (
        "score",
        "number?",
        "its confidence; in rows 0 where nothing is detected on the object",
    ),
    *((name, "number?", "box of the detection", "pixels") for name in DETECTION_BOX),
    ("iou", "number?", "IoU of its box and the object's box"),
    (
        "original_score",
        "number?",
        "highest confidence of the original class (or any) at IoU >= 0.5; 0: none",
    ),
    ("target_score", "number?", "the same for the target class; empty: no target"),
    ("threshold", "number?", "confidence that the objective of the attack counts from"),
    (
        OPERATING,
        "number?",
        "confidence from which the detector's detections count; empty: 0.5",
    ),
    (
        TARGET_SCORE,
        "number?",
        (
            "the same for the target class of attack NAME; empty: the detector has no"
            " such class"
        ),
    ),
    ("any_overlap", "number?", "as original_score, at IoU >= 0.1"),
    ("success", "truth?", "whether the attack succeeds in this image"),
    (
        "unambiguous",
        "truth?",
        "whether it succeeds and no other class is more confident on the object",
    ),
    ("aim", "number?", "progress towards success, in [0, 1]"),
    (
        "psnr",
        "number?",
        "PSNR of the whole image, against the clean or ground-truth image",
        "dB",
    ),
    ("ssim", "number?", "SSIM of the same"),
    (
        "surroundings_psnr",
        "number?",
        "PSNR around the object, against the ground truth",
        "dB",
    ),
    (
        "intended_surroundings_psnr",
        "number?",
        "the same against what the attack wants to show there",
        "dB",
    ),
    (
        "object_psnr",
        "number?",
        "PSNR on the object, against the clean or (CLOAK: near triggers) true image",
        "dB",
    ),
    (
        "appearance_psnr",
        "number?",
        "PSNR on the object, against the appearance intended there",
        "dB",
    ),
    ("size", "number", "longer side of the object's box in the image", "image sides"),
    ("brightness", "number?", "mean luma of the image in the object's box"),
    (
        "sun_elevation",
        "number?",
        "elevation of the sun above the horizon; empty: unknown",
        "degrees",
    ),
    (
        "sun_strength",
        "number?",
        "irradiance of the sun on a surface facing it; empty: unknown",
    ),
    (
        "fraction",
        "number",
        "fraction of the transition from the benign to the hidden appearance",
    ),
    ("from", "number", "lower end of the angles that are counted", "degrees"),
    ("to", "number", "upper end of the angles that are counted", "degrees"),
    (_MEASURE, "text", "what is counted or measured"),
    ("successes", "whole?", "of a rate: in how many it holds"),
    ("total", "whole?", "of a rate: how many are counted; of a mean: of how many"),
    ("value", "number?", "the figure that is no rate"),
    ("low", "number?", "lower end of the 95 % interval"),
    ("high", "number?", "upper end of the 95 % interval"),
    ("least", "number?", "the smallest of the values that the figure summarises"),
    ("most", "number?", "the largest of them"),
)
"""Name, kind, meaning and unit of every column; a question mark: a cell may be
empty.
"""
COLUMNS = tuple(
    Column(
        name=name,
        kind=kind.rstrip("?"),
        meaning=meaning,
        unit="".join(unit),
        optional=kind.endswith("?"),
    )
    for name, kind, meaning, *unit in _TABLE
)
"""Every column that a table may have, in the order of the file."""

_ORDER = {column.name: number for number, column in enumerate(COLUMNS)}
_EACH = tuple(column.name for column in COLUMNS if column.name.endswith(": "))


def column_of(name: str) -> Column:
    """The column of this name."""
    head = next(
        (head for head in _EACH if name.startswith(head) and len(name) > len(head)),
        name,
    )
    if head not in _ORDER or (head == name and head in _EACH):
        raise InvalidValueError.of(
            "column", "one of attacks.observe.rows.COLUMNS", name[:40], "rename it"
        )
    column = COLUMNS[_ORDER[head]]
    return replace(
        column,
        name=name,
        meaning=column.meaning.replace("NAME", name.removeprefix(head)),
    )


def columns_of(names: Iterable[str]) -> tuple[Column, ...]:
    """The columns of these names in the order of the file; those of several attacks in
    the order given.
    """
    known = [column_of(name) for name in names]
    heads = {
        column.name: next(filter(column.name.startswith, _EACH), column.name)
        for column in known
    }
    return tuple(sorted(known, key=lambda column: _ORDER[heads[column.name]]))


def frame_of(rows: Iterable[Row]) -> pl.DataFrame:
    """Rows as a table; a cell that a row does not have is empty."""
    held = list(rows)
    columns = columns_of(dict.fromkeys(name for row in held for name in row))
    try:
        return pl.DataFrame(
            {
                column.name: pl.Series(
                    [row.get(column.name) for row in held], dtype=_TYPES[column.kind]
                )
                for column in columns
            }
        )
    except (TypeError, pl.exceptions.PolarsError) as error:
        raise InvalidValueError.of(
            "rows", "cells of the kinds of their columns", error, "mend them"
        ) from error


def frame_with(rows: Iterable[Row], columns: Sequence[str]) -> pl.DataFrame:
    """As `frame_of`, with some columns even where there is no row."""
    return pl.concat(
        [frame_of([dict.fromkeys(columns)]).clear(), frame_of(rows)], how="diagonal"
    )


def by_camera(rows: pl.DataFrame) -> pl.DataFrame:
    """The rows of each seed by their views, else as they were: a file of them is half
    as large, as cameras repeat.
    """
    if not {"seed", "view"} <= set(rows.columns):
        return rows
    seeds = rows.partition_by("seed", maintain_order=True)
    if seeds:
        return pl.concat(
            [of_seed.sort("view", maintain_order=True) for of_seed in seeds]
        )
    return rows


def rows_bytes(rows: pl.DataFrame) -> bytes:
    """A table as the text of a CSV file; equal tables have equal bytes."""
    columns = columns_of(rows.columns)
    _check_columns(columns, rows)
    return rows.select(column.name for column in columns).write_csv().encode()


def write_rows(rows: pl.DataFrame, path: Path) -> Path:
    """Write a table; equal tables have equal bytes."""
    data = rows_bytes(rows)
    if path.suffix == ".xz":
        data = packed(data)
    with atomic_write(path) as file:
        file.write(data)
    return path


def packed(data: bytes) -> bytes:
    """Data compressed; equal data has equal bytes."""
    return lzma.compress(data, preset=6)


def read_rows(path: Path) -> pl.DataFrame:
    """A table from its file, which may come from anybody; what Polars allocates is
    bounded before it reads.
    """
    data = _unpacked(path)
    head = next(
        csv.reader(
            [
                data[:_MOST_HEAD]
                .partition(b"\n")[0]
                .decode(errors="replace")
                .removesuffix("\r")
            ]
        ),
        [],
    )
    if len(set(head)) < len(head) or len(head) > MOST_COLUMNS:
        raise _broken(path, f"at most {MOST_COLUMNS} columns, each once", "others")
    columns = [column_of(name) for name in head]
    if data.count(b"\n") * len(head) > MOST_CELLS:
        raise _broken(path, f"at most {MOST_CELLS:,} cells", "more")
    if not head:
        return pl.DataFrame()
    try:
        table = pl.read_csv(
            data, schema={column.name: _TYPES[column.kind] for column in columns}
        )
    except pl.exceptions.PolarsError as error:
        raise _broken(
            path,
            "a CSV file with the types of its columns",
            str(error).splitlines()[0][:160],
        ) from error
    _check_columns(columns, table, f"{path}, ")
    return table


def rows(result: str | Path, table: str = ROWS) -> pl.DataFrame:
    """A table of a result.

    Args:
        result: Folder that a command has written.
        table: `rows`: what is reported on the object, a row for each splat, view and
            detector; `detections`: a row for each detection; `fidelity` and
            `transition`: images of CLOAK that no detector evaluated.

    Returns:
        A table of Polars; docs/rows.md explains its columns.

    Raises:
        InvalidValueError: The result does not have this table, or its file is none.
    """
    name = FIGURES_FILE if table == FIGURES else f"{table}{SUFFIX}"
    path = file_in(Path(result), name)
    if not path.is_file():
        do = "pass a folder that mi-splat dagger, evaluate, cloak or study has written"
        raise InvalidValueError.of(
            str(result), f"a result with {path.name}", "none", do
        )
    return read_rows(path)


def _unpacked(path: Path) -> bytes:
    """The text of a table; never more than `MOST_BYTES`."""
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        if path.suffix == ".xz":
            unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_MOST_MEMORY)
            data = unpacker.decompress(data, MOST_BYTES + 1)
            if not unpacker.eof and len(data) <= MOST_BYTES:
                raise EOFError("the file is cut off")
    except (OSError, EOFError, lzma.LZMAError) as error:
        raise _broken(path, "a table of rows", error) from error
    if len(data) > MOST_BYTES:
        raise _broken(path, f"at most {MOST_BYTES:,} bytes", "more")
    return data


def _check_columns(
    columns: Sequence[Column], table: pl.DataFrame, where: str = ""
) -> None:
    """Raise unless every cell is of the kind of its column."""
    has_figures = _MEASURE in table.columns
    for column in columns:
        if has_figures and column.name != _MEASURE:  # which may be of everything
            column = replace(column, optional=True)
        _check_column(column, table[column.name], where)


def _check_column(column: Column, cells: pl.Series, where: str) -> None:
    """Raise if a cell is empty that must not be, or a number is not finite."""
    if cells.dtype not in (_TYPES[column.kind], pl.Null):
        raise _broken(
            f"{where}row 2", f"a {column.kind} in column {column.name}", cells.dtype
        )
    wrong = cells.is_null() & (not column.optional)
    if cells.dtype == pl.Float64:
        wrong |= ~cells.is_finite().fill_null(value=True)
    elif cells.dtype == pl.String:
        wrong |= (cells == "").fill_null(value=False)
    if wrong.any():
        row = int(wrong.arg_true()[0])
        raise _broken(
            f"{where}row {row + 2}",
            f"a {column.kind} in column {column.name}",
            repr(cells[row]),
        )


def _broken(where: Path | str, expected: object, got: object) -> InvalidValueError:
    """The error for a file that is no table."""
    return InvalidValueError.of(str(where), expected, got, "get the result again")
