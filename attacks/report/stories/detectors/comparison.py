"""What `mi-splat compare-detectors` leaves behind: the figures of several detectors side by side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.rate import Rate, percent
from attacks.report.section import Chart, Figure, Line, Section
from attacks.report.stories.detectors.held_out import (
    CONDITIONS,
    bin_name,
    bins_of,
    false_of,
    false_words,
    hits_of,
    objects_of,
)
from attacks.report.wording import listed, plural, settings
from attacks.tables import Table, cell

KIND = "detectors compared"

Document = Mapping[str, Any]


def read(path: Path, found: Document) -> Section:
    """The section of several detectors.

    Args:
        path: The JSON file with the figures of all.
        found: What is in it.
    """
    several: Sequence[Document] = found["compared"]
    names = [_name(one) for one in several]
    sets = list(dict.fromkeys(name for one in several for name in objects_of(one)))
    first = sets[0] if sets else ""
    hits = [hits_of(objects_of(one)[first]) for one in several if first in objects_of(one)]
    empty = [rate for one in several if (rate := false_of(one, "without objects")).total]
    return Section(
        kind=KIND,
        title=listed(names),
        done=(
            f"{plural(len(several), 'detector')} looked at pictures that none was trained on. A detection counts from "
            "the confidence beside the detector's name. Nothing was attacked."
        ),
        conclusion=(
            f"Of the objects ({first or 'none'}) the detectors find {_range(hits)}, and they report something in "
            f"{_range(empty)} of the pictures without any object. Compare them within one table: where intervals "
            "overlap, nothing says which one is better."
        ),
        headline=Figure(label=f"objects that are found ({first or 'none'}), lowest to highest", words=_range(hits)),
        control=Figure(label="pictures without any object in which something is reported", words=_range(empty))
        if empty
        else None,
        attacked=False,
        figures=tuple(
            Figure(label=f"{_name(one)}: objects that are found, {name}", rate=hits_of(own))
            for one in several
            for name, own in objects_of(one).items()
        ),
        warnings=tuple(_doubts(several)),
        charts=tuple(_charts(several, sets)),
        tables=tuple(_tables(several, sets)),
        configuration=settings(
            {name: {key: one[key] for key in _SETTINGS if key in one} for name, one in zip(names, several, strict=True)}
        ),
    )


_SETTINGS = ("fingerprint", "confidence", "min_confidence", "pictures")


def _name(one: Document) -> str:
    return f"{one['detector']} at {one['confidence']:g}"


def _range(rates: Sequence[Rate]) -> str:
    if not rates:
        return "nothing counted"
    low, high = (percent(pick(rate.fraction for rate in rates)) for pick in (min, max))
    return low if low == high else f"{low} to {high}"


def _doubts(several: Sequence[Document]) -> Iterator[str]:
    if len(several) < 2:
        yield "One detector alone: there is nothing to compare it with"
    if len({one["confidence"] for one in several}) > 1:
        yield "The detectors count from different confidences: what is found depends on it, mAP does not"
    made = [one.get("pictures") for one in several]
    if any(one != made[0] for one in made):
        yield "The detectors looked at different pictures: their figures cannot be compared"


def _charts(several: Sequence[Document], sets: Sequence[str]) -> Iterator[Chart]:
    """Recall by elevation, a chart for each set and a line for each detector."""
    for name in sets:
        members = [one for one in several if bins_of(one["sets"].get(name, {}), "elevation")]
        if not members:
            continue
        lines = [Line.of(_name(one), "other", map(Rate.of, bins_of(one["sets"][name], "elevation"))) for one in members]
        if any(line.points for line in lines):
            yield Chart(
                title=f"Objects that are found, by elevation, {name}",
                caption="Bands are 95 % intervals; bins without objects are left out.",
                x_label=CONDITIONS["elevation"],
                y_label="objects",
                lines=tuple(lines),
                ticks=tuple(map(bin_name, bins_of(members[0]["sets"][name], "elevation"))),
            )


def _tables(several: Sequence[Document], sets: Sequence[str]) -> Iterator[Table]:
    kinds = list(dict.fromkeys(which for one in several for which in one["false_positives"]))
    rows = []
    for one in several:
        means = [f"{one['sets'][name]['map']:.3f}" if name in objects_of(one) else "-" for name in sets]
        false = [one["false_positives"].get(which) for which in kinds]
        rows.append((_name(one), *means, *("-" if some is None else false_words(some) for some in false)))
    head = ("detector", *(f"mAP, {name}" for name in sets), *(f"false positives, pictures {name}" for name in kinds))
    yield Table(caption="Precision, and false positives per picture", head=head, rows=tuple(rows))
    for name in sets:
        bins = next((found for one in several if (found := bins_of(one["sets"].get(name, {}), "elevation"))), ())
        cells = []
        for one in several:
            own = bins_of(one["sets"].get(name, {}), "elevation")
            if len(own) == len(bins) and own:
                cells.append((_name(one), *(cell(entry) for entry in own)))
        if cells:
            caption = f"Objects that are found, by elevation in degrees, {name}"
            yield Table(caption=caption, head=("detector", *map(bin_name, bins)), rows=tuple(cells))
