"""Checking a result: the bytes of its files, and every figure, derived again from its
rows; and copies for others.
"""

import math
import shutil
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import polars as pl

from attacks.figures.frame import Figure, Figures, Number, text_of
from attacks.figures.rate import Rate
from attacks.figures.result import Result, read_result
from attacks.observe.observations import ON_OBJECT
from attacks.observe.rows import DETECTIONS, FIGURES_FILE, ROWS
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import sha256
from mi_splat.io.folders import (
    MANIFEST,
    RECORD,
    files_in,
    is_own_file,
    new_folder,
    read_manifest,
)

TOLERANCE = 1e-6
RELATIVE = 1e-9
"""How far numbers, and ends of intervals, may be off that are derived again; counts
have to be equal.
"""
SCORE_TOLERANCE = 1e-4
MOST_WRONG = 0.02
"""How far a score may be off that single detections give, and of which part of the rows
more.
"""
KEPT = (".json", ".toml", ".csv", ".csv.xz", ".md")
"""Endings of the files of a result that are always in an artifact; splats and images
may be left out.
"""

Derive = Callable[[Mapping[str, Any], Mapping[str, pl.DataFrame]], Figures]
"""From what result.json states and the rows to the figures."""
_BROKEN = (
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    ArithmeticError,
    pl.exceptions.PolarsError,
)


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


def check_result(
    result: Result, derive: Derive | None, *, manifest: str | None = None
) -> list[Check]:
    """Every line of a result: of its files, of its figures, and of its single
    detections.
    """
    of_files = check_files(result.folder, manifest=manifest)
    return [*of_files, *check_figures(result, derive), *check_detections(result)]


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


def check_figures(result: Result, derive: Derive | None) -> list[Check]:
    """A line for each figure, which is derived again from the rows; none for a kind
    without rows.
    """
    if derive is None:
        return []
    derived = derived_figures(result, derive)
    stated = result.figures
    lines = []
    for key, figure in derived:
        found = stated.by_key.get(key)
        if found is not None and agree(found, figure):
            line = Check(name=text_of(key), words=in_words(figure), passed=True)
        else:
            got = "nothing" if found is None else in_words(found)
            words = f"{FIGURES_FILE} has {got}, the rows give {in_words(figure)}"
            line = Check(name=text_of(key), words=words, passed=False)
        lines.append(line)
    for key, figure in stated:
        if key not in derived.by_key:
            words = f"{in_words(figure)}, of no rows"
            lines.append(Check(name=text_of(key), words=words, passed=False))
    if "success" in result.record:  # which studies read that look for a radius
        success = result.record["success"]
        same = success is bool(derived.rate("succeeded").successes)
        lines.append(
            Check(name=f"success in {RECORD}", words=str(success), passed=same)
        )
    return lines


def agree(stated: Figure, derived: Figure) -> bool:
    """Whether two figures are the same, with their intervals."""
    if isinstance(stated, Rate) and isinstance(derived, Rate):
        if (stated.successes, stated.total) != (derived.successes, derived.total):
            return False
        pairs = list(zip(stated.interval, derived.interval, strict=True))
        return all(_near(one, other) for one, other in pairs)
    if isinstance(stated, Number) and isinstance(derived, Number):
        return all(
            _near(one, other)
            for one, other in zip(astuple(stated), astuple(derived), strict=True)
        )
    return False


def _near(stated: float | None, derived: float | None) -> bool:
    if stated is None or derived is None:
        return stated is derived
    return math.isclose(stated, derived, rel_tol=RELATIVE, abs_tol=TOLERANCE)


def in_words(figure: Figure) -> str:
    """A figure for people."""
    if isinstance(figure, Rate):
        return figure.short(interval=True)
    parts = [f"{figure.value:.6g}"]
    for name in ("low", "high", "least", "most", "total"):
        number = getattr(figure, name)
        if number is not None:
            parts.append(f"{name} {number:.6g}")
    return ", ".join(parts)


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


def derived_figures(result: Result, derive: Derive) -> Figures:
    """The figures of a result, from its rows."""
    try:
        return derive(result.record, result.tables)
    except InvalidValueError:
        raise
    except _BROKEN as error:
        got = f"{type(error).__name__}: {error}"[:200]
        do = "get the result again"
        raise InvalidValueError.of(
            str(result.folder), "the rows that its settings ask for", got, do
        ) from error


def pack(
    folder: Path,
    out: Path,
    derive: Derive | None,
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
        (line for line in check_result(result, derive) if line.passed is False),
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
