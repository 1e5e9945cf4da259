"""The transfer matrix as a picture: one square for each detector that was attacked and each that judges."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.dagger.transfer.matrix import Cell, attacked, noise, title
from attacks.observe.drawing import draw_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

_PANELS = {"targeted": "reports the wanted class", "untargeted": "no longer reports the object's class"}


def draw_heat_maps(matrix: Sequence[Cell], path: Path) -> bool:
    """Draw targeted and untargeted success beside each other; white boxes have a frame, noise is the last row.

    Args:
        matrix: The cells.
        path: PNG file to write.

    Returns:
        False, and nothing is written, where matplotlib (the `figures` extra) is not installed.
    """
    names = list(dict.fromkeys(cell.detector for cell in matrix))
    sources = list(dict.fromkeys(cell.sources for cell in matrix))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, 2, sharey=True)
        for axes, (kind, what) in zip(panels, _PANELS.items(), strict=True):
            _draw(axes, matrix, sources, names, kind)
            axes.set_title(f"{kind}: {what}", fontsize=9)
        panels[0].set_ylabel("attacked (frame: white box)", fontsize=8)

    return draw_figure(path, (2 * (1.6 + 1.15 * len(names)), 1.6 + 0.42 * (len(sources) + 1)), draw)


def _draw(
    axes: Axes, matrix: Sequence[Cell], sources: Sequence[tuple[str, ...]], names: Sequence[str], kind: str
) -> None:
    by_place = {(cell.sources, cell.detector): cell for cell in matrix}
    rates = [
        [getattr(by_place[row, name], kind) if (row, name) in by_place else None for name in names] for row in sources
    ]
    rates.append([noise(matrix, name, kind) for name in names])
    shown = [[float("nan") if rate is None or not rate.total else rate.fraction for rate in line] for line in rates]
    axes.imshow(shown, cmap="Oranges", vmin=0, vmax=1.3, aspect="auto")
    for row, line in enumerate(rates):
        for column, rate in enumerate(line):
            text = "-" if rate is None else f"{rate.successes}/{rate.total}"
            axes.text(column, row, text, ha="center", va="center", fontsize=8)
            if row < len(sources) and names[column] in sources[row]:
                axes.add_patch(_frame(column, row))
    axes.set_xticks(range(len(names)), names, rotation=20, ha="right", fontsize=8)
    axes.set_yticks(range(len(rates)), [*(title(row, attacked(matrix)) for row in sources), "random noise"], fontsize=8)
    axes.set_xlabel("judged by", fontsize=8)


def _frame(column: int, row: int) -> Rectangle:
    from matplotlib.patches import Rectangle

    return Rectangle((column - 0.46, row - 0.46), 0.92, 0.92, fill=False, edgecolor="black", linewidth=1.5)
