"""What `mi-splat evaluate-detector` leaves behind: how well a detector finds objects on held-out pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.rate import Rate
from attacks.report.section import Chart, Figure, Line, Section
from attacks.report.wording import listed, number, plural, pooled, settings
from attacks.tables import Table, cell

KIND = "a detector on held-out pictures"
BACKGROUND = "background: "
"""How the names of sets of pictures without objects begin."""
FEW_OBJECTS = 20
"""Objects of a class from which on its average precision says something."""
CONDITIONS = {
    "elevation": "elevation of the camera, degrees",
    "distance": "distance, diagonals of the object",
    "size": "longer side of the box, of the picture's",
    "brightness": "mean luma of the object's box",
    "sun_elevation": "elevation of the sun, degrees",
    "sun_strength": "irradiance of the sun",
}
"""How an object is seen, and the label of its axis."""

Document = Mapping[str, Any]


def read(path: Path, found: Document) -> Section:
    """The section of a detector.

    Args:
        path: The JSON file with its figures.
        found: What is in it.
    """
    sets = objects_of(found)
    hits = {name: hits_of(one) for name, one in sets.items()}
    first = next(iter(hits), None)
    rate = pooled(hits.values()) if first is None else hits[first]
    empty = false_of(found, "without objects")
    return Section(
        kind=KIND,
        title=f"{found['detector']} at {found['confidence']:g}",
        done=(
            f"{found['detector']} looked at pictures that it was not trained on: {_sets(found)}. A detection counts "
            f"from a confidence of {found['confidence']:g} and an overlap of 0.5 with its object; the average "
            f"precision takes all from {found['min_confidence']:g}. Nothing was attacked."
        ),
        conclusion=(
            f"It finds {rate.successes:,} of {plural(rate.total, 'object')}{f' ({first})' if first else ''}, and "
            f"reports something in {empty.successes:,} of {plural(empty.total, 'picture')} without any object. This "
            "says nothing of photographs, or of objects of other kinds."
        ),
        headline=Figure(label=f"objects that are found{f', {first}' if first else ''}", rate=rate),
        control=Figure(label="pictures without any object in which something is reported", rate=empty)
        if empty.total
        else None,
        attacked=False,
        figures=tuple(_figures(found, hits)),
        warnings=tuple(_doubts(sets, empty)),
        charts=tuple(_charts(sets)),
        tables=tuple(_tables(found, sets)),
        configuration=settings({name: found[name] for name in _SETTINGS if name in found}),
    )


_SETTINGS = ("detector", "fingerprint", "confidence", "min_confidence", "pictures", "data", "scenes")


def objects_of(found: Document) -> dict[str, Document]:
    """The sets with objects, by name; those of scenes that the user has named come last."""
    sets: dict[str, Document] = {name: one for name, one in found["sets"].items() if "map" in one}
    return sets


def hits_of(one: Document) -> Rate:
    """How many objects of a set are found."""
    counts, recall = one["counts"], one["recall"]
    return Rate(successes=sum(round(recall[label] * counts[label]) for label in counts), total=sum(counts.values()))


def false_of(found: Document, which: str) -> Rate:
    """Pictures with a false positive, of some sets together; of none where there are no such sets."""
    one = found["false_positives"].get(which)
    return Rate(successes=0, total=0) if one is None else Rate(successes=one["pictures_with"], total=one["pictures"])


def false_words(one: Document) -> str:
    """False positives per picture with their count and 95 % Poisson interval."""
    low, high = one["interval"]
    return f"{one['per_picture']:.2f} ({one['total']:,} in {one['pictures']:,}; {low:.2f} to {high:.2f})"


def bin_name(one: Document) -> str:
    """A bin of a condition in words."""
    return f"{one['low']:g} or more" if one["high"] is None else f"{one['low']:g} to {one['high']:g}"


def bins_of(one: Document, condition: str, group: str = "all") -> Sequence[Document]:
    """Recall of a set by the bins of a condition; nothing where it is not known."""
    bins: Sequence[Document] = one.get("recall_by", {}).get(condition, {}).get(group, [])
    return bins


def _sets(found: Document) -> str:
    return listed([f"{plural(one['pictures'], 'picture')} ({name})" for name, one in found["sets"].items()])


def _figures(found: Document, hits: Mapping[str, Rate]) -> Iterator[Figure]:
    for name, rate in list(hits.items())[1:]:
        yield Figure(label=f"objects that are found, {name}", rate=rate)
    for name in hits:
        yield Figure(label=f"mean average precision at an overlap of 0.5, {name}", words=f"{_map(found, name):.3f}")
    for which, one in found["false_positives"].items():
        yield Figure(label=f"false positives per picture, pictures {which}", words=false_words(one))


def _map(found: Document, name: str) -> float:
    return float(found["sets"][name]["map"])


def _doubts(sets: Mapping[str, Document], empty: Rate) -> Iterator[str]:
    if not empty.total:
        yield "There are no pictures without objects, so nothing says how often the detector imagines one"
    for name, one in sets.items():
        few = [label for label, count in one["counts"].items() if count < FEW_OBJECTS]
        if few:
            yield f"Few objects ({name}; {listed(few)}): fewer than {FEW_OBJECTS}, so their figures may be chance"


def _charts(sets: Mapping[str, Document]) -> Iterator[Chart]:
    """Recall by each condition, a line for each set."""
    for condition, label in CONDITIONS.items():
        lines, ticks = [], tuple[str, ...]()
        for name, one in sets.items():
            bins = bins_of(one, condition)
            ticks = ticks or tuple(map(bin_name, bins))
            lines.append(Line.of(name, "other", map(Rate.of, bins)))
        if any(line.points for line in lines):
            yield Chart(
                title=f"Objects that are found, by {condition.replace('_', ' ')}",
                caption="Bands are 95 % intervals; bins without objects are left out.",
                x_label=label,
                y_label="objects",
                lines=tuple(lines),
                ticks=ticks,
            )


def _tables(found: Document, sets: Mapping[str, Document]) -> Iterator[Table]:
    rows = [
        (
            name,
            label,
            number(one["ap"].get(label), ".3f"),
            cell(Rate(successes=round(one["recall"][label] * count), total=count)),
            ", ".join(f"{other} {times}" for other, times in one["reported_as"].get(label, {}).items()) or "-",
        )
        for name, one in sets.items()
        for label, count in one["counts"].items()
        if count
    ]
    heads = ("pictures", "objects", "average precision", "found", "else reported on them")
    if rows:
        yield Table(caption="By class", head=heads, rows=tuple(rows))
    lines = {**{name: one["false_positives"] for name, one in found["sets"].items()}}
    lines |= {f"together, {name}": one for name, one in found["false_positives"].items()}
    cells = []
    for name, one in lines.items():
        kinds = ", ".join(f"{label} {count}" for label, count in one["by_class"].items() if count)
        pictures = Rate(successes=one["pictures_with"], total=one["pictures"])
        cells.append((name, false_words(one), cell(pictures), kinds or "-"))
    head = ("pictures", "per picture (95 % Poisson interval)", "pictures with any", "by class")
    yield Table(caption="False positives", head=head, rows=tuple(cells))
    others = [
        (name, ", ".join(f"{label} {count}" for label, count in list(one["other_classes"].items())[:8]))
        for name, one in found["sets"].items()
        if one["other_classes"]
    ]
    if others:
        caption = "Classes reported that no object here has, the most frequent"
        yield Table(caption=caption, head=("pictures", "classes"), rows=tuple(others))
