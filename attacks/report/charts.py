"""Charts as SVG inside a page: drawn by matplotlib, coloured by the page, so that they follow light and dark.

matplotlib gets a made-up colour for each part, which becomes a variable of the page's style. Texts stay texts. Nothing
in the SVG names a file, a font or the time, so the same numbers give the same bytes.
"""

from __future__ import annotations

import importlib.util
import io
import re
from collections.abc import Iterator, Sequence
from typing import Any

from attacks.rate import percent
from attacks.report.section import Chart, Line, Point
from attacks.tables import Table
from mi_splat.errors import InvalidValueError, install, message

SIZE = (4.5, 2.9)
"""Width and height in inches of 72 points; a telephone shows them at about their size."""
LONGEST_TICK, LONGEST_LABEL = 24, 48
"""Letters in a chart."""
MOST_TICKS = 12

_INK, _FAINT, _SHADE = "#010101", "#020202", "#030303"
_COLOURS = ("#010102", "#010103", "#010104", "#010105", "#010106", "#010107")
_VARIABLES = {
    _INK: "--ink",
    _FAINT: "--rule",
    _SHADE: "--shade",
    **{colour: f"--line-{place}" for place, colour in enumerate(_COLOURS)},
}
"""Made-up colours to variables of the page's style."""
_PLACES = {"attack": (0, 2, 4), "control": (1, 3, 5), "other": (2, 4, 0)}
"""What a line stands for to the colours that such lines have, one after the other."""
_MARKERS, _DASHES = ("o", "s", "^", "D", "v", "P"), ("-", "--", "-.", ":", "-", "--")
NEEDED = {"jinja2": "Jinja2", "matplotlib": "matplotlib"}


def missing_packages() -> list[str]:
    """What pages need and is not installed."""
    return [name for module, name in NEEDED.items() if importlib.util.find_spec(module) is None]


def need_packages() -> None:
    """Raise, before any work is done, if a page cannot be made.

    Raises:
        InvalidValueError: Jinja2 or matplotlib is not installed.
    """
    missing = missing_packages()
    if missing:
        do = install("report")
        raise InvalidValueError(message(" and ".join(missing), "the package, for pages", "not installed", do))


def places(lines: Sequence[Line]) -> list[int]:
    """Number of the colour of each line: the attack, its control and the rest keep theirs from chart to chart."""
    taken: list[int] = []
    for line in lines:
        wanted = [*_PLACES[line.role], *range(len(_COLOURS))]
        taken.append(next((place for place in wanted if place not in taken), len(taken) % len(_COLOURS)))
    return taken


