"""Recall by how objects are seen, drawn for one detector or several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from attacks.detectors.evaluation.held_out import PATH_TRACED, SPLAT_RENDERS
from attacks.detectors.evaluation.recall import UNITS, bin_names
from attacks.detectors.training.curves import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DRAWN = ("elevation", "distance", "size", "brightness")


def draw_recall(several: Sequence[Mapping[str, Any]]) -> Figure:
    """Recall in the bins of four conditions with 95 % Wilson intervals; empty bins are left out.

    A single detector has a line for path-traced pictures and one for renders of splats; of several each has one line,
    for path-traced pictures.

    Args:
        several: What `mi-splat evaluate-detector` wrote, one document a detector.

    Raises:
        MiSplatError: matplotlib is not installed.
    """
    if len(several) == 1:
        lines = [(which, several[0], which) for which in (PATH_TRACED, SPLAT_RENDERS)]
    else:
        lines = [(f"{found['detector']} at {found['confidence']:g}", found, PATH_TRACED) for found in several]
    lines = [(name, found, which) for name, found, which in lines if "recall_by" in found["sets"].get(which, {})]
    figure = new_figure(11, 3.1)
    for axes, condition in zip(figure.subplots(1, len(_DRAWN), sharey=True), _DRAWN, strict=True):
        for number, (name, found, which) in enumerate(lines):
            bins = found["sets"][which]["recall_by"].get(condition, {}).get("all", [])
            _draw_line(axes, bins, name, shift=0.06 * (number - (len(lines) - 1) / 2))
        names = [name.replace(" or more", "+").replace(" to ", "-") for name in bin_names(condition)]
        axes.set_xticks(range(len(names)), names, fontsize=7)
        axes.set(xlabel=f"{condition}, {UNITS[condition]}", ylim=(-0.02, 1.02))
        axes.grid(alpha=0.3)
    first = figure.axes[0]
    first.set_ylabel("recall at IoU 0.5")
    figure.legend(*first.get_legend_handles_labels(), loc="outside upper center", ncols=min(len(lines), 6), fontsize=8)
    return figure


def _draw_line(axes: Axes, bins: Sequence[Mapping[str, Any]], name: str, *, shift: float) -> None:
    """One line with its intervals, each bin at its number."""
    there = [(number, one) for number, one in enumerate(bins) if one["total"]]
    values = [one["rate"] for _, one in there]
    lows = [one["rate"] - one["interval"][0] for _, one in there]
    highs = [one["interval"][1] - one["rate"] for _, one in there]
    below, above = ([max(0.0, value) for value in some] for some in (lows, highs))
    axes.errorbar(
        [number + shift for number, _ in there],
        values,
        yerr=[below, above],
        marker="o",
        markersize=3,
        linewidth=1,
        capsize=2,
        label=name,
    )
