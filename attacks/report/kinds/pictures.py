"""What `mi-splat detect` leaves behind: what detectors report on pictures, and on splats as cameras see them."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.rate import Rate, percent
from attacks.report.section import FEW, Chart, Figure, Line, Picture, Section, listed, plural, settings
from attacks.tables import Table, cell

MOST_PICTURES, MOST_CLASSES, MOST_ROWS = 6, 8, 100

Look = Mapping[str, Any]
"""One picture and detector, as result.json has it."""


def read(folder: Path, record: Mapping[str, Any]) -> Section:
    """The section of a folder of pictures with boxes."""
    looks: Sequence[Look] = record["pictures"]
    by_detector: dict[str, list[Look]] = {}
    for look in looks:
        by_detector.setdefault(look["detector"], []).append(look)
    rate, several = _rate(looks), len(by_detector) > 1
    names, pictures = listed(list(by_detector)), plural(max(map(len, by_detector.values())), "picture")
    label = "pictures in which something is reported"
    return Section(
        kind="what detectors report",
        title=f"{names} on {pictures}",
        done=(
            f"{names} looked at {pictures}: files, or splats and scenes from cameras. Every detection from a "
            f"confidence of {record['min_confidence']:g} is listed."
        ),
        conclusion=(
            f"Something is reported in {rate.counts} {'looks of a detector at a picture' if several else 'pictures'}. "
            "Nothing was attacked, and nothing says what the pictures show: these are reports, not hits."
        ),
        headline=Figure(label=label, rate=rate, note="each detector and picture counts once" if several else ""),
        attacked=False,
        figures=tuple(
            Figure(label=f"{name}: {label}", rate=_rate(members)) for name, members in by_detector.items() if several
        ),
        warnings=(
            "Nothing was attacked, and there is no control: whether a report is right is not known",
            *([f"Few pictures: {rate.total}. The interval is wide; others may give another rate"] * (rate.total < FEW)),
        ),
        pictures=tuple(
            Picture(
                path=folder / Path(look["picture"]).name,
                caption=f"{_source(look)}, {look['detector']}: {_reports(look)}.",
                alt=f"A picture with the boxes of {look['detector']}",
            )
            for look in looks[:MOST_PICTURES]
        ),
        charts=tuple(_charts(looks, by_detector)),
        tables=_tables(looks, by_detector),
        configuration=settings(
            {
                "inputs": list(dict.fromkeys(look["source"] for look in looks)),
                "min_confidence": record["min_confidence"],
                "view": record.get("view", {}),
                "weights": record["fingerprints"],
            }
        ),
    )


def _tables(looks: Sequence[Look], by_detector: Mapping[str, list[Look]]) -> tuple[Table, ...]:
    return (
        Table(
            caption="By detector and class",
            head=("detector", "class", "pictures that report it", "detections", "highest confidence"),
            rows=tuple(_class_rows(by_detector)),
        ),
        Table.of(
            f"Each picture{f', the first {MOST_ROWS} of {len(looks):,}' if len(looks) > MOST_ROWS else ''}",
            {"picture": _source, "detector": "detector", "reported": _reports},
            looks[:MOST_ROWS],
        ),
    )


def _rate(looks: Sequence[Look], label: str | None = None) -> Rate:
    """Looks in which something is reported, or one class."""
    reported = [any(label in (None, item["label"]) for item in look["detections"]) for look in looks]
    return Rate(successes=sum(reported), total=len(reported))


def _source(look: Look) -> str:
    camera = "" if look["camera"] is None else f" from {look['camera']['name']}"
    return f"{Path(look['source']).name}{camera}"


def _reports(look: Look) -> str:
    return ", ".join(f"{item['label']} {percent(item['score'])}" for item in look["detections"]) or "nothing"


def _classes(looks: Sequence[Look]) -> list[str]:
    """Classes by the number of looks that report them."""
    counts = Counter(label for look in looks for label in {item["label"] for item in look["detections"]})
    return sorted(counts, key=lambda label: (-counts[label], label))


def _charts(looks: Sequence[Look], by_detector: Mapping[str, Sequence[Look]]) -> Iterator[Chart]:
    if labels := _classes(looks)[:MOST_CLASSES]:
        yield Chart.bars(
            "Pictures that report a class",
            ("class", "pictures"),
            labels,
            *(
                Line.of(name, "other", [_rate(members, label) for label in labels])
                for name, members in by_detector.items()
            ),
            caption="The classes that are reported most; bars are 95 % intervals.",
        )


def _class_rows(by_detector: Mapping[str, Sequence[Look]]) -> Iterator[tuple[str, ...]]:
    for name, looks in by_detector.items():
        for label in _classes(looks) or ["nothing"]:
            items = [item for look in looks for item in look["detections"] if item["label"] == label]
            most = percent(max(float(item["score"]) for item in items)) if items else "-"
            yield name, label, cell(_rate(looks, label if items else None)), str(len(items)), most
