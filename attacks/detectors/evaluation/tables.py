"""What `mi-splat evaluate-detector` wrote, as tables in Markdown: of one detector, and of several side by side."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.detectors.catalogue import SMALL_CLASSES
from attacks.detectors.evaluation.held_out import BACKGROUND, PATH_TRACED, SPLAT_RENDERS
from attacks.detectors.evaluation.measure import CONDITIONS, IOU
from attacks.rate import Rate
from mi_splat.io.parsing import DocumentReader

Document = Mapping[str, Any]
"""What the command wrote, or a part of it."""

USUAL_CONFIDENCE = 0.5
"""Confidence from which detections count where nothing else is said."""

_FIGURES = DocumentReader(expected="figures of a detector", do="name a file that `mi-splat evaluate-detector` wrote")
_WITH_OBJECTS = (PATH_TRACED, SPLAT_RENDERS)
_MOST_OTHERS = 8


def read_figures(path: Path) -> dict[str, Any]:
    """The figures in a file of the command, or in the JSON beside a detector's card.

    Raises:
        InvalidValueError: The file holds no such figures.
    """
    document = _FIGURES.read_json(path)
    figures = document.get("held_out", document)
    if not isinstance(figures, dict) or not {"detector", "confidence", "sets", "false_positives"} <= set(figures):
        raise _FIGURES.broken(str(path), "others")
    return figures


def detector_tables(figures: Document) -> str:
    """Average precision, false positives, recall by how objects are seen, and what else is reported on them."""
    floor = f"the average precision takes all from {figures['min_confidence']:g}."
    first = f"A detection counts from a confidence of {figures['confidence']:g}; {floor}"
    makers = (_precision, _scenes, _false_positives, _recall, _reported_as, _other_classes)
    parts = [first, *(make(figures) for make in makers)]
    return "\n\n".join(part for part in parts if part) + "\n"


def comparison(several: Sequence[Document]) -> str:
    """Several detectors side by side, one a row: mAP, false positives, and recall by elevation."""
    heads = ["detector", "mAP path traced", "mAP splats", "false positives: with objects", "streets", "no objects"]
    parts = [table(heads, [_compared(figures) for figures in several])]
    for title, label, sets in (
        *((f"objects, {name}", "all", (name,)) for name in _WITH_OBJECTS),
        ("cars, path traced and splat renders together", "car", _WITH_OBJECTS),
    ):
        recalls = [(figures, _recall_in(figures, sets, "elevation", label)) for figures in several]
        rows = [[_name(figures), *map(_share, rates)] for figures, rates in recalls if rates]
        if rows:
            parts += [
                f"Recall by elevation in degrees, {title}:",
                table(["detector", *CONDITIONS["elevation"].bins], rows),
            ]
    return "\n\n".join(parts) + "\n"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; empty without rows."""
    lines = [f"| {' | '.join(cells)} |" for cells in (heads, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(heads), *lines[1:]]) if rows else ""


def _share(rate: Rate) -> str:
    """A fraction with its counts and its 95 % Wilson interval."""
    if not rate.total:
        return "-"
    low, high = (round(100 * end) for end in rate.interval)
    return f"{round(100 * rate.fraction)} % ({rate.successes}/{rate.total}; {low} to {high})"


def _per_picture(wrong: Document | None) -> str:
    """False positives per picture with counts and 95 % Poisson interval; a dash where there are no pictures."""
    if wrong is None:
        return "-"
    low, high = wrong["interval"]
    return f"{wrong['per_picture']:.2f} ({wrong['total']}/{wrong['pictures']}; {low:.2f} to {high:.2f})"


def _counted(counts: Iterable[tuple[str, int]], nothing: str = "-") -> str:
    return ", ".join(f"{label} {count}" for label, count in counts if count) or nothing


def _name(figures: Document) -> str:
    usual = figures["confidence"] == USUAL_CONFIDENCE
    return f"`{figures['detector']}`" if usual else f"`{figures['detector']}` at {figures['confidence']:g}"


def _sets(figures: Document) -> dict[str, Document]:
    """Those with objects that the project makes."""
    return {name: figures["sets"][name] for name in _WITH_OBJECTS if name in figures["sets"]}


