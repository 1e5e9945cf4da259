"""Writes figures of detectors into cards and docs/detectors.md:
`python docs/figures/detector_figures.py [FILE ...]`.

Each FILE is a result.json of scenes/recipes/evaluate_detectors.py; the figures of each
detector in it are put beside its card, or into docs/tables/detectors where it has none.
Then the cards and the image are written anew from what is there. Sentences that name
figures are not; read them again.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attacks.detectors.catalogue import SMALL_CLASSES
from attacks.figures.rate import Rate, number, pooled
from attacks.figures.tables import Table, cell
from attacks.report.section import listed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[2]
CARDS = {
    "fasterrcnn_small": (
        ROOT / "attacks" / "detectors" / "fasterrcnn_small.json",
        ROOT / "attacks" / "detectors" / "fasterrcnn_small.md",
    ),
    "yolov8n_small": (
        ROOT / "scenes" / "detectors" / "yolov8n_small.json",
        ROOT / "scenes" / "detectors" / "README.md",
    ),
}
"""Detector to the file of its curves and figures, and its card."""
TABLES = ROOT / "docs" / "tables" / "detectors"
PAGE = ROOT / "docs" / "detectors.md"
PICTURE = ROOT / "docs" / "images" / "detectors_recall.png"
_BEGIN = "<!-- written by `docs/figures/detector_figures.py` -->"
_END = "<!-- end -->"
USUAL_CONFIDENCE = 0.5
"""Confidence from which detections count where nothing else is said."""
PATH_TRACED = "path traced"
SPLAT_RENDERS = "splat renders"
EMPTY = "background: "
WITH_OBJECTS = (PATH_TRACED, SPLAT_RENDERS)
UNITS = {
    "elevation": "degrees",
    "distance": "diagonals of the object",
    "size": "share of the image's side",
    "brightness": "mean luma",
    "sun_elevation": "degrees",
    "sun_strength": "irradiance",
}
"""How objects are seen, and in what that is measured."""
OF_CARDS = ("elevation",)
"""Those in cards; all figures are in the file beside the card."""
_MOST_OTHERS = 8
_DRAWN = ("elevation", "distance", "size", "brightness")


def read_figures(path: Path) -> dict[str, Any]:
    """The figures of a detector that are kept."""
    document: dict[str, Any] = json.loads(path.read_text())
    figures: dict[str, Any] = document.get("held_out", document)
    return figures


def put_away(path: Path) -> None:
    """Put the figures of one result where they are kept."""
    record = json.loads(path.read_text())
    for detector, values in record["detectors"].items():
        figures = {"detector": detector, "confidence": record["confidence"], **values}
        kept = {
            **figures,
            **{name: record[name] for name in ("pictures", "versions", "commit")},
        }
        name = figures["detector"]
        usual = figures["confidence"] == USUAL_CONFIDENCE
        if usual and name in CARDS:
            card: dict[str, Any] = json.loads(CARDS[name][0].read_text())
            CARDS[name][0].write_text(
                json.dumps({**card, "held_out": kept}, indent=1) + "\n"
            )
            continue
        suffix = "" if usual else f"_{round(100 * figures['confidence']):02d}"
        TABLES.mkdir(parents=True, exist_ok=True)
        (TABLES / f"{name}{suffix}.json").write_text(json.dumps(kept, indent=1) + "\n")


def compared(several: Sequence[Mapping[str, Any]]) -> Iterator[Table]:
    """Precision, false positives, and recall by elevation, a detector a row."""
    sets = [
        name
        for name in WITH_OBJECTS
        if any(name in figures["sets"] for figures in several)
    ]
    rows = []
    for figures in several:
        totals = figures["false_positives"]
        street = figures["sets"].get(f"{EMPTY}street", {})
        wrong = (
            totals.get("with objects"),
            street.get("false_positives"),
            totals.get("without objects"),
        )
        means = (
            number(figures["sets"].get(name, {}).get("map"), ".3f") for name in sets
        )
        rows.append((_name(figures), *means, *map(_per_picture, wrong)))
    heads = ("with objects", "of streets without", "without any")
    head = (
        "detector",
        *(f"mAP, {name}" for name in sets),
        *(f"false positives, images {which}" for which in heads),
    )
    yield Table(
        caption="Precision, and false positives per image", head=head, rows=tuple(rows)
    )
    for title, group, members in (
        *((f"objects, {name}", "all", (name,)) for name in sets),
        (f"cars, {listed(sets)}", "car", sets),
    ):
        recalls = [
            (_name(figures), _recall_by(figures, members, "elevation", group))
            for figures in several
        ]
        lines = tuple((name, *map(cell, rates)) for name, rates in recalls if rates)
        if lines:
            caption = f"Found by elevation in degrees: {title}"
            yield Table(
                caption=caption,
                head=("detector", *bins_of(several[0], "elevation")),
                rows=lines,
            )


def in_short(several: Sequence[Mapping[str, Any]]) -> Table:
    """Precision and false positives without their counts and intervals, third-party
    detectors first.
    """
    table = next(compared(several))
    rows = sorted(table.rows, key=lambda row: row[0].split()[0] in CARDS)
    return replace(
        table,
        rows=tuple(tuple(cell.partition(" (")[0] for cell in row) for row in rows),
    )


def detailed(figures: Mapping[str, Any], conditions: Iterable[str]) -> Iterator[Table]:
    """The tables of one detector: by class, false positives, recall by how objects are
    seen, and other classes.
    """
    sets = figures["sets"]
    by_class = [
        (
            name,
            label,
            number(part["ap"][label], ".3f"),
            cell(Rate.of(rate)),
            _often(part["reported_as"].get(label, {})),
        )
        for name, part in sets.items()
        for label, rate in part.get("found", {}).items()
    ]
    if by_class:
        head = (
            "images",
            "class",
            "average precision",
            "found",
            "other classes reported",
        )
        yield Table(caption="By class", head=head, rows=tuple(by_class))
    parts = {name: part["false_positives"] for name, part in sets.items()}
    parts |= {
        f"together, {name}": part for name, part in figures["false_positives"].items()
    }
    wrong = [
        (
            name,
            _per_picture(part),
            cell(Rate.of(part["pictures_with"])),
            _often(part["by_class"]),
        )
        for name, part in parts.items()
    ]
    heads = (
        "images",
        "per image (95 % Poisson interval)",
        "images with any",
        "by class",
    )
    yield Table(caption="False positives", head=heads, rows=tuple(wrong))
    seen = [name for name in sets if "found_by" in sets[name] and name in WITH_OBJECTS]
    for condition in conditions:
        columns = {
            f"objects, {name}": _recall_by(figures, (name,), condition) for name in seen
        }
        columns = {**columns, "cars": _recall_by(figures, seen, condition, "car")}
        columns = {name: rates for name, rates in columns.items() if rates}
        if columns:
            rows = zip(
                bins_of(figures, condition),
                *(map(cell, rates) for rates in columns.values()),
                strict=True,
            )
            caption = f"Recall by {condition.replace('_', ' ')}, {UNITS[condition]}"
            yield Table(
                caption=caption,
                head=(condition.replace("_", " "), *columns),
                rows=tuple(rows),
            )
    others = [
        (name, _often(part["other_classes"]))
        for name, part in sets.items()
        if part["other_classes"]
    ]
    if others:
        caption = "Most frequent classes that no object here has"
        yield Table(caption=caption, head=("images", "classes"), rows=tuple(others))


def bins_of(figures: Mapping[str, Any], condition: str) -> list[str]:
    """Names of the bins of a condition, for instance "0 to 15" and "6 or more"."""
    parts = (
        part["found_by"].get(condition)
        for part in figures["sets"].values()
        if "found_by" in part
    )
    bins = next(part["all"] for part in parts if part)
    return [
        f"{b['from']:g} or more" if b["to"] is None else f"{b['from']:g} to {b['to']:g}"
        for b in bins
    ]


def _name(figures: Mapping[str, Any]) -> str:
    known = len(SMALL_CLASSES) - len(figures.get("lacks", ()))
    if known == len(SMALL_CLASSES):
        of = ""
    else:
        of = f", {known} of {len(SMALL_CLASSES)} classes"
    return f"{figures['detector']} at {figures['confidence']:g}{of}"


def _recall_by(
    figures: Mapping[str, Any], names: Sequence[str], condition: str, group: str = "all"
) -> list[Rate]:
    """Recall by the bins of a condition, of some sets together; empty where no set
    knows it.
    """
    sets = [
        figures["sets"]
        .get(name, {})
        .get("found_by", {})
        .get(condition, {})
        .get(group, ())
        for name in names
    ]
    return [
        pooled(map(Rate.of, parts)) for parts in zip(*filter(None, sets), strict=True)
    ]


def _per_picture(part: Mapping[str, Any] | None) -> str:
    """False positives per image with their count and 95 % Poisson interval."""
    if part is None:
        return "-"
    low, high = part["interval"]
    return (
        f"{part['per_picture']:.2f} ({part['number']:,} in {part['pictures']:,};"
        f" {low:.2f} to {high:.2f})"
    )


def _often(counts: Mapping[str, int]) -> str:
    """The most frequent labels with their counts."""
    often = sorted(counts.items(), key=lambda item: -item[1])[:_MOST_OTHERS]
    return ", ".join(f"{label} {count}" for label, count in often if count) or "-"


def in_markdown(tables: Iterable[Table]) -> str:
    """Tables below their captions, which are no headings of the page."""
    return "\n\n".join(table.markdown.replace("## ", "", 1) for table in tables)


def card_of(figures: Mapping[str, Any], conditions: Iterable[str] = UNITS) -> str:
    """The tables of a detector."""
    floor = f"the average precision uses all from {figures['min_confidence']:g}."
    first = f"A detection counts at confidence >= {figures['confidence']:g}; {floor}"
    if "lacks" in figures:
        first += (
            f" It has no class {', '.join(figures['lacks'])}: these objects are not"
            " counted."
        )
    return f"{first}\n\n{in_markdown(detailed(figures, conditions))}\n"


def table_page(path: Path) -> str:
    """The text of docs/tables/detectors for a file of figures."""
    figures = read_figures(path)
    return (
        f"# {figures['detector']}, from a confidence of"
        f" {figures['confidence']:g}\n\n{card_of(figures)}"
    )


def compared_page() -> str:
    """The text of docs/tables/detectors with all detectors beside each other."""
    tables = in_markdown(compared([read_figures(path) for path in kept_figures()]))
    head = (
        "# Detectors side by side\n\nWhat is counted, and on which images:"
        " [detectors](../../detectors.md)."
    )
    return f"{head}\n\n{tables}\n"


def kept_figures() -> list[Path]:
    """Where figures are kept: of the detectors that have cards, then of the others."""
    return [figures for figures, _ in CARDS.values()] + sorted(TABLES.glob("*.json"))


def write_between_marks(path: Path, text: str) -> None:
    """Replace what stands between the marks of a page."""
    page = path.read_text()
    start = page.index(_BEGIN) + len(_BEGIN)
    path.write_text(
        f"{page[:start]}\n\n{text.strip()}\n\n{page[page.index(_END, start) :]}"
    )


def draw_recall(several: Sequence[Mapping[str, Any]]) -> Figure:
    """Recall on path-traced images in the bins of four conditions, a line for each
    detector; empty bins left out.
    """
    import matplotlib.style
    from matplotlib.figure import Figure

    matplotlib.style.use(Path(__file__).with_name("page.mplstyle"))
    figure = Figure(figsize=(7.2, 5.0), layout="constrained")
    grid = figure.subplots(2, len(_DRAWN) // 2, sharey=True)
    for axes, condition in zip(grid.flat, _DRAWN, strict=True):
        for line, figures in enumerate(several):
            bins = (
                figures["sets"][PATH_TRACED]["found_by"]
                .get(condition, {})
                .get("all", [])
            )
            name = f"{figures['detector']} at {figures['confidence']:g}"
            draw_line(axes, bins, name, shift=0.06 * (line - (len(several) - 1) / 2))
        names = [
            name.replace(" or more", "+").replace(" to ", "-")
            for name in bins_of(several[0], condition)
        ]
        axes.set_xticks(range(len(names)), names)
        axes.set(xlabel=f"{condition}, {UNITS[condition]}", ylim=(-0.02, 1.02))
        axes.grid(alpha=0.3)
    first = figure.axes[0]
    figure.supylabel("recall at IoU 0.5", fontsize="medium")
    handles, labels = first.get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside upper center",
        ncols=min(len(labels), 3),
    )
    return figure


def draw_line(
    axes: Axes, bins: Sequence[Mapping[str, Any]], name: str, *, shift: float
) -> None:
    """One line with its 95 % Wilson intervals, each bin at its number."""
    known = [(number, rate) for number, rate in enumerate(bins) if rate["total"]]
    below = [max(0.0, rate["rate"] - rate["interval"][0]) for _, rate in known]
    above = [max(0.0, rate["interval"][1] - rate["rate"]) for _, rate in known]
    axes.errorbar(
        [number + shift for number, _ in known],
        [rate["rate"] for _, rate in known],
        yerr=[below, above],
        marker="o",
        markersize=3,
        linewidth=1,
        capsize=2,
        label=name,
    )


def main(paths: Sequence[Path]) -> None:
    """Put new figures away and write every table and the image anew."""
    for path in paths:
        put_away(path)
    for kept, card in CARDS.values():
        write_between_marks(card, card_of(read_figures(kept), OF_CARDS))
    several = [read_figures(path) for path in kept_figures()]
    write_between_marks(PAGE, in_markdown([in_short(several)]))
    draw_recall(
        [figures for figures in several if figures["confidence"] == USUAL_CONFIDENCE]
    ).savefig(PICTURE)


if __name__ == "__main__":
    main([Path(word) for word in sys.argv[1:]])
