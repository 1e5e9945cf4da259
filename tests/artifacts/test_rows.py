"""Rows go through CSV files unchanged, and what is no table is refused in words."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from attacks.artifacts import rows
from attacks.artifacts.rows import Column, Table, read_table, table_bytes, write_table
from mi_splat.errors import InvalidValueError

COLUMNS = (
    Column(name="word", kind="text", meaning="a word"),
    Column(name="count", kind="whole", meaning="a count"),
    Column(name="size", kind="number", meaning="a size", unit="m", optional=True),
    Column(name="holds", kind="truth", meaning="whether"),
)
ROW: dict[str, rows.Cell] = {"word": "a, b", "count": 3, "size": 0.1, "holds": True}
HEAD = "word,count,size,holds\n"

ROWS = st.lists(
    st.fixed_dictionaries(
        {
            "word": st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0\r"), min_size=1),
            "count": st.integers(-(10**17), 10**17),
            "size": st.none() | st.floats(allow_nan=False, allow_infinity=False),
            "holds": st.booleans(),
        }
    ),
    max_size=4,
)


@given(found=ROWS)
def test_rows_come_back_as_they_were(
    found: list[dict[str, rows.Cell]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    table = Table(columns=COLUMNS, rows=tuple(found))
    path = write_table(table, tmp_path_factory.getbasetemp(), "table")
    assert read_table(path, COLUMNS).rows == table.rows


def test_a_long_table_is_packed_and_its_bytes_are_always_the_same(tmp_path: Path) -> None:
    table = Table(columns=COLUMNS, rows=(ROW,) * 10_000)
    first, second = (write_table(table, folder, "t") for folder in (tmp_path, tmp_path))
    assert first.name == "t.csv.gz"
    assert first.read_bytes() == second.read_bytes()
    assert first.read_bytes()[4:8] == bytes(4)  # no time of day
    assert gzip.decompress(first.read_bytes()) == table_bytes(table)
    assert read_table(first, COLUMNS) == table


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "expected the columns word, count, size, holds, got others (word)"),
        ("count,word,size,holds\n", "others (another order)"),
        (f"{HEAD}a,1,0.5\n", "expected 4 cells in row 2, got 3"),
        (f"{HEAD}a,1,nan,true\n", "row 2: expected a finite number, got 'nan' in column size"),
        (f"{HEAD}a,1,1e999,true\n", "expected a finite number, got '1e999'"),
        (f"{HEAD}a,1.5,0.5,true\n", "expected a whole number, got '1.5' in column count"),
        (f"{HEAD}a,{'9' * 50},0.5,true\n", "expected a whole number"),
        (f"{HEAD}a,1,0.5,True\n", "expected true or false, got 'True'"),
        (f"{HEAD},1,0.5,true\n", "expected a text, got '' in column word"),
        (f'{HEAD}"a"b,1,0.5,true\n', "expected a CSV file"),
        (f"{HEAD}{'a' * 200_000},1,0.5,true\n", "expected a CSV file"),
    ],
)
def test_what_means_nothing_is_refused(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(InvalidValueError, match="get the artifact again") as error:
        read_table(path, COLUMNS)
    assert said in str(error.value)


CUT = gzip.compress(bytes(range(32, 120)), mtime=0)[:60]


@pytest.mark.parametrize(
    "data", [b"no gzip", CUT, gzip.compress(b"\xff", mtime=0)], ids=["no gzip", "a part", "no text"]
)
def test_broken_files_are_refused(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "t.csv.gz").write_bytes(data)
    with pytest.raises(InvalidValueError, match="expected a table of an artifact"):
        read_table(tmp_path / "t.csv.gz", COLUMNS)
    with pytest.raises(InvalidValueError, match="No such file"):
        read_table(tmp_path / "u.csv", COLUMNS)


def test_a_bomb_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows, "MOST_BYTES", 1000)
    (tmp_path / "t.csv.gz").write_bytes(gzip.compress(bytes(100_000)))
    with pytest.raises(InvalidValueError, match="expected at most 1,000 bytes, got more"):
        read_table(tmp_path / "t.csv.gz", COLUMNS)


def test_more_rows_than_anyone_has_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_table(Table(columns=COLUMNS, rows=(ROW,) * 5), tmp_path, "t")
    monkeypatch.setattr(rows, "MOST_ROWS", 4)
    with pytest.raises(InvalidValueError, match="expected at most 4 rows, got more"):
        read_table(path, COLUMNS)


@pytest.mark.parametrize("cell", [{"word": ""}, {"count": 1.0}, {"size": float("inf")}, {"holds": 1}, {"count": None}])
def test_cells_of_another_kind_are_not_written(cell: dict[str, rows.Cell]) -> None:
    with pytest.raises(InvalidValueError, match=f"row 2: expected a .* in column {next(iter(cell))}"):
        table_bytes(Table(columns=COLUMNS, rows=({**ROW, **cell},)))
