"""The figures of `mi-splat evaluate-detector` as tables in Markdown: of one detector, and of several side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.detectors.classes import SMALL_CLASSES
from attacks.detectors.evaluation.held_out import BACKGROUND, PATH_TRACED, SPLAT_RENDERS
from attacks.detectors.evaluation.recall import UNITS, bin_names
from attacks.rate import Rate
from mi_splat.io.parsing import DocumentReader

Document = Mapping[str, Any]
"""What the command wrote."""

USUAL_CONFIDENCE = 0.5
"""Confidence from which detections count where nothing else is said."""

_FIGURES = DocumentReader(expected="figures of a detector", do="name a file that `mi-splat evaluate-detector` wrote")
_STREET = f"{BACKGROUND}street"


def read_figures(path: Path) -> dict[str, Any]:
    """The figures in a file of the command, or in the JSON beside a detector's card.

    Raises:
        InvalidValueError: The file holds no such figures.
    """
    found = _FIGURES.read_json(path)
    found = found.get("held_out", found)
    if not isinstance(found, dict) or not {"detector", "confidence", "sets", "false_positives"} <= set(found):
        raise _FIGURES.broken(str(path), "others")
    return found


def detector_tables(found: Document) -> str:
    """Average precision, false positives, recall by how objects are seen, and what else is reported on them."""
    floor = f"the average precision takes all from {found['min_confidence']:g}."
    first = f"A detection counts from a confidence of {found['confidence']:g}; {floor}"
    kinds = (_precision, _scenes, _false_positives, _recall, _reported_as, _other_classes)
    parts = [first, *(kind(found) for kind in kinds)]
    return "\n\n".join(part for part in parts if part) + "\n"


def comparison(several: Sequence[Document]) -> str:
    """Several detectors side by side, one a row: mAP, false positives, and recall by elevation."""
    rows = [_compared(found) for found in several]
    heads = ["detector", "mAP path traced", "mAP splats", "false positives: with objects", "streets", "no objects"]
    parts = [table(heads, rows)]
    both = (PATH_TRACED, SPLAT_RENDERS)
    for title, group, sets in (
        *((f"objects, {which}", "all", (which,)) for which in both),
        ("cars, path traced and splat renders together", "car", both),
    ):
        rows = []
        for found in several:
            bins = [some for which in sets if (some := _bins(found, which, "elevation", group))]
            if bins:
                rows.append([_name(found), *(rate(_together(some)) for some in zip(*bins, strict=True))])
        if rows:
            parts += [f"Recall by elevation in degrees, {title}:", table(["detector", *bin_names("elevation")], rows)]
    return "\n\n".join(parts) + "\n"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [f"| {' | '.join(line)} |" for line in (heads, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(heads), *lines[1:]])


def rate(one: Mapping[str, Any]) -> str:
    """A fraction with its counts and its 95 % Wilson interval, of a bin as JSON has it."""
    if not one["total"]:
        return "-"
    low, high = (round(100 * value) for value in one["interval"])
    return f"{round(100 * one['rate'])} % ({one['successes']}/{one['total']}; {low} to {high})"


def false_positive_rate(one: Mapping[str, Any]) -> str:
    """False positives per picture with counts and 95 % Poisson interval, as JSON has them."""
    low, high = one["interval"]
    return f"{one['per_picture']:.2f} ({one['total']}/{one['pictures']}; {low:.2f} to {high:.2f})"


def _name(found: Document) -> str:
    usual = found["confidence"] == USUAL_CONFIDENCE
    return f"`{found['detector']}`" if usual else f"`{found['detector']}` at {found['confidence']:g}"


def _bins(found: Document, which: str, condition: str, group: str) -> list[dict[str, Any]]:
    """Recall by the bins of a condition; empty where it is not known."""
    bins: list[dict[str, Any]] = found["sets"].get(which, {}).get("recall_by", {}).get(condition, {}).get(group, [])
    return bins


def _compared(found: Document) -> list[str]:
    sets, false = found["sets"], found["false_positives"]
    means = [f"{sets[which]['map']:.3f}" if which in sets else "-" for which in (PATH_TRACED, SPLAT_RENDERS)]
    counted = [
        false.get("with objects"),
        sets.get(_STREET, {}).get("false_positives"),
        false.get("without objects"),
    ]
    return [_name(found), *means, *("-" if one is None else false_positive_rate(one) for one in counted)]


def _precision(found: Document) -> str:
    """AP, number of objects and recall by class, for each set with objects."""
    sets = {name: one for name, one in found["sets"].items() if name in (PATH_TRACED, SPLAT_RENDERS)}
    if not sets:
        return ""
    rows = []
    for label in SMALL_CLASSES:
        row = [label]
        for one in sets.values():
            there = label in one["ap"]
            row += [f"{one['ap'][label]:.2f}", str(one["counts"][label])] if there else ["-", "0"]
            row.append(f"{one['recall'][label]:.0%}".replace("%", " %") if there else "-")
        rows.append(row)
    last = ["**mean**"]
    for one in sets.values():
        last += [f"**{one['map']:.3f}**", f"{sum(one['counts'].values())} in {one['pictures']} pictures", ""]
    heads = [head for name in sets for head in (name, "objects", "found")]
    return table(["AP at IoU 0.5", *heads], [*rows, last])


def _scenes(found: Document) -> str:
    """The same for further scenes, of which each has few objects."""
    rows = [
        [name, label, str(count), f"{one['recall'][label]:.0%}".replace("%", " %"), f"{one['ap'][label]:.2f}"]
        for name, one in found["sets"].items()
        if name not in (PATH_TRACED, SPLAT_RENDERS) and "map" in one
        for label, count in one["counts"].items()
    ]
    return table(["scene", "object", "pictures of it", "found", "AP"], rows) if rows else ""


def _false_positives(found: Document) -> str:
    """False positives per picture for each set, and for those with and those without objects together."""
    lines = {**{name: one["false_positives"] for name, one in found["sets"].items()}}
    lines |= {f"**together, {name}**": one for name, one in found["false_positives"].items()}
    rows = []
    for name, one in lines.items():
        often = sorted(((count, label) for label, count in one["by_class"].items() if count), key=lambda x: -x[0])
        kinds = ", ".join(f"{label} {count}" for count, label in often) or "-"
        rows.append([name, false_positive_rate(one), f"{one['pictures_with']}/{one['pictures']}", kinds])
    return table(["pictures", "false positives per picture", "pictures with any", "by class"], rows)


def _recall(found: Document) -> str:
    """Recall by the bins of every condition: all objects of each set, and the cars of both together."""
    sets = [which for which in (PATH_TRACED, SPLAT_RENDERS) if _bins(found, which, "size", "all")]
    rows = []
    for condition, unit in UNITS.items():
        columns = [_bins(found, which, condition, "all") for which in sets]
        cars = [some for which in sets if (some := _bins(found, which, condition, "car"))]
        if any(columns):
            rows.append([f"**{condition.replace('_', ' ')}**, {unit}", *[""] * (len(sets) + 1)])
            for number, name in enumerate(bin_names(condition)):
                together = _together([some[number] for some in cars])
                rows.append([name, *(rate(bins[number]) if bins else "-" for bins in columns), rate(together)])
    heads = ["seen", *(f"objects, {which}" for which in sets), "cars, both" if len(sets) > 1 else "cars"]
    return table(heads, rows) if rows else ""


def _together(bins: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One bin of several sets."""
    return Rate(successes=sum(one["successes"] for one in bins), total=sum(one["total"] for one in bins)).as_dict()


def _reported_as(found: Document) -> str:
    """What else is reported on objects of each class, over all sets with objects."""
    rows = []
    for label in SMALL_CLASSES:
        row = [label]
        for which in (PATH_TRACED, SPLAT_RENDERS):
            one = found["sets"].get(which, {})
            others = one.get("reported_as", {}).get(label, {})
            total = one.get("counts", {}).get(label, 0)
            row.append(f"of {total}: " + (", ".join(f"{name} {n}" for name, n in others.items()) or "nothing"))
        rows.append(row)
    return table(["else reported on", PATH_TRACED, SPLAT_RENDERS], rows)


def _other_classes(found: Document) -> str:
    """Detections of classes that no object has, for each set; empty for a detector that knows no others."""
    rows = [
        [name, str(one["pictures"]), ", ".join(f"{label} {n}" for label, n in list(one["other_classes"].items())[:8])]
        for name, one in found["sets"].items()
        if one["other_classes"]
    ]
    return table(["pictures", "number", "other classes reported, the eight most frequent"], rows) if rows else ""
