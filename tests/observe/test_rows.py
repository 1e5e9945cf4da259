"""Rows go through files unchanged, and what is no table of the schema is refused in
words.
"""

import json
import lzma
import re
import tracemalloc
from pathlib import Path

import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

import attacks
from attacks import cli
from attacks.observe import rows
from attacks.observe.rows import (
    COLUMNS,
    Cell,
    column_of,
    frame_of,
    read_rows,
    rows_bytes,
    write_rows,
)
from mi_splat.errors import InvalidValueError
from tests.project.layers import ROOT

pytestmark = pytest.mark.shipped

ROW: dict[str, Cell] = {"splat": "a, b", "view": 3, "iou": 0.1, "success": True}
HEAD = "splat,view,iou,success\n"

ROWS = st.lists(
    st.fixed_dictionaries(
        {
            "splat": st.text(
                st.characters(exclude_categories=["Cs"], exclude_characters="\0\r"),
                min_size=1,
            ),
            "view": st.integers(-(10**17), 10**17),
            "iou": st.none() | st.floats(allow_nan=False, allow_infinity=False),
            "success": st.booleans(),
        }
    ),
    max_size=4,
)


@given(rows=ROWS)
def test_rows_come_back_as_they_were(
    rows: list[dict[str, Cell]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    table = frame_of(rows)
    path = write_rows(table, tmp_path_factory.getbasetemp() / "table.csv.xz")
    assert read_rows(path).to_dicts() == rows
    assert not rows or read_rows(path).schema == table.schema


def test_the_bytes_are_always_the_same_whatever_the_order_of_columns(
    tmp_path: Path,
) -> None:
    table = frame_of([ROW] * 10_000)
    first = write_rows(table, tmp_path / "a.csv.xz").read_bytes()
    assert (
        write_rows(
            table.select(reversed(table.columns)), tmp_path / "b.csv.xz"
        ).read_bytes()
        == first
    )
    assert lzma.decompress(first) == rows_bytes(table)


def test_a_cell_that_a_row_lacks_is_empty() -> None:
    table = frame_of([ROW, {"splat": "clean", "view": 1}])
    assert table["success"].to_list() == [True, None]
    assert rows_bytes(table).decode().splitlines() == [
        HEAD.strip(),
        '"a, b",3,0.1,true',
        "clean,1,,",
    ]


def test_each_attack_has_columns_of_its_own(tmp_path: Path) -> None:
    table = frame_of(
        [
            {
                "view": 0,
                "depth: above": 1.5,
                "target_score: side": 0.25,
                "depth: side": -2.0,
                "seed": 0,
            }
        ]
    )
    assert table.columns == [
        "seed",
        "view",
        "depth: above",
        "depth: side",
        "target_score: side",
    ]
    assert read_rows(write_rows(table, tmp_path / "rows.csv.xz")).equals(table)
    assert "trigger region of attack above;" in column_of("depth: above").meaning


@pytest.mark.parametrize("name", ["depth", "depth: ", "", "colour", "score: car"])
def test_a_column_that_the_schema_lacks_is_refused(name: str) -> None:
    with pytest.raises(InvalidValueError, match=r"attacks\.observe\.rows\.COLUMNS"):
        frame_of([{name: 1.0}])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("view,view\n1,1\n", "expected at most 200 columns, each once, got others"),
        (
            ",".join(f"depth: {number}" for number in range(201)),
            "expected at most 200 columns",
        ),
        (f"{'c' * 200_000}\n", "expected one of attacks.observe.rows.COLUMNS"),
        (f"{HEAD}a,1,0.5,true,3\n", "found more fields than defined"),
        (f"{HEAD}a\n", "row 2: expected a whole in column view, got None"),
        (f"{HEAD}a,1,nan,true\n", "row 2: expected a number in column iou, got nan"),
        (f"{HEAD}a,1,1e999,true\n", "expected a number in column iou, got inf"),
        (
            f"{HEAD}a,1.5,0.5,true\n",
            "could not parse `1.5` as dtype `i64` at column 'view'",
        ),
        (f"{HEAD}a,{'9' * 50},0.5,true\n", "could not parse"),
        (f"{HEAD}a,1,0.5,yes\n", "could not parse `yes` as dtype `bool`"),
        (f"{HEAD},1,0.5,true\n", "expected a text in column splat, got None"),
        (f'{HEAD}"a"b,1,0.5,true\n', "expected a CSV file"),
    ],
)
def test_what_means_nothing_is_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(InvalidValueError) as error:
        read_rows(path)
    assert message in str(error.value)


