"""The figures of a study of poison: what victims pay, how true their splats are, and
what classifiers and detectors make of them; and their tables.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import polars as pl

from attacks.figures.frame import MEASURE, Figures, Labels, Number
from attacks.figures.rate import number
from attacks.figures.tables import (
    Column,
    Group,
    Table,
    groups_of,
    label_at,
    number_at,
    rate_at,
)
from attacks.observe.rates import Measure, count
from attacks.observe.rows import CLEAN, FIDELITY, ROWS

COSTS = (
    "gaussians",
    "cpu_seconds",
    "seconds",
    "peak_megabytes",
    "gpu_megabytes",
    "milliseconds",
)
"""What a victim pays, of which the poisoned one's is divided by the clean one's."""
NAMED = "named"
FOUND = "found"
"""Measures: a classifier names the object rightly, a detector finds it."""

_Victims = Mapping[tuple[int, str, bool], Mapping[str, Any]]
"""What victims have paid, by seed, splat, and whether they defended themselves."""


def figures(record: Mapping[str, Any], tables: Mapping[str, pl.DataFrame]) -> Figures:
    """Every figure of a study: for each value how many times the costs are, and how
    true its splats are.
    """
    truth = tables[FIDELITY].with_columns(defended=pl.col("condition").is_not_null())
    runs = truth.group_by("attack", "seed", "splat", "defended")
    means = runs.agg(pl.col("psnr").mean(), pl.col("ssim").mean())
    quality = {row[:4]: {"psnr": row[4], "ssim": row[5]} for row in means.iter_rows()}
    groups: dict[tuple[str, str], dict[tuple[int, str, bool], dict[str, Any]]] = {}
    for victim in record["victims"]:
        group = (victim["part"], victim["value"])
        key = (victim["seed"], victim["splat"], victim["defended"])
        true = quality.get((": ".join(group), *key), {})
        groups.setdefault(group, {})[key] = {**victim, **true}
    parts = []
    for (part, value), victims in groups.items():
        of_value = Figures.of(_of_value(victims))
        parts.append(of_value.labelled(part=part, setting=value))
    if ROWS in tables:
        named = {": ".join(group): group for group in groups}
        detectors = record.get("detectors", ())
        parts += _seen(tables[ROWS], named, [*detectors])
    return Figures.together(parts)


def _seen(
    rows: pl.DataFrame,
    values: Mapping[str, tuple[str, str]],
    detectors: Sequence[str],
) -> Iterator[Figures]:
    """How often the object is named rightly, or found, and how confidently: for each
    value, and for each part with its values drawn anew.
    """
    part = {title: part for title, (part, _) in values.items()}
    setting = {title: value for title, (_, value) in values.items()}
    rows = rows.with_columns(
        part=pl.col("attack").replace_strict(part),
        setting=pl.col("attack").replace_strict(setting),
    )
    right = Measure(holds=~pl.col("success"))
    detects = pl.col("detector").is_in(detectors)
    seen = ["part", "detector", "splat", "condition"]
    ways: list[tuple[list[str], list[str] | None]] = [(["setting", *seen], None)]
    if len(set(part.values())) < len(part):
        ways.append((seen, ["attack"]))
    for measure, looked in (
        (NAMED, rows.filter(~detects)),
        (FOUND, rows.filter(detects)),
    ):
        for by, clusters in ways:
            yield count(looked, {measure: right}, by, clusters=clusters)
            means = looked.group_by(by, maintain_order=True)
            yield Figures.of(
                ({MEASURE: "confidence", **dict(zip(by, key, strict=True))}, mean)
                for *key, mean in means.agg(pl.col("original_score").mean()).iter_rows()
            )


def _of_value(victims: _Victims) -> Iterator[tuple[Labels, Number | float | None]]:
    """The figures of one value over its seeds, of each splat that it has."""
    seeds = sorted({seed for seed, _, _ in victims})
    yield {MEASURE: "seeds"}, len(seeds)
    for splat, defended in sorted({key[1:] for key in victims}):
        runs = {}
        for seed in seeds:
            if (seed, splat, defended) in victims:
                runs[seed] = victims[seed, splat, defended]
        name = f"{splat}, defended" if defended else splat
        for measure in ("gaussians", "psnr", "ssim"):
            spread = _spread([run.get(measure) for run in runs.values()])
            yield {MEASURE: measure, "splat": name}, spread
        for cost in COSTS:
            ratios = []
            for seed, run in runs.items():
                clean = victims.get((seed, CLEAN, False), {}).get(cost)
                paid = run.get(cost)
                ratios.append(paid / clean if paid is not None and clean else None)
            yield {MEASURE: f"{cost}_ratio", "splat": name}, _spread(ratios)


def _spread(values: Sequence[float | None]) -> Number | None:
    """The mean and the range over the seeds, and the 95 % interval of the mean
    (Student's t) from two seeds on.
    """
    known = [value for value in values if value is not None]
    if not known:
        return None
    mean = statistics.fmean(known)
    half = None
    if len(known) > 1:
        from scipy.special import stdtrit

        quantile = float(stdtrit(len(known) - 1, 0.975))
        half = quantile * statistics.stdev(known) / math.sqrt(len(known))
    return Number(
        value=mean,
        low=None if half is None else mean - half,
        high=None if half is None else mean + half,
        least=min(known),
        most=max(known),
        total=len(known),
    )


def tables(figures: Figures) -> Iterator[Table]:
    """For each part a table of costs, and tables of what is seen."""
    values = figures.where(detector=None)
    for (part,), of_part in values.groups("part").items():
        seeds = {
            value: one.value("seeds")
            for (value,), one in of_part.groups("setting").items()
        }
        lines = [
            ({**labels, "seeds": seeds[labels["setting"]]}, one)
            for labels, one in groups_of(of_part, "setting", "splat")
            if labels["splat"] is not None
        ]
        title = part.replace("_", " ")
        yield Table.of(f"{title[0].upper()}{title[1:]}", _COLUMNS, lines)
    for measure, together, each in (
        (
            NAMED,
            "All values together; in intervals they are drawn anew",
            "How often the object is named rightly",
        ),
        (
            FOUND,
            "Detectors, all values together",
            "How often the object is found as what it is",
        ),
    ):
        seen = groups_of(figures, "part", "setting", "detector", "splat", "condition")
        seen = [group for group in seen if group[1].find(measure) is not None]
        pooled = [group for group in seen if group[0]["setting"] is None]
        single = [group for group in seen if group[0]["setting"] is not None]
        columns = {"what": _value_of, **_seen_columns(measure)}
        if pooled:
            yield Table.of(together, columns, pooled)
        if single:
            yield Table.of(each, columns, single)


def _value_of(group: Group) -> str:
    labels, _ = group
    part = str(labels["part"])
    if labels["setting"] is None:
        return part
    return f"{part}: {labels['setting']}"


def _seen_columns(measure: str) -> dict[str, Column[Group]]:
    who, right = {
        NAMED: ("classifier", "top-1 right"),
        FOUND: ("detector", "found"),
    }[measure]
    return {
        who: label_at("detector"),
        "splat": label_at("splat"),
        "seen": label_at("condition"),
        right: rate_at(measure),
        "confidence in the true class": number_at("confidence"),
    }


def _spread_at(measure: str, form: str) -> Column[Group]:
    """The mean over seeds and, of several, its ends."""

    def text(group: Group) -> str | None:
        spread = group[1].find(measure)
        if not isinstance(spread, Number):
            return None
        mean = number(spread.value, form)
        if spread.total == 1:
            return mean
        return f"{mean} ({number(spread.least, form)} to {number(spread.most, form)})"

    return text


_COLUMNS: dict[str, Column[Group]] = {
    "value": label_at("setting"),
    "splat": label_at("splat"),
    "seeds": label_at("seeds"),
    "Gaussians": _spread_at("gaussians", ",.0f"),
    "times the clean splat's": _spread_at("gaussians_ratio", ",.2f"),
    "memory": _spread_at("peak_megabytes_ratio", ",.2f"),
    "time of an image": _spread_at("milliseconds_ratio", ",.2f"),
    "PSNR, held out, dB": _spread_at("psnr", ",.2f"),
}
