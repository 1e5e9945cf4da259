"""What all plots of a study share: axes below each other, rates with their intervals, and files that appear whole."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from attacks.cloak.study.pipeline import CLEAN, CLOAKED
from attacks.rate import Rate
from mi_splat.errors import InvalidValueError, install, message
from mi_splat.io.atomic import atomic_write

TRUE = "path traced"
"""Name of the pictures of the scene as it is."""
COLOURS = {CLEAN: "#1f77b4", CLOAKED: "#d62728", TRUE: "#333333"}
"""Name of a splat, or of pictures of none, to the colour of its lines."""


def need_matplotlib() -> None:
    """Raise if plots cannot be drawn.

    Raises:
        InvalidValueError: matplotlib is not installed.
    """
    if importlib.util.find_spec("matplotlib") is None:
        do = install("figures")
        raise InvalidValueError(message("matplotlib", "the package, for plots", "not installed", do))


def new_axes(count: int, *, columns: int = 1) -> tuple[Any, list[Any]]:
    """A figure, and its axes from left to right, then from the top down.

    Raises:
        InvalidValueError: matplotlib is not installed.
    """
    need_matplotlib()
    from matplotlib.figure import Figure

    rows = math.ceil(count / columns)
    figure = Figure(figsize=(7.5 if columns == 1 else 5.6 * columns, 3.4 * rows), dpi=130, layout="constrained")
    return figure, [figure.add_subplot(rows, columns, place + 1) for place in range(count)]


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure as PNG.

    Raises:
        SplatFileError: The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    with atomic_write(path) as file:
        figure.savefig(file, format="png")


def draw_rates(axis: Any, points: Sequence[tuple[float, Rate]], which: str, **style: object) -> None:
    """A line of rates with their intervals.

    Args:
        axis: Where.
        points: Place on the axis, and rate.
        which: Key of `COLOURS`, and label.
        style: More of matplotlib's settings of the line.
    """
    fractions = [rate.fraction for _, rate in points]
    below = [rate.fraction - rate.interval[0] for _, rate in points]
    above = [rate.interval[1] - rate.fraction for _, rate in points]
    settings = {"color": COLOURS[which], "marker": "o", "markersize": 3, "capsize": 2, "label": which, **style}
    axis.errorbar([place for place, _ in points], fractions, yerr=np.maximum([below, above], 0.0), **settings)