def svg(chart: Chart, name: str) -> str:
    """A chart as an SVG element.

    Args:
        chart: What is drawn.
        name: Of the chart on its page, which keeps the names inside of it apart from those of others.
    """
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    style: Any = {
        "svg.fonttype": "none",
        "svg.hashsalt": name,
        "text.parse_math": False,
        "font.size": 10,
        "font.family": ["DejaVu Sans"],
        **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.color", "ytick.color", "axes.edgecolor"), _INK),
    }
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(style)
        figure = Figure(figsize=SIZE, layout="constrained")
        figure.patch.set_visible(False)
        _draw(figure.add_subplot(), chart)
        buffer = io.StringIO()
        canvas: Any = FigureCanvasSVG(figure)
        canvas.print_svg(buffer, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return _inline(buffer.getvalue(), name)


def _draw(axes: Any, chart: Chart) -> None:
    axes.patch.set_visible(False)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.grid(axis="y", color=_FAINT, linewidth=0.6)
    axes.set_axisbelow(True)
    if chart.shade is not None:
        axes.axvspan(*chart.shade[:2], facecolor=_SHADE, edgecolor="none")
    if chart.level is not None:
        axes.axhline(chart.level[0], color=_INK, linestyle=":", linewidth=1)
    lines = [line for line in chart.lines if line.points]
    for number, (line, place) in enumerate(zip(lines, places(lines), strict=True)):
        shift = 0.12 * (number - (len(lines) - 1) / 2) if chart.ticks else 0.0
        _draw_line(axes, line, place, shift, connected=chart.connected)
    if chart.logarithmic:
        axes.set_xscale("log")
        axes.minorticks_off()
        values = sorted({point.x for line in lines for point in line.points})
        axes.set_xticks(values, [f"{value:g}" for value in values])
    if chart.fractions:
        axes.set_ylim(-0.03, 1.03)
        axes.set_yticks([0, 0.25, 0.5, 0.75, 1], ["0 %", "25 %", "50 %", "75 %", "100 %"])
    if chart.ticks:
        axes.set_xlim(-0.5, len(chart.ticks) - 0.5)
        named = range(0, len(chart.ticks), -(-len(chart.ticks) // MOST_TICKS))
        words = [_short(chart.ticks[place], LONGEST_TICK) for place in named]
        turned = {"rotation": 30, "ha": "right", "rotation_mode": "anchor"} if max(map(len, words)) > 9 else {}
        axes.set_xticks(list(named), words, **turned)
    elif not chart.logarithmic and all(point.x.is_integer() for line in lines for point in line.points):
        axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_xlabel(_short(chart.x_label, LONGEST_LABEL))
    axes.set_ylabel(_short(chart.y_label, LONGEST_LABEL))


def _short(text: str, most: int) -> str:
    """The start of a text that would not fit; the page has all of it beside the chart."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def _draw_line(axes: Any, line: Line, place: int, shift: float, *, connected: bool) -> None:
    """Points with their intervals: as a band where they are connected, as bars where they are not.

    Args:
        axes: Where.
        line: Its points.
        place: Number of its colour.
        shift: By how much it is moved, so that bars do not hide each other.
        connected: Whether the points belong together.
    """
    colour = _COLOURS[place]
    points = sorted(line.points, key=lambda point: point.x)
    x, y = [point.x + shift for point in points], [point.y for point in points]
    style = {"color": colour, "marker": _MARKERS[place], "markersize": 4, "linewidth": 1.6}
    axes.plot(x, y, linestyle=_DASHES[place] if connected else "none", **style)
    sure = [(at, point) for at, point in zip(x, points, strict=True) if point.low is not None]
    if connected and len(sure) > 1:
        low, high = ([getattr(point, end) for _, point in sure] for end in ("low", "high"))
        axes.fill_between([at for at, _ in sure], low, high, color=colour, alpha=0.18, linewidth=0)
    else:
        for at, point in sure:
            axes.plot([at, at], [point.low, point.high], color=colour, linewidth=1.6)


def _inline(text: str, name: str) -> str:
    """What matplotlib has written as an element of a page: colours and names are the page's, nothing else is there."""
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    text = re.sub(r"<defs>\s*<style.*?</style>\s*</defs>\s*", "", text, flags=re.DOTALL)
    text = re.sub(r'\sid="', f' id="{name}-', text)
    text = re.sub(r'(xlink:href="|url\()#', rf"\g<1>#{name}-", text)
    text = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font-size: \g<1>px", text)
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, f"var({variable})")
    text = re.sub(r'(<svg\b[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg\b[^>]*?) height="[^"]*"', r"\1", text, count=1)
    return text.replace("<svg", '<svg aria-hidden="true" focusable="false"', 1).strip()


def values_of(chart: Chart) -> Table:
    """The numbers that a chart shows, for whoever cannot see it."""
    lines = [line for line in chart.lines if line.points]
    every = sorted({point.x for line in lines for point in line.points})
    rows = []
    for x in every:
        place = chart.ticks[int(x)] if chart.ticks else f"{x:g}"
        rows.append((place, *(_words(chart, line, x) for line in lines)))
    return Table(
        caption=f"{chart.title}: the numbers", head=(chart.x_label, *(one.name for one in lines)), rows=tuple(rows)
    )


def _words(chart: Chart, line: Line, x: float) -> str:
    return "; ".join(_point(chart, point) for point in line.points if point.x == x) or "-"


def _point(chart: Chart, point: Point) -> str:
    if not chart.fractions:
        return f"{point.y:.4g}"
    low = "" if point.low is None or point.high is None else f" ({percent(point.low)} to {percent(point.high)})"
    return f"{percent(point.y)}{low}"


def legend(chart: Chart) -> Iterator[tuple[int, str]]:
    """Number of the colour, and name, of each line."""
    lines = [line for line in chart.lines if line.points]
    yield from zip(places(lines), (line.name for line in lines), strict=True)
