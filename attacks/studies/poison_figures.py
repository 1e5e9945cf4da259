"""What a study of poison says: what victims pay, how true their splats are, and what
classifiers make of them.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import polars as pl

from attacks.observe.rates import Measure, count
from attacks.observe.rows import CLEAN, FIDELITY, ROWS
from attacks.tables import Column, Table

Record = Mapping[str, Any]

COSTS = (
    "gaussians",
    "cpu_seconds",
    "seconds",
    "peak_megabytes",
    "gpu_megabytes",
    "milliseconds",
)
"""What a victim pays, of which the poisoned one's is divided by the clean one's."""


def figures(record: Record, tables: Mapping[str, pl.DataFrame]) -> dict[str, Any]:
    """Every figure of a study: for each value how many times the costs are, and how
    true its splats are.
    """
    truth = tables[FIDELITY].with_columns(defended=pl.col("condition").is_not_null())
    means = truth.group_by("attack", "seed", "splat", "defended").agg(
        pl.col("psnr").mean(), pl.col("ssim").mean()
    )
    quality = {
        tuple(row[:4]): {"psnr": row[4], "ssim": row[5]} for row in means.iter_rows()
    }
    groups: dict[tuple[str, str], dict[tuple[int, str, bool], dict[str, Any]]] = {}
    for victim in record["victims"]:
        title = f"{victim['part']}: {victim['value']}"
        key = (victim["seed"], victim["splat"], victim["defended"])
        of_value = groups.setdefault((victim["part"], victim["value"]), {})
        of_value[key] = {**victim, **quality.get((title, *key), {})}
    values = [_value(part, value, victims) for (part, value), victims in groups.items()]
    empty: dict[str, Any] = {
        key: [] for key in ("classified", "pooled", "detected", "detected_pooled")
    }
    told = {"values": values, **empty}
    if ROWS not in tables:
        return told
    parts = {f"{value['part']}: {value['value']}": value["part"] for value in values}
    looked = tables[ROWS].with_columns(part=pl.col("attack").replace_strict(parts))
    detects = pl.col("detector").is_in([*record.get("detectors", ())])
    for rows, each, pooled in (
        (looked.filter(~detects), "classified", "pooled"),
        (looked.filter(detects), "detected", "detected_pooled"),
    ):
        told[each] = _seen(rows, "attack")
        if len(set(parts.values())) < len(parts):
            told[pooled] = _seen(rows, "part", clusters=("attack",))
    return told


def _seen(
    rows: pl.DataFrame, which: str, clusters: Sequence[str] | None = None
) -> list[dict[str, Any]]:
    """For each value, or part, how often the object is named rightly, or found, and how
    confidently.
    """
    by = (which, "detector", "splat", "condition")
    rates = count(
        rows, {"right": Measure(holds=~pl.col("success"))}, by, clusters=clusters
    )
    means = rows.group_by(by).agg(pl.col("original_score").mean())
    confidence = {row[:-1]: row[-1] for row in means.iter_rows()}
    return [
        {
            **dict(zip(by, key, strict=True)),
            "right": told["right"].as_dict(),
            "confidence": confidence[key],
        }
        for key, told in rates.items()
    ]


def _value(
    part: str, value: str, victims: Mapping[tuple[int, str, bool], Record]
) -> dict[str, Any]:
    """The figures of one value over its seeds, of each splat that it has."""
    seeds = sorted({seed for seed, _, _ in victims})
    told: dict[str, Any] = {"part": part, "value": value, "seeds": seeds, "splats": {}}
    for splat, defended in sorted(
        {(splat, defended) for _, splat, defended in victims}
    ):
        mine = {
            seed: victims[seed, splat, defended]
            for seed in seeds
            if (seed, splat, defended) in victims
        }
        clean = {
            seed: victims[seed, CLEAN, False]
            for seed in mine
            if (seed, CLEAN, False) in victims
        }
        name = f"{splat}, defended" if defended else splat
        told["splats"][name] = {
            "gaussians": _spread([run["gaussians"] for run in mine.values()]),
            "psnr": _spread([run.get("psnr") for run in mine.values()]),
            "ssim": _spread([run.get("ssim") for run in mine.values()]),
            "times": {
                cost: _spread(
                    [
                        _ratio(run.get(cost), clean.get(seed, {}).get(cost))
                        for seed, run in mine.items()
                    ]
                )
                for cost in COSTS
            },
        }
    return told


def _ratio(value: float | None, clean: float | None) -> float | None:
    if value is not None and clean:
        return value / clean
    return None


def _spread(values: Sequence[float | None]) -> dict[str, Any] | None:
    """Mean, least and most over the seeds, and the 95 % interval of the mean (Student's
    t) from two seeds on.
    """
    known = [value for value in values if value is not None]
    if not known:
        return None
    mean = statistics.fmean(known)
    interval = None
    if len(known) > 1:
        from scipy.special import stdtrit

        half = (
            float(stdtrit(len(known) - 1, 0.975))
            * statistics.stdev(known)
            / math.sqrt(len(known))
        )
        interval = [mean - half, mean + half]
    return {
        "mean": mean,
        "least": min(known),
        "most": max(known),
        "interval": interval,
        "count": len(known),
    }


def summary_tables(record: Record) -> Iterator[Table]:
    """For each part a table of costs, and one of what the splats are worth."""
    parts: dict[str, list[Record]] = {}
    for value in record["values"]:
        parts.setdefault(value["part"], []).append(value)
    for part, values in parts.items():
        title = part.replace("_", " ")
        lines = [
            {
                "value": value["value"],
                "splat": name,
                "seeds": len(value["seeds"]),
                **splat,
                **splat["times"],
            }
            | {"count": splat["gaussians"], "times": splat["times"]["gaussians"]}
            for value in values
            for name, splat in value["splats"].items()
        ]
        yield Table.of(f"{title[0].upper()}{title[1:]}", _COLUMNS, lines)
    for which, caption, key, columns in (
        (
            "part",
            "All values together; in intervals they are drawn anew",
            "pooled",
            _NAMED,
        ),
        ("attack", "How often the object is named rightly", "classified", _NAMED),
        ("part", "Detectors, all values together", "detected_pooled", _RIGHT),
        ("attack", "How often the object is found as what it is", "detected", _RIGHT),
    ):
        if record.get(key):
            yield Table.of(caption, {"what": which, **columns}, record[key])


def _number(key: str, digits: int) -> Column[Any]:
    """The mean over seeds and, of several, its ends."""

    def text(line: Record) -> str:
        spread = line.get(key)
        if spread is None:
            return "-"
        mean = f"{spread['mean']:,.{digits}f}"
        ends = [f"{spread[end]:,.{digits}f}" for end in ("least", "most")]
        if spread["count"] == 1:
            return mean
        return f"{mean} ({ends[0]} to {ends[1]})"

    return text


_SHOWN: dict[str, Column[Any]] = {"splat": "splat", "seen": "condition"}
_CONFIDENT: dict[str, Column[Any]] = {
    "confidence in the true class": lambda line: f"{line['confidence']:.2f}"
}
_NAMED: dict[str, Column[Any]] = {
    "classifier": "detector",
    **_SHOWN,
    "top-1 right": "right",
    **_CONFIDENT,
}
_RIGHT: dict[str, Column[Any]] = {
    "detector": "detector",
    **_SHOWN,
    "found": "right",
    **_CONFIDENT,
}
_COLUMNS: dict[str, Column[Any]] = {
    "value": "value",
    "splat": "splat",
    "seeds": "seeds",
    "Gaussians": _number("count", 0),
    "times the clean splat's": _number("times", 2),
    "memory": _number("peak_megabytes", 2),
    "time of a picture": _number("milliseconds", 2),
    "PSNR, held out, dB": _number("psnr", 2),
}
