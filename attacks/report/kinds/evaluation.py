"""What `mi-splat evaluate` leaves behind: a clean and an attacked splat from many cameras."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import starmap
from pathlib import Path
from typing import Any

from attacks.observe.comparison import compare
from attacks.observe.rates import comparison_measures
from attacks.observe.rows import ROWS
from attacks.rate import Rate, number
from attacks.report.checking import Tables
from attacks.report.kinds.thresholds import threshold_charts
from attacks.report.section import Chart, Figure, Line, Picture, Role, Section, listed, plural, settings
from attacks.tables import Table

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


def read(folder: Path, record: Mapping[str, Any]) -> Section:
    """The section of an evaluation."""
    detectors = record["detectors"]
    name, first = next(iter(detectors.items()))
    headline, control = _headline(name, first)
    rates = [{"detector": name, **judged} for name, judged in detectors.items()]
    curves, at = threshold_charts(folder, partial(comparison_measures, targeted=first["target"] is not None), _CURVES)
    return Section(
        kind="a clean and an attacked splat, judged",
        title=f"{Path(record['attacked']).name} against {Path(record['clean']).name}",
        done=(
            f"{listed(list(detectors))} looked at the clean splat {record['clean']} and at the attacked one "
            f"{record['attacked']} from {plural(len(record['cameras']), 'camera')}, in 8-bit pictures. A detection "
            f"counts from {record['min_confidence']:g}. Views count in which the object shows "
            f"({record['object_gaussians']:,} Gaussians)."
        ),
        conclusion=f"{' '.join(starmap(_told, detectors.items()))} This says nothing of other cameras or detectors.",
        headline=headline,
        control=control,
        figures=tuple(figure for name, judged in detectors.items() for figure in _figures(name, judged)),
        warnings=record["warnings"],
        pictures=tuple(
            Picture(
                path=folder / f"{name}.png", caption=f"{name}: clean on the left, attacked on the right.", wide=True
            )
            for name in detectors
        ),
        charts=(_by_detector(rates, targeted=first["target"] is not None), *curves),
        tables=(
            Table.of(
                "Each detector",
                {
                    "detector": "detector",
                    "the object is": lambda judged: judged["original"] or "unknown",
                    "views": "views",
                    **{words: key for key, words in _RATES.items()},
                    "pictures": lambda judged: number(judged["psnr"], unit="dB"),
                },
                rates,
            ),
            *at,
        ),
        configuration=settings(
            {
                **{key: record[key] for key in _CONDITIONS if key in record},
                "cameras": [camera["name"] for camera in record["cameras"]],
                "weights": record["fingerprints"],
            }
        ),
    )


def figures(record: Mapping[str, Any], tables: Tables) -> Mapping[str, Any]:
    """Every rate of an evaluation, of its rows."""
    compared = compare(tables[ROWS], confidence=record["min_confidence"])
    return {"detectors": {judged.detector: judged.as_dict() for judged in compared}}


def _headline(name: str, judged: Mapping[str, Any]) -> tuple[Figure, Figure]:
    rates = {key: Rate.of(judged[key]) for key in _RATES if judged.get(key)}
    if judged.get("target"):
        what = f"{name} reports {judged['target']} on the"
        attacked, clean, note = rates["target_attacked"], rates["target_clean"], ""
    else:
        what = f"{name} misses the {judged['original'] or 'object'} on the"
        attacked, clean = rates["missed"], rates["found_clean"].failures
        note = "of the views in which it is found in the clean one"
    return (
        Figure(label=f"{what} attacked splat", rate=attacked, note=note),
        Figure(label=f"{what} clean splat", rate=clean),
    )


def _by_detector(rates: Sequence[Mapping[str, Any]], *, targeted: bool) -> Chart:
    """How often each detector reports the target, or else finds the object."""
    key, title = ("target", "Target reported") if targeted else ("found", "Object found")
    return Chart.bars(
        f"{title}, by detector",
        ("detector", "views"),
        [judged["detector"] for judged in rates],
        Line.of("attacked", "attack", [judged.get(f"{key}_attacked") for judged in rates]),
        Line.of("clean (control)", "control", [judged.get(f"{key}_clean") for judged in rates]),
    )


def _told(name: str, judged: Mapping[str, Any]) -> str:
    attacked, clean = _headline(name, judged)
    return f"{attacked.label}: {attacked.counts}; {clean.label}: {clean.counts}."


def _figures(name: str, judged: Mapping[str, Any]) -> Iterator[Figure]:
    """What one detector makes of both splats."""
    for key, words in _RATES.items():
        if judged.get(key):
            yield Figure(label=f"{name}: {words}", rate=Rate.of(judged[key]))
    yield Figure(label=f"{name}: pictures, attacked against clean", words=number(judged["psnr"], unit="dB"))
