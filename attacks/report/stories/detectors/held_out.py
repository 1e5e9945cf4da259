"""What `mi-splat evaluate-detector` leaves behind: how well detectors find objects on held-out pictures."""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from attacks.detectors.catalogue import SMALL_CLASSES
from attacks.detectors.evaluation import CONDITIONS, WITH_OBJECTS
from attacks.detectors.training.config import EMPTY
from attacks.rate import Rate, percent
from attacks.report.section import Chart, Figure, Line, Section
from attacks.report.wording import listed, number, plural, pooled, settings
from attacks.tables import Table, cell

KIND = "detectors on held-out pictures"
FEW_OBJECTS = 20
"""Objects of a class from which on its average precision says something."""
_MOST_OTHERS = 8
_SETTINGS = ("confidence", "pictures", "data", "scenes")

Document = Mapping[str, Any]
"""The figures of one detector, with its name and the confidence from which a detection counts."""


def documents(record: Mapping[str, Any]) -> list[Document]:
    """The figures of each detector of a result.json."""
    shared = {"confidence": record["confidence"]}
    return [{"detector": name, **shared, **values} for name, values in record["detectors"].items()]


def read(folder: Path, record: Mapping[str, Any]) -> Section:
    """The section of an evaluation."""
    several = documents(record)
    names, confidence = listed([figures["detector"] for figures in several]), f"{record['confidence']:g}"
    first, *others = [name for name, part in several[0]["sets"].items() if "map" in part] or [""]
    rates = [_recall(figures, first) for figures in several]
    empty = [
        pooled([figures["false_positives"].get("without objects", {}).get("pictures_with")]) for figures in several
    ]
    sets = listed([f"{plural(part, 'picture')} ({name})" for name, part in record["sets"].items()])
    return Section(
        kind=KIND,
        title=f"{names} at {confidence}",
        done=(
            f"{names} looked at pictures that were not trained on: {sets}. A detection counts from a confidence of "
            f"{confidence} and an overlap of 0.5 with its object; the average precision takes all. "
            "Nothing was attacked."
        ),
        conclusion=(
            f"Found: {_range(rates)} of the objects ({first or 'none'}). Reported without any object: something in "
            f"{_range(empty)} of the pictures. This says nothing of photographs, or of objects of other kinds"
            f"{'; where intervals overlap, nothing says which detector is better' if len(several) > 1 else ''}."
        ),
        headline=_figure(f"objects that are found, {first or 'none'}", rates),
        control=_figure("pictures without any object in which something is reported", empty)
        if empty[0].total
        else None,
        attacked=False,
        figures=tuple(_figures(several, others)),
        warnings=tuple(_doubts(several[0], empty[0])),
        charts=tuple(_charts(several)),
        tables=tuple(tables(several)),
        configuration=settings(
            {
                **{name: record[name] for name in _SETTINGS if name in record},
                "weights": {figures["detector"]: figures["fingerprint"] for figures in several},
                "min_confidence": {figures["detector"]: figures["min_confidence"] for figures in several},
            }
        ),
    )


def tables(several: Sequence[Document]) -> Iterator[Table]:
    """All tables: of several detectors those that compare them, then those of each."""
    if len(several) > 1:
        yield from compared(several)
    for figures in several:
        yield from detailed(figures, of=f"{_name(figures)}: " if len(several) > 1 else "")


def compared(several: Sequence[Document]) -> Iterator[Table]:
    """Precision, false positives, and recall by elevation, a detector a row."""
    sets = [name for name in WITH_OBJECTS if any(name in figures["sets"] for figures in several)]
    rows = []
    for figures in several:
        totals, street = figures["false_positives"], figures["sets"].get(f"{EMPTY}street", {})
        wrong = (totals.get("with objects"), street.get("false_positives"), totals.get("without objects"))
        means = (number(figures["sets"].get(name, {}).get("map"), ".3f") for name in sets)
        rows.append((_name(figures), *means, *map(_per_picture, wrong)))
    heads = ("with objects", "of streets without", "without any")
    head = ("detector", *(f"mAP, {name}" for name in sets), *(f"false positives, pictures {which}" for which in heads))
    yield Table(caption="Precision, and false positives per picture", head=head, rows=tuple(rows))
    for title, group, members in (
        *((f"objects, {name}", "all", (name,)) for name in sets),
        (f"cars, {listed(sets)}", "car", sets),
    ):
        recalls = [(_name(figures), _recall_by(figures, members, "elevation", group)) for figures in several]
        lines = tuple((name, *map(cell, rates)) for name, rates in recalls if rates)
        if lines:
            caption = f"Found by elevation in degrees: {title}"
            yield Table(caption=caption, head=("detector", *bins_of("elevation")), rows=lines)


def detailed(figures: Document, of: str = "") -> Iterator[Table]:
    """The tables of one detector: by class, false positives, recall by how objects are seen, and other classes."""
    sets = figures["sets"]
    by_class = [
        (name, label, number(part["ap"][label], ".3f"), cell(rate), _often(part["reported_as"].get(label, {})))
        for name, part in sets.items()
        for label, rate in part.get("found", {}).items()
    ]
    if by_class:
        head = ("pictures", "objects", "average precision", "found", "else reported on them")
        yield Table(caption=f"{of}By class", head=head, rows=tuple(by_class))
    parts = {name: part["false_positives"] for name, part in sets.items()}
    parts |= {f"together, {name}": part for name, part in figures["false_positives"].items()}
    wrong = [
        (name, _per_picture(part), cell(part["pictures_with"]), _often(part["by_class"]))
        for name, part in parts.items()
    ]
    heads = ("pictures", "per picture (95 % Poisson interval)", "pictures with any", "by class")
    yield Table(caption=f"{of}False positives", head=heads, rows=tuple(wrong))
    seen = [name for name in sets if "found_by" in sets[name] and name in WITH_OBJECTS]
    for condition, (unit, _) in CONDITIONS.items():
        columns = {f"objects, {name}": _recall_by(figures, (name,), condition) for name in seen}
        columns = {**columns, "cars": _recall_by(figures, seen, condition, "car")}
        columns = {name: rates for name, rates in columns.items() if rates}
        if columns:
            rows = zip(bins_of(condition), *(map(cell, rates) for rates in columns.values()), strict=True)
            caption = f"{of}Found by {condition.replace('_', ' ')}, {unit}"
            yield Table(caption=caption, head=("seen", *columns), rows=tuple(rows))
    others = [(name, _often(part["other_classes"])) for name, part in sets.items() if part["other_classes"]]
    if others:
        caption = f"{of}Classes reported that no object here has, the most frequent"
        yield Table(caption=caption, head=("pictures", "classes"), rows=tuple(others))


