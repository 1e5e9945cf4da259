"""The limit of how sharply colour can switch, drawn: by elevation, and against the largest coefficient it needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from attacks.cloak.config import StudyConfig
from attacks.cloak.experiments.transition_limit import ELEVATIONS, layered_curve, making_from_above, one_layer_curve
from attacks.cloak.plots import new_axes, save_figure

_DEGREES = {1: "#bbbbbb", 2: "#7aa6c2", 3: "#1f77b4"}
"""SH degree to the colour of its lines."""

_TWO_LAYERS, _WITH_BANDS = "#d62728", "#8c3fa8"
"""Colours of what two layers show, and of what they show with a layer more for each edge."""


def write_limit_figure(
    study: StudyConfig,
    limits: Mapping[str, Sequence[Mapping[str, Any]]],
    measured: Mapping[str, Any] | None,
    path: Path,
) -> None:
    """Draw the switches of one layer, of two and of more, and the widths that go with the largest coefficients.

    Args:
        study: Its trigger counts, and how its layers are made if it has some.
        limits: `two_layers` of `measure_layer_limit` and `bands` of `measure_band_limit`.
        measured: The entry `transition` of a finished study's summary, which is drawn beside; None draws none.
        path: PNG file to write.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around, or matplotlib is not installed.
        SplatFileError: The file cannot be written.
    """
    figure, (by_elevation, by_size) = new_axes(2, columns=2)
    making = making_from_above(study)
    for degree, colour in _DEGREES.items():
        by_elevation.plot(
            ELEVATIONS, one_layer_curve(study, degree)[0], color=colour, linestyle="--", label=f"one layer, SH {degree}"
        )
    two = replace(making, band=0.0)
    by_elevation.plot(
        ELEVATIONS, layered_curve(study, two)[0], color=_TWO_LAYERS, label=f"two layers, SH {making.degree}"
    )
    if making != two:
        label = f"a layer more for each edge, SH {making.degree}"
        by_elevation.plot(ELEVATIONS, layered_curve(study, making)[0], color=_WITH_BANDS, label=label)
    if measured is not None and measured.get("from") is not None and measured.get("to") is not None:
        low, high = float(measured["from"]), float(measured["to"])
        drawn = _TWO_LAYERS if making == two else _WITH_BANDS
        by_elevation.axvspan(low, high, color=drawn, alpha=0.15, label=f"measured, {high - low:.1f} degrees")
    by_elevation.set(
        title="From the benign look (0) to the hidden one (1)",
        xlabel="elevation of the camera, degrees",
        ylabel="fraction of the way",
        ylim=(-0.3, 1.3),
    )
    by_elevation.legend(fontsize=7)
    for degree, colour in _DEGREES.items():
        sizes, widths = _of_degree(limits["two_layers"], degree)
        by_size.plot(sizes, widths, color=colour, marker="o", label=f"two layers, SH {degree}")
        sizes, widths = _of_degree(limits["bands"], degree)
        if sizes:
            label = f"a layer more for each edge, SH {degree}"
            by_size.plot(sizes, widths, color=colour, marker="x", linestyle="", label=label)
    by_size.set(
        title="What the switch needs",
        xlabel="largest SH coefficient",
        ylabel="10 to 90 % of the way, degrees",
        xscale="log",
    )
    by_size.set_ylim(bottom=0)
    by_size.legend(fontsize=7)
    save_figure(figure, path)


def _of_degree(rows: Sequence[Mapping[str, Any]], degree: int) -> tuple[list[float], list[float]]:
    """Largest coefficients and widths of the rows of one SH degree, in the order of the former."""
    own = sorted((row for row in rows if row["sh_degree"] == degree), key=lambda row: row["largest_coefficient"])
    return [row["largest_coefficient"] for row in own], [row["width"] for row in own]
