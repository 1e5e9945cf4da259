"""The row of a suite: how often a detector still names what it named before, counted
from the rows of its looks.

Every rate is of views in which the detector names the clean object (the control).
Higher is more robust. What cannot be judged is counted and not guessed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import polars as pl

from attacks.observe.rates import REPORTED, Measure, blocks_of, count
from attacks.observe.rows import ATTACKED, CLEAN, NOISE, ROWS
from attacks.rate import Rate, pooled
from attacks.tables import Table

STORY = "bench"
ROW = "row.json"
ONE_VIEW, ALL_VIEWS, CLOAK, TRANSFER = COLUMNS = (
    "one_view",
    "all_views",
    "cloak",
    "transfer",
)
"""What a row has a rate for, each with a study file of its name."""
DEFENDED = "defended"
"""What rows call the condition with the defence."""
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
NOT_IN_ROW = ("attacks", "command", "name", "question", "story", "study")
"""What the record of a result has, and its row has not."""
Record = Mapping[str, Any]


def row_of(record: Record) -> dict[str, Any]:
    """What of a record is its row."""
    return {key: value for key, value in record.items() if key not in NOT_IN_ROW}


def figures(record: Record, frames: Mapping[str, pl.DataFrame]) -> dict[str, Any]:
    """Every figure of a suite, of its rows."""
    attacks = record["attacks"]
    rows = frames[ROWS]
    columns = {name: _column(attacks, rows, name) for name in COLUMNS}
    score = score_of({"columns": columns, "missing": record["missing"]})
    return {"columns": columns, "score": score, "warnings": warnings(columns)}


def warnings(columns: Mapping[str, Record]) -> list[str]:
    """Reasons to think that attacks on the detector itself were too weak, so that a
    rate says little.
    """
    told = []
    itself = columns[ONE_VIEW]["robust"]
    others = columns[TRANSFER]["robust"]
    if itself and others and others["interval"][1] < itself["interval"][0]:
        told.append(
            "Attacks on others do more than attacks on it: its gradients may be hidden."
        )
    for column in (ONE_VIEW, ALL_VIEWS):
        noise = columns[column]["noise"]
        robust = columns[column]["robust"]
        if robust and noise["total"] and noise["rate"] <= robust["interval"][1]:
            told.append(
                "Random noise of the same size does about as much as the attacks:"
                f" {HEADS[column]}."
            )
    return told


def score_of(row: Record) -> dict[str, Any] | None:
    """The mean of the columns, if none is missing; its interval takes them for
    independent.
    """
    rates = [
        column["robust"]
        for column in row["columns"].values()
        if column["robust"] is not None
    ]
    if len(rates) < len(COLUMNS) or row["missing"]:
        return None
    mean = sum(rate["rate"] for rate in rates) / len(rates)
    low, high = (
        math.sqrt(sum((rate["rate"] - rate["interval"][end]) ** 2 for rate in rates))
        / len(rates)
        for end in (0, 1)
    )
    return {
        "mean": round(mean, 6),
        "interval": [round(max(0.0, mean - low), 6), round(min(1.0, mean + high), 6)],
    }


def _column(attacks: Record, rows: pl.DataFrame, column: str) -> dict[str, Any]:
    mine = {
        name: attack for name, attack in attacks.items() if attack["column"] == column
    }
    blind = rows.filter(
        pl.col("attack").is_in(
            [name for name, attack in mine.items() if not attack["knows"]]
        )
    )
    looked = judged(blind)
    robust = _rates(looked, {"robust": ATTACKED})["robust"]
    clean = blind.filter(pl.col("splat") == CLEAN, pl.col("condition") != DEFENDED)
    told: dict[str, Any] = {
        "robust": robust.as_dict() if robust.total >= LEAST else None,
        "named_clean": (
            Rate(
                successes=int((clean["original_score"] >= REPORTED).sum()),
                total=len(clean),
            ).as_dict()
        ),
        "judged": robust.total,
        "noise": _rates(looked, {"noise": NOISE})["noise"].as_dict(),
        "by": {},
    }
    for label in dict.fromkeys(
        ", ".join(map(str, attack["labels"].values())) for attack in mine.values()
    ):
        names = [
            name
            for name, attack in mine.items()
            if ", ".join(map(str, attack["labels"].values())) == label
        ]
        rate = _rates(
            looked.filter(pl.col("attack").is_in(names)), {"robust": ATTACKED}
        )["robust"]
        told["by"][label] = {"successes": rate.successes, "total": rate.total}
    if DEFENDED in blind["condition"]:
        under = _rates(looked, {"robust": ATTACKED, "clean": CLEAN}, DEFENDED)
        aware = rows.filter(
            pl.col("attack").is_in(
                [name for name, attack in mine.items() if attack["knows"]]
            )
        )
        under |= (
            _rates(judged(aware), {"robust_who_knows": ATTACKED}, DEFENDED)
            if len(aware)
            else {}
        )
        told["defended"] = {name: rate.as_dict() for name, rate in under.items()}
    return told


def judged(rows: pl.DataFrame) -> pl.DataFrame:
    """The rows of views in which the clean object is named without a defence, with the
    block of their camera.
    """
    if rows.is_empty():
        return rows.with_columns(block=pl.lit("", pl.String))
    on = ["attack", "seed", "view"]
    control = rows.filter(
        pl.col("splat") == CLEAN,
        pl.col("condition") != DEFENDED,
        pl.col("original_score") >= REPORTED,
    )
    block = pl.concat_str(
        pl.col("original"),
        blocks_of("azimuth", "elevation").cast(pl.String),
        separator=" ",
    )
    return rows.join(
        control.select(on).unique(), on=on, maintain_order="left"
    ).with_columns(block=block)


def _rates(
    rows: pl.DataFrame, wanted: Mapping[str, str], condition: str = ""
) -> dict[str, Rate]:
    """How often the object is still named on splats, with the interval of blocks of
    cameras and of seeds.
    """
    if condition:
        under = pl.col("condition") == DEFENDED
    else:
        under = pl.col("condition") != DEFENDED
    measures = {
        name: Measure(
            holds=pl.col("original_score") >= REPORTED,
            given=under & (pl.col("splat") == splat),
        )
        for name, splat in wanted.items()
    }
    none = {name: Rate(successes=0, total=0) for name in wanted}
    if rows.is_empty():
        return none
    return count(rows, measures, clusters=("block", "seed"))[()]


def table_of(rows: Sequence[Record]) -> Table:
    """A table of rows, the highest score first; those without one are below, and have
    no rank.
    """
    ranked = sorted(
        (row for row in rows if row["score"]), key=lambda row: -row["score"]["mean"]
    )
    others = sorted(
        (row for row in rows if not row["score"]),
        key=lambda row: str(row["detector"]["name"]),
    )
    lines = [
        *((str(number + 1), row) for number, row in enumerate(ranked)),
        *(("-", row) for row in others),
    ]
    heads: dict[str, Any] = {
        "rank": lambda line: line[0],
        "detector": lambda line: line[1]["detector"]["name"],
    }
    heads["score"] = lambda line: _score_words(line[1]["score"])
    for column, head in HEADS.items():
        heads[head] = lambda line, column=column: _cell(line[1], column)
    heads["clean object named"] = lambda line: pooled(
        line[1]["columns"][name]["named_clean"] for name in COLUMNS
    ).short()
    heads["warnings"] = lambda line: " ".join(line[1]["warnings"]) or "-"
    heads["CPU minutes"] = lambda line: f"{line[1]['cpu_seconds']['all'] / 60:.1f}"
    return Table.of("Robustness", heads, lines)


def _score_words(score: Record | None) -> str:
    if score is None:
        return "-"
    return (
        f"{score['mean']:.2f} ({score['interval'][0]:.2f} to"
        f" {score['interval'][1]:.2f})"
    )


def _rate(rate: Record | None) -> str:
    if rate is None:
        return "-"
    return Rate.of(rate).short(interval=True)


def _cell(row: Record, column: str) -> str:
    counted = row["columns"][column]
    if counted["robust"] is not None:
        return _rate(counted["robust"])
    if column in row["missing"]:
        return "not filled"
    return f"cannot judge ({counted['judged']} views)"
