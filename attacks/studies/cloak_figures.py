"""The figures of studies of CLOAK, and their tables: how much of the attack depends on
what is varied.
"""

import statistics
from collections.abc import Iterator, Mapping
from typing import Any

import polars as pl

from attacks.cloak import recorded
from attacks.cloak.config import StudyConfig
from attacks.cloak.figures import OBJECTS, OBJECTS_IN_REGION, over_objects
from attacks.cloak.tables import NAMES, RULE, region_of, spread_of
from attacks.figures.frame import Figures, Number
from attacks.figures.tables import (
    Column,
    Group,
    Table,
    cell,
    groups_of,
    label_at,
    number_at,
    rate_at,
)
from attacks.observe.rows import ATTACKED, CLEAN, ROWS

RATES = {
    "control_recall": "control found",
    "trigger_miss_rate": "cloaked missed",
    "nothing_reported": "nothing of any class reported",
    "benign_recall": "cloaked found elsewhere",
    "target_rate": "target class",
}
"""Rates that a table has, and their heads."""
_OVER_OBJECTS = {**RATES, "trigger_miss_rate_all": "cloaked missed, all inside"}


def figures(record: Mapping[str, Any], tables: Mapping[str, pl.DataFrame]) -> Figures:
    """Every figure of each point, and of each part that is one attack on several
    objects.
    """
    parts = []
    studies: dict[str, dict[str, StudyConfig]] = {}
    for title, point in record["points"].items():
        of_point = {
            name: table.filter(attack=title).drop("attack")
            for name, table in tables.items()
        }
        part = point["part"]
        counted = recorded.figures(point, of_point)
        parts.append(counted.labelled(part=part, setting=point["value"]))
        studies.setdefault(part, {})[title] = recorded.study_of(point)
    for part, of_part in studies.items():
        parts.append(over_objects(of_part, tables[ROWS]).labelled(part=part))
    return Figures.together(parts)


def tables(figures: Figures) -> Iterator[Table]:
    """For each part its rates, what is lost, and what is seen under other conditions.

    Rates are pooled over seeds. Losses, and the numbers of Gaussians, are means over
    the seeds; the transition is that of all seeds together.
    """
    for (part,), of_part in figures.groups("part").items():
        title = part.replace("_", " ")
        yield from _over_objects(title, of_part)
        values = groups_of(of_part.where(scope=None, trigger=None), "setting")
        rates: list[Group] = []
        for labels, of_value in values:
            usual = of_value.where(condition=None)
            rates += [
                ({**labels, "detector": detector}, usual)
                for detector in usual.labels("detector")
            ]
        first = {title: label_at("setting")}
        columns: dict[str, Column[Group]] = {
            head: _with_spread(measure) for measure, head in RATES.items()
        }
        detector = {"detector": label_at("detector")}
        yield Table.of(f"By {title}", {**first, **detector, **columns}, rates)
        yield Table.of(f"By {title}: what is lost", {**first, **_COSTS}, values)
        conditions = groups_of(
            of_part.where(scope=None, trigger=None), "setting", "condition", "detector"
        )
        under = [line for line in conditions if line[0]["condition"] is not None]
        if under:
            caption = f"By {title}: under other conditions"
            yield Table.of(caption, {**first, **_UNDER_CONDITIONS}, under).filled


def _with_spread(measure: str) -> Column[Group]:
    def text(group: Group) -> str:
        labels, figures = group
        rate = figures.find(measure, detector=labels["detector"])
        return cell(rate) + spread_of(figures, measure, labels["detector"])

    return text


def _over_objects(title: str, figures: Figures) -> Iterator[Table]:
    """Rates over all objects of a part that is one attack on several of them."""
    together = figures.where(scope=OBJECTS)
    objects = together.value("objects")
    if objects is None:
        return
    rates = {head: rate_at(measure) for measure, head in _OVER_OBJECTS.items()}
    detector = {"detector": label_at("detector")}
    caption = f"{title[0].upper()}{title[1:]}: {objects:.0f} objects together"
    caption = f"{caption}; intervals have objects drawn anew"
    lines = groups_of(together, "detector")
    lines = [line for line in lines if line[0]["detector"] is not None]
    yield Table.of(caption, {**detector, **rates}, lines)
    own = figures.where(scope=OBJECTS_IN_REGION)
    region: dict[str, Column[Group]] = {
        "its region": lambda line: region_of(own, line[0]["detector"])
    }
    caption = f"{caption}; each detector in its own region: {RULE}"
    yield Table.of(caption, {**detector, **region, **rates}, groups_of(own, "detector"))


def _sizes(splat: str) -> Column[Group]:
    def text(group: Group) -> str:
        sizes = group[1].where(measure="gaussians", splat=splat)
        return f"{statistics.mean(values_of(sizes)):,.0f}"

    return text


def values_of(figures: Figures) -> list[float]:
    """All numbers."""
    return [figure.value for _, figure in figures if isinstance(figure, Number)]


def _stealthy(group: Group) -> bool | None:
    stealthy = group[1].value("stealthy")
    if stealthy is None:
        return None
    return bool(stealthy)


_COSTS: dict[str, Column[Group]] = {
    "seeds": lambda group: len(group[1].labels("seed")),
    "transition, degrees": number_at("transition_degrees", ".1f"),
    "clean far from the triggers, dB": number_at("benign_psnr", splat=CLEAN),
    "dB lost there": number_at("benign_psnr_drop"),
    "dB lost around the object": number_at("surroundings_psnr_drop"),
    "dB lost on the object just outside a trigger": number_at("object_psnr_drop"),
    "stealthy": _stealthy,
    "Gaussians, clean": _sizes(CLEAN),
    "Gaussians, cloaked": _sizes(ATTACKED),
}
_UNDER_CONDITIONS: dict[str, Column[Group]] = {
    "condition": label_at("condition"),
    "detector": label_at("detector"),
    **{
        f"{NAMES[splat]} missed, well inside": rate_at("missed", splat=splat)
        for splat in NAMES
    },
    **{
        f"{NAMES[splat]} found, outside": rate_at("found", splat=splat)
        for splat in NAMES
    },
    "target class on the cloaked splat": rate_at("target_rate"),
    "target class on the clean splat": rate_at("control_target_rate"),
    **{
        f"PSNR, dB: {NAMES[splat]}, {where}": number_at(measure, ".1f", splat=splat)
        for splat in reversed(NAMES)
        for measure, where in (
            ("psnr_missed", "well inside"),
            ("psnr_found", "outside"),
        )
    },
}