CUT = lzma.compress(bytes(range(32, 120)))[:60]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"no xz", "expected a table of rows"),
        (CUT, "expected a table of rows"),
        (lzma.compress(b"view,splat\n1,\xff\n"), "invalid utf-8"),
        (
            lzma.compress(b"splat\n" + bytes(200_000)),
            "expected at most 100,000 bytes, got more",
        ),
        (
            lzma.compress(b"seed,object\n" + b",\n" * 600),
            "expected at most 1,000 cells, got more",
        ),
    ],
    ids=["no xz", "a part", "no text", "a bomb", "many cells"],
)
def test_broken_files_are_refused(
    data: bytes, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rows, "MOST_BYTES", 100_000)
    monkeypatch.setattr(rows, "MOST_CELLS", 1000)
    (tmp_path / "t.csv.xz").write_bytes(data)
    with pytest.raises(InvalidValueError, match=message):
        read_rows(tmp_path / "t.csv.xz")
    with pytest.raises(InvalidValueError, match="No such file"):
        read_rows(tmp_path / "u.csv")


def test_a_packed_table_asks_for_little_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A header of xz may ask for a dictionary of gigabytes, whatever follows."""
    monkeypatch.setattr(rows, "_MOST_MEMORY", 1 << 20)
    # 8 MiB of dictionary
    (tmp_path / "t.csv.xz").write_bytes(lzma.compress(b"splat\nclean\n", preset=6))
    with pytest.raises(InvalidValueError, match="expected a table of rows"):
        read_rows(tmp_path / "t.csv.xz")


def test_a_wide_table_of_unknown_columns_takes_little_memory(tmp_path: Path) -> None:
    line = ",".join(["ab"] * 200) + "\n"
    head = ",".join(f"c{number}" for number in range(200))
    (tmp_path / "t.csv.xz").write_bytes(
        lzma.compress((f"{head}\n" + line * 20_000).encode(), preset=0)
    )
    tracemalloc.start()
    with pytest.raises(InvalidValueError, match="column: expected"):
        read_rows(tmp_path / "t.csv.xz")
    assert tracemalloc.get_traced_memory()[1] < 100 << 20
    tracemalloc.stop()


@pytest.mark.parametrize(
    "cell",
    [
        {"splat": ""},
        {"iou": float("inf")},
        {"iou": float("nan")},
        {"view": None},
        {"splat": None},
    ],
)
def test_cells_of_another_kind_are_not_written(cell: dict[str, Cell]) -> None:
    name = next(iter(cell))
    with pytest.raises(
        InvalidValueError, match=f"row 2: expected a .* in column {name}"
    ):
        rows_bytes(frame_of([{**ROW, **cell}]))
    with pytest.raises(
        InvalidValueError, match=re.escape("cells of the kinds of their columns")
    ):
        frame_of([{**ROW, "view": 0.5}])
    with pytest.raises(
        InvalidValueError, match="expected a whole in column view, got Float64"
    ):
        rows_bytes(pl.DataFrame({"view": [1.0]}))


def test_the_page_of_the_documentation_has_every_column() -> None:
    lines = (ROOT / "docs" / "rows.md").read_text().splitlines()
    table = [line for line in lines if line.startswith("| `")]
    named = [
        f"{one.name}NAME" if one.name.endswith(": ") else one.name for one in COLUMNS
    ]
    expected = [
        f"| `{name}` | {one.unit} | {one.meaning} |"
        for name, one in zip(named, COLUMNS, strict=True)
    ]
    assert table == expected


def test_the_command_shows_the_rows_of_a_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = frame_of([ROW, {"splat": "clean", "view": 1}])
    write_rows(table, tmp_path / "rows.csv.xz")
    assert attacks.rows(tmp_path).equals(table)
    assert cli.main(["rows", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    assert "index of the camera in cameras.json, or of the image, from 0" in told
    assert "2 rows; --csv or --json prints them." in told
    assert cli.main(["rows", str(tmp_path), "--csv"]) == 0
    assert capsys.readouterr().out == rows_bytes(table).decode()
    assert cli.main(["rows", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == table.to_dicts()
    assert cli.main(["rows", str(tmp_path), "--table", "detections"]) == 1
    assert (
        "expected a result with detections.csv.xz, got none" in capsys.readouterr().err
    )
