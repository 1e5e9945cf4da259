"""What studies of CLOAK leave behind, with one thing varied at a time."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from attacks.cloak.figures import OBJECTS
from attacks.figures.frame import Figures
from attacks.figures.rate import FEW, Rate, spread
from attacks.figures.result import Result
from attacks.report.kinds.cloak import headline_of
from attacks.report.section import (
    Chart,
    Figure,
    Line,
    Role,
    Section,
    capital,
    listed,
    shared,
)
from attacks.studies.cloak_figures import tables
from mi_splat.errors import counted

_LINES: tuple[tuple[str, str, Role], ...] = (
    ("trigger_miss_rate", "cloaked missed, well inside", "attack"),
    ("nothing_reported", "nothing of any class reported, well inside", "attack"),
    ("benign_recall", "cloaked found, elsewhere", "control"),
    ("target_rate", "target class reported", "other"),
)

_Points = Mapping[tuple[str, str], Figures]
"""Figures by part and value."""


def read_study(result: Result) -> Section:
    """The section of a study with one thing varied at a time."""
    record = result.record
    stated = list(record["points"].values())
    every = result.figures.groups("part", "setting")
    points = {key: figures for key, figures in every.items() if key[1] is not None}
    headlines = [headline_of(figures) for figures in points.values()]
    rates = _counted(headline for headline, _ in headlines)
    controls = _counted(control for _, control in headlines)
    label = headlines[0][0].label
    seeds = sorted({len(point["seeds"]) for point in stated})
    many = dict.fromkeys((str(seeds[0]), str(seeds[-1])))
    return Section(
        kind="CLOAK, one thing varied at a time",
        title=f"{record['name']}, varied" if len(points) > 1 else str(record["name"]),
        done=_variations(record["name"], points),
        conclusion=(
            f"{capital(label)}, over all values: {spread(rates)}. Compare values within"
            " one chart; where intervals overlap, the study cannot tell them"
            f" apart.{_conditions(result.figures)}{_over_objects(result.figures)}"
        ),
        headline=Figure(
            label=f"{label}, lowest to highest", words=spread(rates, intervals=False)
        ),
        control=Figure(
            label="clean splats, the same", words=spread(controls, intervals=False)
        ),
        figures=Figure.each(
            {"studies": str(len(points)), "seeds of each": " to ".join(many)}
        ),
        warnings=tuple(_warnings(points, rates, seeds[0])),
        charts=tuple(_charts(result.figures)),
        tables=tuple(tables(result.figures)),
        configuration=shared(
            [{**point["study"], "weights": point["detectors"]} for point in stated]
        ),
    )


def _counted(figures: Iterator[Figure | None]) -> list[Rate]:
    """The rates of those figures that count something."""
    rates = [figure.rate for figure in figures if figure is not None]
    return [rate for rate in rates if rate is not None and rate.total]


def _warnings(
    points: _Points, rates: Sequence[Rate], fewest_seeds: int
) -> Iterator[str]:
    """Reasons to look twice at a study of several points."""
    if fewest_seeds == 1:
        yield "Variations were done with one seed: small differences may be chance"
    else:
        yield (
            "Intervals of one value have cameras and seeds drawn anew: they say nothing"
            " of another object"
        )
    loud = [
        f"{part.replace('_', ' ')} {value}"
        for (part, value), figures in points.items()
        if figures.value("stealthy") == 0
    ]
    if loud:
        yield (
            "Not stealthy, since images lose too much around the object:"
            f" {listed(loud)}"
        )
    few = min((rate.total for rate in rates), default=0)
    if few < FEW:
        yield f"The rate of some values counts few views: {few}"


def _variations(name: str, points: _Points) -> str:
    """What was done: what varied, and under which conditions the splats were looked at
    again.
    """
    text = f"The study {name} was done {counted(len(points), 'time')}"
    if len(points) > 1:
        parts = dict.fromkeys(part.replace("_", " ") for part, _ in points)
        varied = listed([*parts])
        text += f", each with one setting changed and the rest as it is: {varied}"
    conditions = Figures.together(points.values()).labels("condition")
    more = ""
    if conditions:
        many = counted(len(conditions), "other condition")
        more = f" Both splats were then evaluated under {many}."
    return f"{text}. Each has a clean splat as its control.{more}"


def _over_objects(figures: Figures) -> str:
    """A sentence for each part that is one attack on several objects: what holds of all
    of them together.
    """
    texts = []
    for over in figures.where(scope=OBJECTS).groups("part").values():
        objects = over.value("objects")
        missed = [
            f"{rate.words} ({name})"
            for name in over.labels("detector")
            if (rate := over.rate("trigger_miss_rate", detector=name)).total
        ]
        if missed:
            many = f"Over {objects:.0f} objects together it is missed"
            texts.append(f" {many} in {listed(missed)}.")
    return "".join(texts)


def _conditions(figures: Figures) -> str:
    """A sentence on what is seen under other conditions, if anything is."""
    seen = figures.where(measure="missed", splat="attacked")
    rates = [rate for _, rate in seen if isinstance(rate, Rate) and rate.total]
    if not rates:
        return ""
    under = listed(seen.labels("condition"))
    missed = f"it is missed well inside the trigger in {spread(rates)}"
    return f" Under {under} {missed}."


def _charts(figures: Figures) -> Iterator[Chart]:
    plain = figures.where(scope=None, trigger=None, condition=None, seed=None)
    for (part, detector), of_part in plain.groups("part", "detector").items():
        if detector is None:
            continue
        values: dict[str, Any] = {
            value: one for (value,), one in of_part.groups("setting").items()
        }
        lines = [
            Line.of(name, role, [one.rate(measure) for one in values.values()])
            for measure, name, role in _LINES
        ]
        title = part.replace("_", " ")
        yield Chart.bars(f"{title}, {detector}", (title, "views"), values, *lines)