def bins_of(condition: str) -> list[str]:
    """Names of the bins of a condition, for instance "0 to 15" and "6 or more"."""
    edges = pairwise(CONDITIONS[condition].edges)
    return [f"{low:g} or more" if math.isinf(high) else f"{low:g} to {high:g}" for low, high in edges]


def _name(figures: Document) -> str:
    known = len(SMALL_CLASSES) - len(figures.get("lacks", ()))
    of = "" if known == len(SMALL_CLASSES) else f", {known} of {len(SMALL_CLASSES)} classes"
    return f"{figures['detector']} at {figures['confidence']:g}{of}"


def _recall(figures: Document, name: str) -> Rate:
    """How many objects of a set are found."""
    return pooled(map(Rate.of, figures["sets"].get(name, {}).get("found", {}).values()))


def _recall_by(figures: Document, names: Sequence[str], condition: str, group: str = "all") -> list[Rate]:
    """Recall by the bins of a condition, of some sets together; empty where no set knows it."""
    sets = [figures["sets"].get(name, {}).get("found_by", {}).get(condition, {}).get(group, ()) for name in names]
    return [pooled(map(Rate.of, parts)) for parts in zip(*filter(None, sets), strict=True)]


def _per_picture(part: Document | None) -> str:
    """False positives per picture with their count and 95 % Poisson interval."""
    if part is None:
        return "-"
    low, high = part["interval"]
    return f"{part['per_picture']:.2f} ({part['number']:,} in {part['pictures']:,}; {low:.2f} to {high:.2f})"


def _often(counts: Mapping[str, int]) -> str:
    """The most frequent labels with their counts."""
    often = sorted(counts.items(), key=lambda item: -item[1])[:_MOST_OTHERS]
    return ", ".join(f"{label} {count}" for label, count in often if count) or "-"


def _range(rates: Sequence[Rate]) -> str:
    if not all(rate.total for rate in rates):
        return "nothing counted"
    low, high = (percent(pick(rate.fraction for rate in rates)) for pick in (min, max))
    return low if low == high else f"{low} to {high}"


def _figure(label: str, rates: Sequence[Rate]) -> Figure:
    """The rate of one detector, or how far apart those of several are."""
    if len(rates) == 1:
        return Figure(label=label, rate=rates[0])
    return Figure(label=f"{label}, lowest to highest", words=_range(rates))


def _figures(several: Sequence[Document], others: Sequence[str]) -> Iterator[Figure]:
    for figures in several:
        of = f"{figures['detector']}: " if len(several) > 1 else ""
        for name in others:
            yield Figure(label=f"{of}objects that are found, {name}", rate=_recall(figures, name))
        for name, part in figures["sets"].items():
            if "map" in part:
                label = f"{of}mean average precision at an overlap of 0.5, {name}"
                yield Figure(label=label, words=f"{part['map']:.3f}")
        for which, part in figures["false_positives"].items():
            yield Figure(label=f"{of}false positives per picture, pictures {which}", words=_per_picture(part))


def _doubts(figures: Document, empty: Rate) -> Iterator[str]:
    if figures.get("lacks"):
        lacks = listed(figures["lacks"])
        yield f"{figures['detector']} knows no {lacks}: these objects count nowhere, but what it reports on them does"
    if not empty.total:
        yield "There are no pictures without objects, so nothing says how often a detector imagines one"
    for name, part in figures["sets"].items():
        few = [label for label, rate in part.get("found", {}).items() if rate["total"] < FEW_OBJECTS]
        if few:
            yield f"Few objects ({name}; {listed(few)}): fewer than {FEW_OBJECTS}, so their figures may be chance"


def _charts(several: Sequence[Document]) -> Iterator[Chart]:
    """Recall by each condition, a line for each set; of several detectors by elevation, a line for each of them."""
    sets = [name for name, part in several[0]["sets"].items() if "found_by" in part]
    if len(several) == 1:
        for condition in CONDITIONS:
            lines = {name: _recall_by(several[0], (name,), condition) for name in sets}
            yield from _chart(condition.replace("_", " "), condition, lines)
    else:
        for name in sets:
            lines = {figures["detector"]: _recall_by(figures, (name,), "elevation") for figures in several}
            yield from _chart(f"elevation, {name}", "elevation", lines)


def _chart(title: str, condition: str, rates: Mapping[str, Sequence[Rate]]) -> Iterator[Chart]:
    lines = tuple(Line.of(name, "other", values) for name, values in rates.items())
    if any(line.points for line in lines):
        yield Chart(
            title=f"Objects that are found, by {title}",
            caption="Bands are 95 % intervals; bins without objects are left out.",
            x_label=f"{condition.replace('_', ' ')}, {CONDITIONS[condition].unit}",
            y_label="objects",
            lines=lines,
            ticks=tuple(bins_of(condition)),
        )
