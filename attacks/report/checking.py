"""Checking a result: the bytes of its files, and every figure, derived again from its
rows; and copies for others.
"""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import polars as pl

from attacks.observe.observations import ON_OBJECT
from attacks.observe.rows import DETECTIONS, ROWS, SUFFIX, TABLES, read_rows
from attacks.rate import wilson
from attacks.report.section import plain
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import sha256
from mi_splat.io.folders import (
    MANIFEST,
    RECORD,
    Manifest,
    file_in,
    files_in,
    is_own_file,
    new_folder,
    read_manifest,
)
from mi_splat.io.parsing import DocumentReader

TOLERANCE = 1e-6
"""How far decibels, degrees and confidences may be off that are derived again; counts
and words have to be equal.
"""
SCORE_TOLERANCE = 1e-4
MOST_WRONG = 0.02
"""How far a score may be off that single detections give, and of which part of the rows
more.
"""
KEPT = (".json", ".toml", ".csv.xz", ".md")
"""Endings of the files of a result that are always in an artifact; splats and pictures
may be left out.
"""

_BROKEN = (
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    ArithmeticError,
    pl.exceptions.PolarsError,
)
Record = Mapping[str, Any]
Tables = Mapping[str, pl.DataFrame]
Figures = Callable[[Mapping[str, Any], Tables], Mapping[str, Any]]
"""From the settings in result.json and the rows to figures, which stand in result.json
under the same keys.
"""
Value = int | float | bool | str | tuple[int, int] | None
"""A figure; of a rate, successes and total are one figure, its fraction and the ends of
its interval three more.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One line of what was checked."""

    name: str  # what was looked at
    words: str  # what was found
    # whether it is as it has to be; None if there is nothing to compare it with
    passed: bool | None

    @property
    def colour(self) -> str:
        """Green, red, or grey where there is nothing to compare with."""
        if self.passed is None:
            return "grey"
        if self.passed:
            return "green"
        return "red"

    def as_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return {"name": self.name, "colour": self.colour, "words": self.words}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Result:
    """A finished result in its folder."""

    folder: Path
    record: Mapping[str, Any]  # its result.json
    manifest: Manifest
    tables: Tables  # its tables of rows by name

    @property
    def kind(self) -> str:
        """Name of its kind."""
        return str(self.record.get("story"))


def read_result(folder: Path) -> Result:
    """A result with its tables."""
    record = DocumentReader(do="pass a folder of results").read_json(
        file_in(folder, RECORD)
    )
    return Result(
        folder=folder,
        record=record,
        manifest=read_manifest(folder),
        tables=read_tables(folder),
    )


def read_tables(folder: Path, names: Sequence[str] = TABLES) -> Tables:
    """The tables that a result has, of those with these names."""
    paths = {name: file_in(folder, f"{name}{SUFFIX}") for name in names}
    return {name: read_rows(path) for name, path in paths.items() if path.is_file()}


def check_result(
    result: Result,
    figures: Figures | None,
    given: Sequence[str] = (),
    *,
    manifest: str | None = None,
) -> list[Check]:
    """Every line of a result: of its files, of its figures, and of its single
    detections.
    """
    of_files = check_files(result.folder, manifest=manifest)
    of_figures = check_figures(result, figures, given)
    return [*of_files, *of_figures, *check_detections(result)]


def check_files(folder: Path, *, manifest: str | None = None) -> list[Check]:
    """A line for the manifest of a result, for each file that it lists, and for each
    that it does not list.
    """
    listed = read_manifest(folder)
    same = None if manifest is None else listed.sha256 == manifest
    lines = [
        Check(
            name=MANIFEST,
            words=f"sha256 {listed.sha256}{', another' if same is False else ''}",
            passed=same,
        )
    ]
    for name, (digest, length) in listed.files.items():
        path = folder / name
        kept = name.endswith(KEPT)
        if not is_own_file(folder, name):
            lines.append(
                Check(
                    name=name,
                    words="missing" if kept else "left out",
                    passed=False if kept else None,
                )
            )
        elif path.stat().st_size != length or sha256(path) != digest:
            lines.append(
                Check(
                    name=name, words=f"other bytes than {MANIFEST} lists", passed=False
                )
            )
        else:
            lines.append(
                Check(
                    name=name,
                    words=f"{length:,} bytes, sha256 {digest[:16]}",
                    passed=True,
                )
            )
    unlisted = (
        name for name, _ in files_in(folder, listed.without) if name not in listed.files
    )
    return [
        *lines,
        *(
            Check(name=name, words=f"not listed in {MANIFEST}", passed=False)
            for name in unlisted
        ),
    ]


def check_figures(
    result: Result, figures: Figures | None, given: Sequence[str] = ()
) -> list[Check]:
    """A line for each figure that follows from the rows, and for each number in
    result.json that does not.

    Args:
        result: Result with its rows.
        figures: Derives the figures; None for a kind without rows.
        given: Patterns of the names of numbers that are settings, or were measured once
            and are in no rows.
    """
    stated = flat(result.record)
    if figures is None:
        rates = [name for name, value in stated.items() if isinstance(value, tuple)]
        return [
            Check(name=name, words=f"{in_words(stated[name])}, of no rows", passed=None)
            for name in rates
        ]
    derived = flat(_derived(result, figures))
    lines = []
    for name, value in derived.items():
        stated_value = in_words(stated.get(name))
        same = name in stated and agree(stated[name], value)
        if same:
            words = in_words(value)
        else:
            words = f"result.json has {stated_value}, the rows give {in_words(value)}"
        lines.append(Check(name=name, words=words, passed=same))
    for name, value in stated.items():
        if name not in derived and _is_unexplained(name, value, given):
            words = f"{in_words(value)}, of no rows"
            lines.append(Check(name=name, words=words, passed=False))
    return lines


