"""The figures of a suite: how often a detector still names what it named before.

Every rate is of views in which the detector names the clean object (the control).
Higher is more robust. What cannot be judged is counted and not guessed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import polars as pl

from attacks.figures.frame import MEASURE, NOTHING, Figures, Labels, Number
from attacks.figures.rate import Rate, pooled
from attacks.figures.tables import NONE, Column, Table
from attacks.observe.rates import Measure, blocks_of, count, with_thresholds
from attacks.observe.rows import ATTACKED, CLEAN, NOISE, OPERATING, ROWS

STORY = "bench"
ONE_VIEW, ALL_VIEWS, CLOAK, TRANSFER = COLUMNS = (
    "one_view",
    "all_views",
    "cloak",
    "transfer",
)
"""What a row has a rate for, each with a study file of its name; parts of the figures.
"""
DEFENDED = "defended"
"""What rows call the condition with the defence, and figures the scope."""
LEAST = 10
"""Views that have to be judged for a column to have a rate."""
KNOWS: Mapping[str, Mapping[str, Any]] = {
    f"SH of degree {degree}": {"attack": {"sh_degree": degree}} for degree in range(3)
}
"""Of defences what an attacker who knows them does otherwise."""
HEADS = {
    "one_view": "one view",
    "all_views": "all views",
    "cloak": "CLOAK",
    "transfer": "transfer",
}
"""Columns in words."""

Row = tuple[Mapping[str, Any], Figures]
"""What a result states, and its figures."""
Entries = Iterator[tuple[Labels, Rate | Number | None]]


def figures(record: Mapping[str, Any], tables: Mapping[str, pl.DataFrame]) -> Figures:
    """Every figure of a suite, from its rows."""
    rows = with_thresholds(tables[ROWS])
    columns = []
    for name in COLUMNS:
        attacks = {
            title: attack
            for title, attack in record["attacks"].items()
            if attack["column"] == name
        }
        entries = Figures.of(_column(attacks, rows))
        columns.append(entries.labelled(part=name))
    every = Figures.together(columns)
    score = [] if record["missing"] else [({MEASURE: "score"}, score_of(every))]
    return Figures.together([every, Figures.of(score)])


def robust(figures: Figures, column: str, **labels: str) -> Rate | None:
    """The rate of a column; None where too few views can be judged."""
    rate = figures.rate("robust", part=column, **labels)
    if rate.total >= LEAST:
        return rate
    return None


def warnings(figures: Figures) -> Iterator[str]:
    """Reasons to think that attacks on the detector itself were too weak, so that a
    rate says little.
    """
    itself = robust(figures, ONE_VIEW)
    others = robust(figures, TRANSFER)
    if itself and others and others.interval[1] < itself.interval[0]:
        yield (
            "Attacks on others do more than attacks on it: its gradients may be hidden."
        )
    for column in (ONE_VIEW, ALL_VIEWS):
        noise = figures.rate("noise", part=column)
        attacked = robust(figures, column)
        if attacked and noise.total and noise.fraction <= attacked.interval[1]:
            yield (
                "Random noise of the same size does about as much as the attacks:"
                f" {HEADS[column]}."
            )


def score_of(figures: Figures) -> Number | None:
    """The mean of the columns, if none is missing; its interval takes them for
    independent.
    """
    rates = [rate for name in COLUMNS if (rate := robust(figures, name)) is not None]
    if len(rates) < len(COLUMNS):
        return None
    mean = sum(rate.fraction for rate in rates) / len(rates)
    below = math.hypot(*(rate.fraction - rate.interval[0] for rate in rates))
    above = math.hypot(*(rate.fraction - rate.interval[1] for rate in rates))
    return Number(
        value=round(mean, 6),
        low=round(max(0.0, mean - below / len(rates)), 6),
        high=round(min(1.0, mean + above / len(rates)), 6),
    )


def _column(attacks: Mapping[str, Any], rows: pl.DataFrame) -> Entries:
    of = pl.col("attack")
    blind = [name for name, attack in attacks.items() if not attack["knows"]]
    aware = [name for name, attack in attacks.items() if attack["knows"]]
    seen = judged(rows.filter(of.is_in(blind)))
    yield {MEASURE: "robust"}, _named(seen, ATTACKED)
    yield {MEASURE: "noise"}, _named(seen, NOISE)
    clean = rows.filter(of.is_in(blind), ~_DEFENDED, splat=CLEAN)
    yield {MEASURE: "named_clean"}, count(clean, {"named": _NAMED}).rate("named")
    settings: dict[str, list[str]] = {}
    for name in attacks:
        setting = ", ".join(map(str, attacks[name]["labels"].values()))
        settings.setdefault(setting, []).append(name)
    for setting, names in settings.items():
        of_setting = seen.filter(of.is_in(names))
        yield {MEASURE: "robust", "setting": setting}, _named(of_setting, ATTACKED)
    if DEFENDED in seen["condition"]:
        under: Labels = {"scope": DEFENDED}
        defended = _named(seen, ATTACKED, defended=True)
        yield {MEASURE: "robust", **under}, defended
        yield {MEASURE: "clean", **under}, _named(seen, CLEAN, defended=True)
        known = judged(rows.filter(of.is_in(aware)))
        if len(known):
            adaptive = _named(known, ATTACKED, defended=True)
            yield {MEASURE: "robust_if_known", **under}, adaptive


_DEFENDED = pl.col("condition") == DEFENDED
_NAMED = Measure(holds=pl.col("original_score") >= pl.col(OPERATING))


def judged(rows: pl.DataFrame) -> pl.DataFrame:
    """The rows of views in which the clean object is named without a defence, with the
    block of their camera.
    """
    if rows.is_empty():
        return rows.with_columns(block=pl.lit("", pl.String))
    on = ["attack", "seed", "view"]
    control = rows.filter(_NAMED.holds, ~_DEFENDED, splat=CLEAN)
    block = blocks_of("azimuth", "elevation").cast(pl.String)
    block = pl.concat_str(pl.col("original"), block, separator=" ")
    once = control.select(on).unique()
    return rows.join(once, on=on, maintain_order="left").with_columns(block=block)


def _named(rows: pl.DataFrame, splat: str, *, defended: bool = False) -> Rate:
    """How often the object is still named on a splat, with the interval of blocks of
    cameras and of seeds.
    """
    if rows.is_empty():
        return NOTHING
    under = _DEFENDED if defended else ~_DEFENDED
    given = under & (pl.col("splat") == splat)
    named = Measure(holds=_NAMED.holds, given=given)
    return count(rows, {"named": named}, clusters=("block", "seed")).rate("named")


def table_of(rows: Sequence[Row]) -> Table:
    """A table of rows, the highest score first; those without one are below, and have
    no rank.
    """
    scores = {id(row): row[1].value("score") for row in rows}
    others = [row for row in rows if scores[id(row)] is None]
    others.sort(key=lambda row: str(row[0]["detector"]["name"]))
    ranked = [row for row in rows if scores[id(row)] is not None]
    ranked.sort(key=lambda row: -(scores[id(row)] or 0.0))
    ranks = {id(row): str(number) for number, row in enumerate(ranked, 1)}
    columns: dict[str, Column[Row]] = {
        "rank": lambda row: ranks.get(id(row), NONE),
        "detector": lambda row: row[0]["detector"]["name"],
        "score": lambda row: score_words(row[1]),
        **{head: _rate_of(column) for column, head in HEADS.items()},
        "clean object named": lambda row: clean_named(row[1]).short(),
        "warnings": lambda row: " ".join(warnings(row[1])) or None,
        "CPU minutes": lambda row: f"{row[0]['cpu_seconds']['all'] / 60:.1f}",
    }
    return Table.of("Robustness", columns, [*ranked, *others])


def clean_named(figures: Figures) -> Rate:
    """In how many views of all columns the clean object is named."""
    return pooled(figures.rate("named_clean", part=name) for name in COLUMNS)


def score_words(figures: Figures) -> str | None:
    """The score with its interval."""
    score = figures.find("score")
    if not isinstance(score, Number):
        return None
    return f"{score.value:.2f} ({score.low:.2f} to {score.high:.2f})"


def _rate_of(column: str) -> Column[Row]:
    def text(row: Row) -> str:
        record, figures = row
        rate = robust(figures, column)
        if rate is not None:
            return rate.short(interval=True)
        if column in record["missing"]:
            return "not filled"
        views = figures.rate("robust", part=column).total
        return f"not evaluated ({views} views)"

    return text
