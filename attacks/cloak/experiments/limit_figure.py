"""The limit of how sharply colour can switch, drawn: by elevation, and against the largest coefficient it needs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from attacks.cloak.experiments.transition_limit import (
    ELEVATIONS,
    layered_curve,
    making_from_above,
    measure_layer_limit,
    one_layer_curve,
)
from attacks.cloak.study.config import StudyConfig
from attacks.cloak.study.figure_files import new_axes, save_figure

_DEGREES = {1: "#bbbbbb", 2: "#7aa6c2", 3: "#1f77b4"}
"""SH degree to the colour of its lines."""


def write_limit_figure(study: StudyConfig, measured: Mapping[str, Any] | None, path: Path) -> None:
    """Draw the switches of one layer and of two, and what width a bound on the coefficients costs.

    Args:
        study: Its trigger counts, and how its layers are made if it has some.
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
    curve, _ = layered_curve(study, making)
    by_elevation.plot(ELEVATIONS, curve, color="#d62728", label=f"two layers, SH {making.degree}")
    if measured is not None and measured.get("from") is not None and measured.get("to") is not None:
        low, high = float(measured["from"]), float(measured["to"])
        by_elevation.axvspan(low, high, color="#d62728", alpha=0.15, label=f"measured, {high - low:.1f} degrees")
    by_elevation.set(
        title="From the benign look (0) to the hidden one (1)",
        xlabel="elevation of the camera, degrees",
        ylabel="fraction of the way",
        ylim=(-0.3, 1.3),
    )
    by_elevation.legend(fontsize=7)
    rows = measure_layer_limit(study)
    for degree, colour in _DEGREES.items():
        own = sorted((row for row in rows if row["sh_degree"] == degree), key=lambda row: row["largest_coefficient"])
        sizes = [row["largest_coefficient"] for row in own]
        by_size.plot(sizes, [row["width"] for row in own], color=colour, marker="o", label=f"two layers, SH {degree}")
    by_size.set(
        title="What a bound on the coefficients costs",
        xlabel="largest SH coefficient",
        ylabel="10 to 90 % of the way, degrees",
        xscale="log",
    )
    by_size.set_ylim(bottom=0)
    by_size.legend(fontsize=7)
    save_figure(figure, path)