def _is_unexplained(name: str, value: Value, given: Sequence[str]) -> bool:
    """Whether a figure that the rows do not give should not stand in a result."""
    if isinstance(value, tuple):
        return True
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_number and not any(fnmatchcase(name, pattern) for pattern in given)


def check_detections(result: Result) -> list[Check]:
    """Whether the single detections give the scores in the rows; nothing of a result
    that has none.
    """
    if not {ROWS, DETECTIONS} <= set(result.tables):
        return []
    rows = result.tables[ROWS]
    every = result.tables[DETECTIONS]
    ids = ("attack", "seed", "condition", "splat", "draw", "detector", "view", "object")
    on = [name for name in ids if name in rows.columns]
    shared = [name for name in on if name in every.columns]
    held = every.filter(pl.col("iou") >= ON_OBJECT).select(
        *shared, "label", again="score"
    )
    pairs = rows.with_row_index("row").select(
        "row", *shared, "original", "score", "original_score"
    )
    pairs = pairs.join(held, on=shared, how="left", nulls_equal=True)
    of_class = pl.when(
        pl.col("label") == pl.col("original").fill_null(pl.col("label"))
    ).then("again")
    given = pairs.group_by("row").agg(
        pl.col("score", "original_score").first(),
        any_again=pl.col("again").max().fill_null(0.0),
        class_again=of_class.max().fill_null(0.0),
    )
    moves = [
        (pl.col("score") - pl.col("any_again")).abs(),
        (pl.col("original_score") - pl.col("class_again")).abs(),
    ]
    off = pl.max_horizontal(moves)
    wrong = given.filter(off > SCORE_TOLERANCE).height
    words = f"give the scores of {len(rows) - wrong:,} of {len(rows):,} rows"
    return [Check(name=DETECTIONS, words=words, passed=wrong <= MOST_WRONG * len(rows))]


def _derived(result: Result, figures: Figures) -> Mapping[str, Any]:
    """The figures of a result, of its rows."""
    try:
        return figures(result.record, result.tables)
    except InvalidValueError:
        raise
    except _BROKEN as error:
        got = f"{type(error).__name__}: {error}"[:200]
        do = "get the result again"
        raise InvalidValueError.of(
            str(result.folder), "the rows that its settings ask for", got, do
        ) from error


def flat(values: Mapping[str, Any]) -> dict[str, Value]:
    """Figures in nested objects and lists by their keys with / between.

    Successes and total of a rate are one figure under its name, its fraction and
    interval stand below that.

    An entry of a list is called by its number, or, if it is one of several parts of an
    interval, by the ends of that.
    """
    return dict(_flat(values, ""))


def _flat(value: Any, name: str) -> Iterator[tuple[str, Value]]:
    if isinstance(value, Mapping) and {"successes", "total"} <= set(value):
        successes = value["successes"]
        total = value["total"]
        is_rate = type(successes) is type(total) is int and 0 <= successes <= total
        if not is_rate:
            do = "get the result again"
            raise InvalidValueError.of(
                name, "a rate of whole numbers", str(value)[:80], do
            )
        yield name, (successes, total)
        further = {
            key: entry
            for key, entry in value.items()
            if key not in ("successes", "total")
        }
        # A rate without an interval is shown with Wilson's.
        interval = wilson(successes / (total or 1), total)
        yield from _flat({"interval": interval, **further}, name)
    elif isinstance(value, Mapping):
        for key, entry in value.items():
            yield from _flat(entry, f"{name}/{key}" if name else str(key))
    elif isinstance(value, (list, tuple)):
        for number, entry in enumerate(value):
            if isinstance(entry, Mapping) and {"from", "to"} <= set(entry):
                band = {
                    key: figure
                    for key, figure in entry.items()
                    if key not in ("from", "to")
                }
                yield from _flat(
                    band, f"{name}/{plain(entry['from'])} to {plain(entry['to'])}"
                )
            else:
                yield from _flat(entry, f"{name}/{number}")
    else:
        yield name, value


def agree(stated: Value, derived: Value) -> bool:
    """Whether two figures are the same."""
    if isinstance(stated, bool) or isinstance(derived, bool):
        return stated is derived
    if isinstance(stated, (int, float)) and isinstance(derived, (int, float)):
        return abs(stated - derived) <= (TOLERANCE if isinstance(derived, float) else 0)
    return stated == derived


def in_words(value: Value) -> str:
    """A figure for people."""
    if isinstance(value, tuple):
        return f"{value[0]}/{value[1]}"
    if value is None or isinstance(value, bool):
        return {None: "none", True: "yes", False: "no"}[value]
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)


def pack(
    folder: Path,
    out: Path,
    figures: Figures | None,
    given: Sequence[str] = (),
    *,
    whole: bool = False,
    force: bool = False,
) -> Result:
    """Copy a finished result into a new folder, which appears whole or not at all.

    Its manifest stays what it is, so that the copy has the same name (the SHA-256 of
    its manifest) and says what was left out.
    """
    result = read_result(folder)
    red = next(
        (line for line in check_result(result, figures, given) if line.passed is False),
        None,
    )
    if red is not None:
        do = "make the result again: it was changed, or it is not of these rows"
        raise InvalidValueError.of(
            str(folder), "a result as it was written", f"{red.name}: {red.words}", do
        )
    with new_folder(out, force=force, record=RECORD, manifest=False) as copy:
        for name in (MANIFEST, *result.manifest.files):
            if (whole or name.endswith(KEPT)) and is_own_file(folder, name):
                (copy / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(folder / name, copy / name)
    return read_result(out)