def _recall_in(figures: Document, names: Iterable[str], condition: str, label: str) -> list[Rate]:
    """Recall by the bins of a condition, of some sets together; empty where no set knows it."""
    sets = [figures["sets"].get(name, {}).get("recall_by", {}).get(condition, {}).get(label, ()) for name in names]
    return [
        Rate(successes=sum(part["successes"] for part in parts), total=sum(part["total"] for part in parts))
        for parts in zip(*filter(None, sets), strict=True)
    ]


def _compared(figures: Document) -> list[str]:
    sets, wrong = figures["sets"], figures["false_positives"]
    means = [f"{sets[name]['map']:.3f}" if name in sets else "-" for name in _WITH_OBJECTS]
    streets = sets.get(f"{BACKGROUND}street", {}).get("false_positives")
    return [
        _name(figures),
        *means,
        *map(_per_picture, (wrong.get("with objects"), streets, wrong.get("without objects"))),
    ]


def _precision(figures: Document) -> str:
    """AP, number of objects and recall by class, for each set with objects."""
    sets = _sets(figures)
    rows, last = [[label] for label in SMALL_CLASSES] if sets else [], ["**mean**"]
    for part in sets.values():
        for row in rows:
            row += _of_class(part, row[0]) if row[0] in part["ap"] else ["-", "0", "-"]
        last += [f"**{part['map']:.3f}**", f"{sum(part['counts'].values())} in {part['pictures']} pictures", ""]
    heads = [head for name in sets for head in (name, "objects", "found")]
    return table([f"AP at IoU {IOU:g}", *heads], [*rows, last] if rows else [])


def _of_class(part: Document, label: str) -> list[str]:
    """AP, number of objects and recall."""
    return [f"{part['ap'][label]:.2f}", str(part["counts"][label]), f"{100 * part['recall'][label]:.0f} %"]


def _scenes(figures: Document) -> str:
    """The same for further scenes, of which each has few objects."""
    rows = [
        [name, label, *_of_class(part, label)]
        for name, part in figures["sets"].items()
        if name not in _WITH_OBJECTS and "map" in part
        for label in part["counts"]
    ]
    return table(["scene", "object", "AP", "pictures of it", "found"], rows)


def _false_positives(figures: Document) -> str:
    """False positives per picture for each set, and for those with and those without objects together."""
    parts = {name: part["false_positives"] for name, part in figures["sets"].items()}
    parts |= {f"**together, {name}**": part for name, part in figures["false_positives"].items()}
    rows = []
    for name, part in parts.items():
        often = sorted(part["by_class"].items(), key=lambda item: -item[1])
        rows.append([name, _per_picture(part), f"{part['pictures_with']}/{part['pictures']}", _counted(often)])
    return table(["pictures", "false positives per picture", "pictures with any", "by class"], rows)


def _recall(figures: Document) -> str:
    """Recall by the bins of every condition: all objects of each set, and the cars of both together."""
    sets, rows = [name for name in _sets(figures) if _recall_in(figures, (name,), "size", "all")], []
    for name, condition in CONDITIONS.items():
        columns = [_recall_in(figures, (which,), name, "all") for which in sets]
        columns.append(_recall_in(figures, sets, name, "car"))
        if any(columns):
            rows.append([f"**{name.replace('_', ' ')}**, {condition.unit}", *[""] * len(columns)])
            for number, edges in enumerate(condition.bins):
                rows.append([edges, *(_share(rates[number]) if rates else "-" for rates in columns)])
    heads = ["seen", *(f"objects, {name}" for name in sets), "cars, both" if len(sets) > 1 else "cars"]
    return table(heads, rows)


def _reported_as(figures: Document) -> str:
    """What else is reported on objects of each class."""
    sets = [figures["sets"].get(name, {}) for name in _WITH_OBJECTS]
    rows = []
    for label in SMALL_CLASSES:
        others = [_counted(part.get("reported_as", {}).get(label, {}).items(), "nothing") for part in sets]
        totals = [part.get("counts", {}).get(label, 0) for part in sets]
        rows.append([label, *(f"of {total}: {other}" for total, other in zip(totals, others, strict=True))])
    return table(["else reported on", *_WITH_OBJECTS], rows)


def _other_classes(figures: Document) -> str:
    """Detections of classes that no object has, for each set; empty for a detector that knows no others."""
    rows = [
        [name, str(part["pictures"]), _counted(list(part["other_classes"].items())[:_MOST_OTHERS])]
        for name, part in figures["sets"].items()
        if part["other_classes"]
    ]
    return table(["pictures", "number", "other classes reported, the eight most frequent"], rows)
