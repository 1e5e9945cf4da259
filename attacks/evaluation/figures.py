"""A figure as a PNG file, where matplotlib is installed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from mi_splat.io.atomic import atomic_write

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_figure(path: Path, size: tuple[float, float], draw: Callable[[Figure], None]) -> bool:
    """Write a figure.

    Args:
        path: PNG file to write.
        size: Width and height, inches.
        draw: Fills an empty figure.

    Returns:
        False, and nothing is written, where matplotlib (the `figures` extra) is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        return False
    figure = Figure(figsize=size, layout="constrained")
    draw(figure)
    canvas = FigureCanvasAgg(figure)
    with atomic_write(path) as file:
        canvas.print_png(file)  # type: ignore[no-untyped-call]
    return True
