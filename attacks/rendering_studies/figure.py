"""The rates of a rendering study as a picture: a line over the conditions for each group of attacks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.observe.drawing import draw_figure
from attacks.rendering_studies.rates import Outcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANELS = {"targeted": "wanted class reported", "untargeted": "own class gone"}
_MARKS = "osD^vPX*"


def draw_rates(title: str, found: Sequence[Outcome], path: Path) -> bool:
    """Draw how often the wanted class is reported and how often the object's own is gone, with 95 % intervals.

    Args:
        title: What stands above.
        found: The outcomes.
        path: PNG file to write.

    Returns:
        False, and nothing is written, where matplotlib (the `figures` extra) is not installed.
    """
    detectors = list(dict.fromkeys(outcome.group.detector for outcome in found))
    conditions = list(dict.fromkeys(outcome.condition for outcome in found))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(detectors), 2, sharex=True, sharey=True, squeeze=False)
        for row, detector in zip(panels, detectors, strict=True):
            own = [outcome for outcome in found if outcome.group.detector == detector]
            for axes, (kind, what) in zip(row, _PANELS.items(), strict=True):
                _draw(axes, own, conditions, kind)
                axes.set_title(f"{what} ({detector})", fontsize=9)
        lines, names = panels[0][0].get_legend_handles_labels()
        figure.legend(lines, names, loc="outside lower center", ncols=min(3, len(names)), fontsize=7)
        figure.suptitle(title, fontsize=10)

    return draw_figure(path, (2 * (2.2 + 0.55 * len(conditions)), 1.6 + 2.6 * len(detectors)), draw)


def _draw(axes: Axes, found: Sequence[Outcome], conditions: Sequence[str], kind: str) -> None:
    groups = list(dict.fromkeys(outcome.group for outcome in found))
    places = {condition: place for place, condition in enumerate(conditions)}
    for number, group in enumerate(groups):
        shift = 0.5 * ((number + 0.5) / len(groups) - 0.5)
        here = [outcome for outcome in found if outcome.group == group and getattr(outcome, kind).total]
        rates = [getattr(outcome, kind) for outcome in here]
        axes.errorbar(
            [places[outcome.condition] + shift for outcome in here],
            [rate.fraction for rate in rates],
            yerr=[
                [max(0.0, rate.fraction - rate.interval[0]) for rate in rates],
                [max(0.0, rate.interval[1] - rate.fraction) for rate in rates],
            ],
            fmt=_MARKS[number % len(_MARKS)],
            markersize=4,
            elinewidth=0.8,
            label=f"{group.source}: {group.ball}",
        )
    axes.set_xticks(range(len(conditions)), conditions, rotation=30, ha="right", fontsize=7)
    axes.set_ylim(-0.03, 1.03)
    axes.grid(axis="y", linewidth=0.3)
