"""What `mi-splat evaluate` leaves behind: a clean and an attacked splat from many cameras."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from attacks.observe.comparison import compare
from attacks.observe.measures import comparison_measures
from attacks.observe.rows import ROWS
from attacks.rate import Rate
from attacks.report.checking import Tables
from attacks.report.section import Chart, Figure, Line, Picture, Role, Section, doubts_of
from attacks.report.stories.thresholds import threshold_charts
from attacks.report.wording import listed, number, plural, rate_of, settings
from attacks.tables import Table, cell

KIND = "a clean and an attacked splat, judged"
_CONDITIONS = (
    *("clean", "attacked", "clean_hash", "attacked_hash", "selection", "object_gaussians", "original"),
    *("min_confidence", "background", "near"),
)
_RATES = {
    "found_clean": "found, clean",
    "found_attacked": "found, attacked",
    "missed": "missed attacked, of those found clean",
    "target_clean": "taken for the target, clean",
    "target_attacked": "taken for the target, attacked",
}
_CURVES: dict[str, tuple[str, Role]] = {
    "missed": ("missed attacked", "attack"),
    "target_attacked": ("taken for the target, attacked", "attack"),
    "target_clean": ("taken for the target, clean", "control"),
}
"""Rates that are drawn over the confidence."""


def read(folder: Path, found: Mapping[str, Any]) -> Section:
    """The section of an evaluation.

    Args:
        folder: Where it lies.
        found: Its result.json.
    """
    detectors = found["detectors"]
    name, first = next(iter(detectors.items()))
    headline, control = _headline(name, first)
    measures = partial(comparison_measures, targeted=first["target"] is not None)
    curves, at = threshold_charts(folder, measures, _CURVES)
    assert headline.rate is not None
    pictures = [
        Picture(
            path=folder / f"{detector}.png",
            caption=f"{detector}: clean on the left, attacked on the right.",
            alt=f"Pairs of pictures with the boxes of {detector}, clean and attacked",
            wide=True,
        )
        for detector in detectors
    ]
    return Section(
        kind=KIND,
        title=f"{Path(found['attacked']).name} against {Path(found['clean']).name}",
        done=(
            f"{listed(list(detectors))} looked at the clean splat {found['clean']} and at the attacked one "
            f"{found['attacked']} from {plural(len(found['cameras']), 'camera')}, in 8-bit pictures. A detection "
            f"counts from {found['min_confidence']:g}. Views count in which the object shows "
            f"({found['object_gaussians']:,} Gaussians)."
        ),
        conclusion=(
            f"{headline.label}: {headline.counts}; {control.label if control else 'no control'}"
            f"{f': {control.counts}' if control else ''}. This says nothing of other cameras or detectors."
        ),
        headline=headline,
        control=control,
        figures=(Figure(label=f"{name}: pictures, attacked against clean", words=number(first["psnr"], unit="dB")),),
        warnings=(
            *found["warnings"],
            *doubts_of(headline.rate, control.rate if control else None, what="views"),
        ),
        pictures=tuple(pictures),
        charts=(*_charts(detectors), *curves),
        tables=(_table(detectors), *at),
        configuration=settings(
            {
                **{key: found[key] for key in _CONDITIONS if key in found},
                "cameras": [camera["name"] for camera in found["cameras"]],
                "weights": found["fingerprints"],
            }
        ),
    )


def figures(record: Mapping[str, Any], tables: Tables) -> Mapping[str, Any]:
    """Every rate of an evaluation, of its rows."""
    compared = compare(tables[ROWS], confidence=record["min_confidence"])
    return {"detectors": {one.detector: one.as_dict() for one in compared}}


def _headline(name: str, rates: Mapping[str, Any]) -> tuple[Figure, Figure | None]:
    if rates.get("target"):
        return (
            Figure(
                label=f"{name} reports {rates['target']} on the attacked splat", rate=Rate.of(rates["target_attacked"])
            ),
            Figure(label=f"{name} reports {rates['target']} on the clean splat", rate=Rate.of(rates["target_clean"])),
        )
    thing, clean = rates["original"] or "object", Rate.of(rates["found_clean"])
    gone = type(clean)(successes=clean.total - clean.successes, total=clean.total)
    return (
        Figure(
            label=f"{name} misses the {thing} on the attacked splat",
            rate=Rate.of(rates["missed"]),
            note="of the views in which it is found in the clean one",
        ),
        Figure(label=f"{name} misses the {thing} on the clean splat", rate=gone),
    )


def _charts(detectors: Mapping[str, Any]) -> tuple[Chart, ...]:
    def line(name: str, role: Role, key: str) -> Line:
        return Line.of(name, role, [rate_of(one.get(key)) for one in detectors.values()])

    targeted = any(one.get("target") for one in detectors.values())
    which, words = ("target", "target reported") if targeted else ("found", "object found")
    return (
        Chart(
            title=f"{words.capitalize()}, by detector",
            caption="Bars are 95 % intervals.",
            x_label="detector",
            y_label="views",
            lines=(
                line("attacked", "attack", f"{which}_attacked"),
                line("clean (control)", "control", f"{which}_clean"),
            ),
            ticks=tuple(detectors),
            connected=False,
        ),
    )


def _table(detectors: Mapping[str, Any]) -> Table:
    rows = [
        (
            name,
            str(one["original"] or "unknown"),
            str(one["views"]),
            *(cell(one.get(key)) for key in _RATES),
            number(one["psnr"], unit="dB"),
        )
        for name, one in detectors.items()
    ]
    head = ("detector", "the object is", "views", *_RATES.values(), "pictures")
    return Table(caption="Each detector", head=head, rows=tuple(rows))
