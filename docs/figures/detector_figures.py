"""Writes figures of detectors into cards and docs/detectors.md: `python docs/figures/detector_figures.py [FILE ...]`.

Each FILE is a result.json of `mi-splat evaluate-detector`; the figures of each detector in it are put beside its card,
or into docs/tables/detectors where it has none. Then the cards and the picture are written anew from what is there.
Sentences that name figures are not; read them again.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attacks.detectors.evaluation import CONDITIONS
from attacks.detectors.training.config import PATH_TRACED
from attacks.report.stories.detectors.held_out import bins_of, compared, detailed, documents
from attacks.tables import Table

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
_BEGIN, _END = "<!-- written by `docs/figures/detector_figures.py` -->", "<!-- end -->"
USUAL_CONFIDENCE = 0.5
"""Confidence from which detections count where nothing else is said."""
_DRAWN = ("elevation", "distance", "size", "brightness")


def read_figures(path: Path) -> dict[str, Any]:
    """The figures of a detector that are kept."""
    document: dict[str, Any] = json.loads(path.read_text())
    figures: dict[str, Any] = document.get("held_out", document)
    return figures


def put_away(path: Path) -> None:
    """Put the figures of one result where they are kept."""
    record = json.loads(path.read_text())
    for figures in documents(record):
        kept = {**figures, **{name: record[name] for name in ("pictures", "versions", "commit")}}
        name, usual = figures["detector"], figures["confidence"] == USUAL_CONFIDENCE
        if usual and name in CARDS:
            card: dict[str, Any] = json.loads(CARDS[name][0].read_text())
            CARDS[name][0].write_text(json.dumps({**card, "held_out": kept}, indent=1) + "\n")
            continue
        suffix = "" if usual else f"_{round(100 * figures['confidence']):02d}"
        TABLES.mkdir(parents=True, exist_ok=True)
        (TABLES / f"{name}{suffix}.json").write_text(json.dumps(kept, indent=1) + "\n")


def in_markdown(tables: Iterable[Table]) -> str:
    """Tables below their captions, which are no headings of the page."""
    return "\n\n".join(table.markdown.replace("## ", "", 1) for table in tables)


def card_of(figures: Mapping[str, Any]) -> str:
    """All tables of a detector."""
    floor = f"the average precision takes all from {figures['min_confidence']:g}."
    first = f"A detection counts from a confidence of {figures['confidence']:g}; {floor}"
    if "lacks" in figures:
        first += f" It has no class {', '.join(figures['lacks'])}: these objects are not counted."
    return f"{first}\n\n{in_markdown(detailed(figures))}\n"


def table_page(path: Path) -> str:
    """The page of docs/tables/detectors for a file of figures, which is written when the site is built."""
    figures = read_figures(path)
    return f"# {figures['detector']}, from a confidence of {figures['confidence']:g}\n\n{card_of(figures)}"


def compared_page() -> str:
    """The page of docs/tables/detectors with all detectors beside each other."""
    tables = in_markdown(compared([read_figures(path) for path in kept_figures()]))
    head = "# Detectors side by side\n\nWhat is counted, and on which pictures: [detectors](../../detectors.md)."
    return f"{head}\n\n{tables}\n"


def kept_figures() -> list[Path]:
    """Where figures are kept: of the detectors that have cards, then of the others."""
    return [figures for figures, _ in CARDS.values()] + sorted(TABLES.glob("*.json"))


def write_between_marks(path: Path, text: str) -> None:
    """Replace what stands between the marks of a page."""
    page = path.read_text()
    start = page.index(_BEGIN) + len(_BEGIN)
    path.write_text(f"{page[:start]}\n\n{text.strip()}\n\n{page[page.index(_END, start) :]}")


def draw_recall(several: Sequence[Mapping[str, Any]]) -> Figure:
    """Recall on path-traced pictures in the bins of four conditions, a line for each detector; empty bins left out."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.1), dpi=100, layout="constrained")
    for axes, condition in zip(figure.subplots(1, len(_DRAWN), sharey=True), _DRAWN, strict=True):
        for number, figures in enumerate(several):
            bins = figures["sets"][PATH_TRACED]["found_by"].get(condition, {}).get("all", [])
            name = f"{figures['detector']} at {figures['confidence']:g}"
            draw_line(axes, bins, name, shift=0.06 * (number - (len(several) - 1) / 2))
        names = [name.replace(" or more", "+").replace(" to ", "-") for name in bins_of(condition)]
        axes.set_xticks(range(len(names)), names, fontsize=7)
        axes.set(xlabel=f"{condition}, {CONDITIONS[condition].unit}", ylim=(-0.02, 1.02))
        axes.grid(alpha=0.3)
    first = figure.axes[0]
    first.set_ylabel("recall at IoU 0.5")
    handles, labels = first.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 6), fontsize=8)
    return figure


def draw_line(axes: Axes, bins: Sequence[Mapping[str, Any]], name: str, *, shift: float) -> None:
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
    """Put new figures away and write every table and the picture anew."""
    for path in paths:
        put_away(path)
    for kept, card in CARDS.values():
        write_between_marks(card, card_of(read_figures(kept)))
    several = [read_figures(path) for path in kept_figures()]
    write_between_marks(PAGE, in_markdown([next(compared(several))]))
    draw_recall([figures for figures in several if figures["confidence"] == USUAL_CONFIDENCE]).savefig(PICTURE)


if __name__ == "__main__":
    main([Path(word) for word in sys.argv[1:]])
