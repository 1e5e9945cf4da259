"""What `mi-splat detect` leaves behind: what detectors report on pictures, and on splats as cameras see them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.rate import Rate, percent
from attacks.report.section import FEW, Chart, Figure, Line, Picture, Point, Section
from attacks.report.wording import listed, plural, settings
from attacks.tables import Table, cell

KIND = "what detectors report"
MOST_PICTURES, MOST_CLASSES, MOST_ROWS = 6, 8, 100

Look = Mapping[str, Any]
"""One picture and detector, as result.json has it."""


def read(folder: Path, found: Mapping[str, Any]) -> Section:
    """The section of a folder of pictures with boxes.

    Args:
        folder: Where it lies.
        found: Its result.json.
    """
    looks: Sequence[Look] = found["pictures"]
    names = list(dict.fromkeys(one["detector"] for one in looks))
    rate, pictures = _rate(looks), _pictures(looks)
    several = len(names) > 1
    return Section(
        kind=KIND,
        title=f"{listed(names)} on {plural(pictures, 'picture')}",
        done=(
            f"{listed(names)} looked at {plural(pictures, 'picture')}: files, or splats and scenes from cameras. Every "
            f"detection from a confidence of {found['min_confidence']:g} is listed."
        ),
        conclusion=(
            f"Something is reported in {rate.successes:,} of {rate.total:,} "
            f"{'looks of a detector at a picture' if several else 'pictures'}. Nothing was attacked, and nothing says "
            "what the pictures show: these are reports, not hits."
        ),
        headline=Figure(label="pictures in which something is reported", rate=rate, note=_note(names)),
        attacked=False,
        figures=tuple(
            Figure(label=f"{name}: pictures in which something is reported", rate=_rate(_of(looks, name)))
            for name in names
            if several
        ),
        warnings=tuple(_doubts(rate)),
        pictures=_shown(folder, looks),
        charts=tuple(_charts(looks, names)),
        tables=(_classes(looks, names), *_each(looks)),
        configuration=settings(
            {
                "inputs": list(dict.fromkeys(one["source"] for one in looks)),
                "min_confidence": found["min_confidence"],
                "view": found.get("view", {}),
                "weights": found["fingerprints"],
            }
        ),
    )


def _note(names: Sequence[str]) -> str:
    return "each detector and picture counts once" if len(names) > 1 else ""


def _of(looks: Sequence[Look], name: str) -> list[Look]:
    return [one for one in looks if one["detector"] == name]


def _rate(looks: Sequence[Look], label: str | None = None) -> Rate:
    """Looks in which something is reported, or one class."""
    reported = [any(label in (None, item["label"]) for item in one["detections"]) for one in looks]
    return Rate(successes=sum(reported), total=len(reported))


def _pictures(looks: Sequence[Look]) -> int:
    """Number of pictures; each has one look of every detector."""
    return max(Counter(one["detector"] for one in looks).values())


def _doubts(rate: Rate) -> Iterator[str]:
    yield "Nothing was attacked, and there is no control: whether a report is right is not known"
    if rate.total < FEW:
        yield f"Few pictures: {rate.total}. The interval is wide; others may give another rate"


def _shown(folder: Path, looks: Sequence[Look]) -> tuple[Picture, ...]:
    return tuple(
        Picture(
            path=folder / Path(one["picture"]).name,
            caption=f"{_called(one)}, {one['detector']}: {_reported(one)}.",
            alt=f"A picture with the boxes of {one['detector']}",
        )
        for one in looks[:MOST_PICTURES]
    )


def _called(one: Look) -> str:
    camera = "" if one["camera"] is None else f" from {one['camera']['name']}"
    return f"{Path(one['source']).name}{camera}"


def _reported(one: Look) -> str:
    return ", ".join(f"{item['label']} {percent(item['score'])}" for item in one["detections"]) or "nothing"


def _often(looks: Sequence[Look]) -> list[str]:
    """Classes by the number of looks that report them."""
    counts = Counter(label for one in looks for label in {item["label"] for item in one["detections"]})
    return sorted(counts, key=lambda label: (-counts[label], label))


def _charts(looks: Sequence[Look], names: Sequence[str]) -> Iterator[Chart]:
    labels = _often(looks)[:MOST_CLASSES]
    if labels:
        yield Chart(
            title="Pictures that report a class",
            caption="The classes that are reported most; bars are 95 % intervals.",
            x_label="class",
            y_label="pictures",
            lines=tuple(
                Line(
                    name=name,
                    role="other",
                    points=tuple(Point.of(place, _rate(_of(looks, name), one)) for place, one in enumerate(labels)),
                )
                for name in names
            ),
            ticks=tuple(labels),
            connected=False,
        )


def _classes(looks: Sequence[Look], names: Sequence[str]) -> Table:
    rows = []
    for name in names:
        own = _of(looks, name)
        labels: list[str | None] = [*_often(own)]
        for label in labels or [None]:
            items = [item for one in own for item in one["detections"] if item["label"] == label]
            scores = [float(item["score"]) for item in items]
            most = percent(max(scores)) if scores else "-"
            rows.append((name, label or "nothing", cell(_rate(own, label)), str(len(items)), most))
    head = ("detector", "class", "pictures that report it", "detections", "highest confidence")
    return Table(caption="By detector and class", head=head, rows=tuple(rows))


def _each(looks: Sequence[Look]) -> Iterator[Table]:
    rows = tuple((_called(one), one["detector"], _reported(one)) for one in looks[:MOST_ROWS])
    more = "" if len(looks) <= MOST_ROWS else f", the first {MOST_ROWS} of {len(looks):,}"
    yield Table(caption=f"Each picture{more}", head=("picture", "detector", "reported"), rows=rows)
