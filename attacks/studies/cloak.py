"""Studies of CLOAK with one thing changed at a time: how much of the attack hangs on it, as tables and plots.

The settings of `study = "cloak"` are those of a file that `mi-splat cloak` reads; `base` names such a file, and what
the study says comes in the place of what stands there. Every point is done with all of its seeds. An axis is a chart:

    study = "cloak"
    base = "scenes/cloak_car_stealthy_short.toml"

    [[case]]
    name = "cleaning"
    [case.matrix]
    cleaning = ["none", { name = "SH degree 1", cleaning = { sh_degree = 1 } }]
    "attack.overhead.emphasis" = [1.0, 3.0]
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from attacks.cloak.config import StudyConfig
from attacks.cloak.plots import new_axes, save_figure
from attacks.cloak.rates import spread_of
from attacks.cloak.steps import StudySteps
from attacks.cloak.study import check_disk, check_study, detectors_of, forecast, observed
from attacks.detectors.base import Detector
from attacks.observe.rows import SUFFIX, write_rows
from attacks.studies.study_file import Point, Search, Settings, Study, merged, with_none
from attacks.tables import cell
from attacks.tables import markdown as markdown_table
from mi_splat import provenance
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import decode
from mi_splat.io.documents import save_json, save_text
from mi_splat.io.folders import RECORD
from mi_splat.io.parsing import DocumentReader
from mi_splat.ledger import Done, Job
from mi_splat.ledger.plans import Plan, Result, grid

STORY, STUDY_FILE, TABLE = "cloak-study", "study.toml", "table.md"
_OWN_NAME = "the study"
"""What a value is called in a study in which nothing varies."""

RATES = {
    "control_recall": "control found",
    "trigger_miss_rate": "cloaked missed",
    "nothing_reported": "nothing of any class reported",
    "benign_recall": "cloaked found elsewhere",
    "target_rate": "target class",
}
"""Rates of a summary that a table has, and their heads."""
_COSTS = (
    *("seeds", "transition, degrees", "clean far from the triggers, dB", "dB lost there"),
    *("dB lost beside the object", "stealthy", "Gaussians, clean", "Gaussians, cloaked"),
)


MANY = 7
"""Values of a variation: with more of them there is room for their names alone."""
_VARIED = (
    ("trigger_miss_rate", "missed inside", "#d62728"),
    ("nothing_reported", "nothing of any class reported inside", "#9467bd"),
    ("benign_recall", "found elsewhere", "#1f77b4"),
    ("target_rate", "target class reported", "#2ca02c"),
)
"""What is drawn over the values of a variation."""


def tables(groups: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """Markdown: for each group a table of rates, and one of what is lost.

    Rates are pooled over seeds, as a summary has them: a row for each value and detector. Losses, and the numbers of
    Gaussians, are means over the seeds; the transition is that of all seeds together: a row for each value.

    Args:
        groups: By group and value, the summary of each study.
    """
    parts = []
    for group, results in groups.items():
        rates = [
            (name, detector, *(cell(one.get(key)) + spread_of(summary, detector, key) for key in RATES))
            for name, summary in results.items()
            for detector, one in summary["by_detector"].items()
        ]
        parts.append(markdown_table((group, "detector", *RATES.values()), rates))
        parts.append(
            markdown_table((group, *_COSTS), [(name, *costs_of(summary)) for name, summary in results.items()])
        )
    return "\n\n".join(parts) + "\n"


def costs_of(summary: Mapping[str, Any]) -> tuple[str, ...]:
    """What stands under `_COSTS` for one value."""
    price, counts = summary.get("stealth"), summary["gaussians"]
    return (
        str(len(summary["seeds"])),
        _number(summary["transition_degrees"], 1),
        _number(summary["benign_psnr"]["clean"], 2),
        _number(summary["benign_psnr_drop"], 2),
        _number(None if price is None else price["surroundings_psnr_drop"], 2),
        "-" if price is None else "yes" if price["stealthy"] else "no",
        *(f"{statistics.mean(counts[which]):,.0f}" for which in ("clean", "cloaked")),
    )


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


@dataclass(frozen=True, kw_only=True, eq=False)
class CloakPoint:
    """One study of CLOAK with its values.

    Attributes:
        part: Name of the case, or of what varies.
        value: What the varied settings are called.
        steps: Its jobs.
        detectors: Those that look.
    """

    part: str
    value: str
    steps: StudySteps
    detectors: Sequence[Detector]

    @property
    def title(self) -> str:
        """What rows call it."""
        return f"{self.part}: {self.value}"

    def jobs(self) -> dict[str, Job]:
        """Every job by its label."""
        return {f"{self.title} / {label}": job for label, job in self._labelled}

    def done(self, results: Mapping[str, Result]) -> dict[str, Done] | None:
        """Results of its jobs by their identity; None if one has failed."""
        ended = {job.identity: results.get(label) for label, job in self.jobs().items()}
        done = {identity: result for identity, result in ended.items() if isinstance(result, Done)}
        return done if len(done) == len(ended) else None

    def is_trained(self, store: Path) -> bool:
        """Whether all of its splats are in a store."""
        steps = replace(self.steps, folder=store)
        return all(steps.finished(steps.trained(*name)) is not None for name in steps.names())

    @cached_property
    def _labelled(self) -> list[tuple[str, Job]]:
        return [*self.steps.made(), *self.steps.looked(self.detectors)]


class CloakWork:
    """The jobs of a study.

    Attributes:
        study: The study.
        attempts: Every point.
        searches: None: a study of CLOAK has no single aim to bisect for.

    Raises:
        MiSplatError: A setting cannot be, or a detector cannot be loaded; before any job is done.
    """

    def __init__(self, study: Study) -> None:
        self.study, self.searches = study, list[Search]()
        self.attempts = [self._point(point) for point in study.points() if isinstance(point, Point)]
        if study.judge is not None or len(self.attempts) < len(list(study.points())):
            expected = "neither judge nor bisect: detectors stand under [evaluation]"
            raise InvalidValueError(message(study.name, expected, "one of them", "leave it out"))

    def _point(self, point: Point) -> CloakPoint:
        config = config_of(point.settings, self.study.name)
        detectors = detectors_of(config, {})
        check_study(config, detectors)
        value = ", ".join(map(str, point.labels.values())) or _OWN_NAME
        part = point.part or " and ".join(point.labels) or self.study.name
        steps = StudySteps(study=config, folder=Path("."))
        return CloakPoint(part=part, value=value, steps=steps, detectors=detectors)

    def jobs(self) -> dict[str, Job]:
        """Every job by its label."""
        return {label: job for point in self.attempts for label, job in point.jobs().items()}

    @property
    def size(self) -> int:
        """Number of different jobs."""
        return len({job.identity for job in self.jobs().values()})

    def plans(self) -> list[Plan]:
        """Plans for a driver of the ledger."""
        return [grid(self.jobs())]

    def check_room(self, store: Path) -> None:
        """Refuse a disk without room for all points whose splats are not there; a cleaning needs no more of it.

        Args:
            store: Folder of the ledger, which need not be there.

        Raises:
            InvalidValueError: The disk is too small.
        """
        missing = {
            replace(point.steps.study, cleaning=None): None for point in self.attempts if not point.is_trained(store)
        }
        check_disk(sum(forecast(study).megabytes for study in missing), store)

    def write(self, results: Mapping[str, Result], out: Path) -> list[Path]:
        """Write result.json, the tables of rows, study.toml, table.md and a plot for each part.

        Args:
            results: Of the jobs, by their labels.
            out: The folder, which is there.

        Returns:
            The files.
        """
        points, tables = dict[str, dict[str, Any]](), dict[str, list[pl.DataFrame]]()
        for point in self.attempts:
            done = point.done(results)
            if done is not None:
                points[point.title], of_point = _seen(point, done)
                for name, table in of_point.items():
                    tables.setdefault(name, []).append(table.with_columns(attack=pl.lit(point.title)))
        paths = [
            write_rows(pl.concat(parts, how="diagonal"), out / f"{name}{SUFFIX}") for name, parts in tables.items()
        ]
        named = {"study": self.study.kind, "name": self.study.name, "question": self.study.question}
        record = {"story": STORY, **named, "points": points, **provenance.origin()}
        groups = by_part(record)
        for part, values in groups.items():
            paths.append(out / f"{part.replace('/', '_')}.png")
            write_variation(part, values, paths[-1])
        save_text(markdown(record), out / TABLE)
        save_text(self.study.text, out / STUDY_FILE)
        save_json(record, out / RECORD)
        return [*paths, *(out / name for name in (TABLE, STUDY_FILE, RECORD))]


def config_of(settings: Settings, name: str) -> StudyConfig:
    """The study of CLOAK of a point.

    Args:
        settings: As the file has them; "none" stands for None.
        name: Of the study.

    Raises:
        InvalidValueError: The base is no study, or a setting is unknown or cannot be.
    """
    values = {key: value for key, value in settings.items() if key != "base"}
    if "base" in settings:
        path = Path(str(settings["base"]))
        if not path.is_file():
            raise InvalidValueError(message(f"base of {name}", "a TOML file", f"no file {path}", "check the path"))
        values = merged(DocumentReader(expected="a TOML file", do="correct it").read_toml(path), values)
    return decode(StudyConfig, {**with_none(values), "name": name}, name)


def _seen(point: CloakPoint, done: Mapping[str, Done]) -> tuple[dict[str, Any], dict[str, pl.DataFrame]]:
    """What was found at a point, as JSON can hold it, and its tables."""
    steps = replace(point.steps, results=done)
    entry, tables = observed(steps, steps.splats(), point.detectors)
    return {"part": point.part, "value": point.value, **entry}, tables


def by_part(record: Mapping[str, Any]) -> dict[str, dict[str, Mapping[str, Any]]]:
    """What was found, by part and value.

    Args:
        record: result.json.
    """
    groups: dict[str, dict[str, Mapping[str, Any]]] = {}
    for point in record["points"].values():
        groups.setdefault(point["part"], {})[point["value"]] = point
    return groups


def markdown(record: Mapping[str, Any]) -> str:
    """The tables of a study, see `tables`.

    Args:
        record: result.json.
    """
    return tables(by_part(record))


def write_variation(group: str, results: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Write a plot of rates, with their intervals, over the values of what was varied.

    Args:
        group: What was varied.
        results: For each value, the summary of its study.
        path: A PNG.

    Raises:
        InvalidValueError: matplotlib is not installed.
        SplatFileError: The file cannot be written.
    """
    detectors = list(next(iter(results.values()))["by_detector"])
    figure, axes = new_axes(len(detectors))
    many = len(results) > MANY
    ticks = list(results) if many else [_tick(name, summary) for name, summary in results.items()]
    turned = {"rotation": 45, "ha": "right", "rotation_mode": "anchor"} if many else {}
    for axis, detector in zip(axes, detectors, strict=True):
        for shift, (key, words, colour) in zip((-0.12, -0.04, 0.04, 0.12), _VARIED, strict=True):
            rates = [summary["by_detector"][detector].get(key) for summary in results.values()]
            shown = [(place + shift, rate) for place, rate in enumerate(rates) if rate is not None and rate["total"]]
            fractions = np.array([rate["rate"] for _, rate in shown])
            low, high = np.array([rate["interval"] for _, rate in shown]).reshape(-1, 2).T
            bars = np.maximum([fractions - low, high - fractions], 0.0)
            style = {"marker": "o", "markersize": 4, "capsize": 2, "linestyle": "none"}
            axis.errorbar([place for place, _ in shown], fractions, yerr=bars, color=colour, label=words, **style)
        axis.set(title=f"{detector}, by {group}", ylabel="fraction of cameras", ylim=(-0.03, 1.03))
        axis.set_xticks(range(len(ticks)), ticks, **turned)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    save_figure(figure, path)


def _tick(name: str, summary: Mapping[str, Any]) -> str:
    """What stands below a value: its name, the transition, and what is lost beside the object."""
    band, price = summary["transition_degrees"], summary.get("stealth")
    parts = [name] if band is None else [name, f"band {band:.0f} deg"]
    return "\n".join(parts if price is None else [*parts, f"{price['surroundings_psnr_drop']:.1f} dB beside"])
