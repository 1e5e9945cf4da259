"""The page: sections as one HTML file that has everything in it, no script, and no
address of anybody.
"""

import base64
import importlib.metadata
import importlib.util
import io
import math
import re
import warnings
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from PIL import Image

from attacks.figures.rate import percent
from attacks.figures.tables import Table
from attacks.report.section import Chart, Line, Section, capital, listed
from mi_splat.errors import InvalidValueError, install, printable
from mi_splat.io.documents import save_text
from mi_splat.io.folders import check_new_file
from mi_splat.io.picture_files import load_picture

# Charts as SVG inside a page: drawn by matplotlib, coloured by the page, so that they
# follow light and dark.
#
# matplotlib gets a made-up colour for each part, which becomes a variable of the page's
# style. Texts stay texts. Nothing in the SVG names a file, a font or the time, so the
# same numbers give the same bytes.

SIZE = (4.5, 2.9)
"""Width and height in inches of 72 points; a telephone shows them at about their
size.
"""
DOME_SIZE = (4.5, 4.2)
LONGEST_TICK = 24
LONGEST_LABEL = 48
"""Letters in a chart."""
MOST_TICKS = 12

_INK = "#010101"
_FAINT = "#020202"
_SHADE = "#030303"
_COLOURS = ("#010102", "#010103", "#010104", "#010105", "#010106", "#010107")
_VARIABLES = {
    _INK: "--ink",
    _FAINT: "--rule",
    _SHADE: "--shade",
    **{colour: f"--line-{number}" for number, colour in enumerate(_COLOURS)},
}
"""Made-up colours to variables of the page's style."""
_PREFERRED = {"attack": (0, 2, 4), "control": (1, 3, 5), "other": (2, 4, 0)}
"""What a line stands for to the colours that such lines have, one after the other."""
_MARKERS = ("o", "s", "^", "D", "v", "P")
_DASHES = ("-", "--", "-.", ":", "-", "--")
NEEDED = {"jinja2": "Jinja2", "matplotlib": "matplotlib"}


def need_packages() -> None:
    """Raise, before any work is done, if a page cannot be made."""
    missing = [
        name
        for module, name in NEEDED.items()
        if importlib.util.find_spec(module) is None
    ]
    if missing:
        raise InvalidValueError.of(
            " and ".join(missing),
            "the package, for pages",
            "not installed",
            install("report"),
        )


def colours(chart: Chart) -> list[int]:
    """Number of the colour of each line: the attack, its control and the rest keep
    theirs from chart to chart.
    """
    taken: list[int] = []
    for line in chart.drawn:
        wanted = [*_PREFERRED[line.role], *range(len(_COLOURS))]
        taken.append(
            next(
                (number for number in wanted if number not in taken),
                len(taken) % len(_COLOURS),
            )
        )
    return taken


def svg(chart: Chart, name: str) -> str:
    """A chart as an SVG element."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    style: Any = {
        "svg.fonttype": "none",
        "svg.hashsalt": name,
        "text.parse_math": False,
        "font.size": 10,
        "font.family": ["DejaVu Sans"],
        **dict.fromkeys(
            (
                "text.color",
                "axes.labelcolor",
                "xtick.color",
                "ytick.color",
                "axes.edgecolor",
            ),
            _INK,
        ),
    }
    with matplotlib.rc_context(), warnings.catch_warnings():
        # the browser has other fonts: text stays text
        warnings.filterwarnings("ignore", "Glyph .* missing")
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(style)
        figure = Figure(figsize=DOME_SIZE if chart.dome else SIZE, layout="constrained")
        figure.patch.set_visible(False)
        if chart.dome:
            _draw_dome(figure.add_subplot(projection="polar"), chart)
        else:
            _draw(figure.add_subplot(), chart)
        buffer = io.StringIO()
        canvas: Any = FigureCanvasSVG(figure)
        canvas.print_svg(
            buffer, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
        )
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
    lines = chart.drawn
    for number, (line, colour) in enumerate(zip(lines, colours(chart), strict=True)):
        shift = 0.12 * (number - (len(lines) - 1) / 2) if chart.ticks else 0.0
        _draw_line(axes, line, colour, shift, connected=chart.connected)
    if chart.fractions:
        axes.set_ylim(-0.03, 1.03)
        axes.set_yticks(
            [0, 0.25, 0.5, 0.75, 1], ["0 %", "25 %", "50 %", "75 %", "100 %"]
        )
    if chart.ticks:
        axes.set_xlim(-0.5, len(chart.ticks) - 0.5)
        named = range(0, len(chart.ticks), -(-len(chart.ticks) // MOST_TICKS))
        names = [_short(chart.ticks[number], LONGEST_TICK) for number in named]
        if max(map(len, names)) > 9:
            turned = {"rotation": 30, "ha": "right", "rotation_mode": "anchor"}
        else:
            turned = {}
        axes.set_xticks(list(named), names, **turned)
    elif all(point.x.is_integer() for line in lines for point in line.points):
        axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_xlabel(_short(chart.x_label, LONGEST_LABEL))
    axes.set_ylabel(_short(chart.y_label, LONGEST_LABEL))


def _draw_dome(axes: Any, chart: Chart) -> None:
    """Directions as seen from above: the middle is an elevation of 90 degrees, each
    ring 30 degrees less.
    """
    axes.patch.set_visible(False)
    axes.grid(color=_FAINT, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines["polar"].set_color(_FAINT)
    for line, number in zip(chart.drawn, colours(chart), strict=True):
        style = {
            "color": _COLOURS[number],
            "marker": _MARKERS[number],
            "markersize": 4,
            "linestyle": "none",
        }
        axes.plot(
            [math.radians(point.x) for point in line.points],
            [90 - point.y for point in line.points],
            **style,
        )
    rings = range(
        30,
        (
            91
            if all(point.y > -1 for line in chart.drawn for point in line.points)
            else 181
        ),
        30,
    )
    axes.set_rlim(0, rings[-1])
    axes.set_rgrids(rings, [f"{90 - ring}°" for ring in rings], angle=80, fontsize=8)


def _short(text: str, most: int) -> str:
    """The start of a text that would not fit; the page has all of it beside the
    chart.
    """
    if len(text) <= most:
        return text
    return f"{text[: most - 3]}..."


def _draw_line(
    axes: Any, line: Line, number: int, shift: float, *, connected: bool
) -> None:
    """Points with their intervals, a band where they are connected, else bars, moved so
    that none hides another.
    """
    colour = _COLOURS[number]
    points = sorted(line.points, key=lambda point: point.x)
    x = [point.x + shift for point in points]
    y = [point.y for point in points]
    style = {
        "color": colour,
        "marker": _MARKERS[number],
        "markersize": 4,
        "linewidth": 1.6,
    }
    axes.plot(x, y, linestyle=_DASHES[number] if connected else "none", **style)
    ends = [
        (at, point.low, point.high)
        for at, point in zip(x, points, strict=True)
        if point.low is not None
    ]
    if connected and len(ends) > 1:
        axes.fill_between(
            *zip(*ends, strict=True), color=colour, alpha=0.18, linewidth=0
        )
    else:
        for at, low, high in ends:
            axes.plot([at, at], [low, high], color=colour, linewidth=1.6)


def _inline(text: str, name: str) -> str:
    """What matplotlib has written as an element of a page: colours and names are the
    page's, nothing else is there.
    """
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
    every = sorted({point.x for line in chart.drawn for point in line.points})
    names = (chart.ticks[int(x)] if chart.ticks else f"{x:g}" for x in every)
    rows = (
        (name, *(_heights(chart, line, x) for line in chart.drawn))
        for name, x in zip(names, every, strict=True)
    )
    head = (chart.x_label, *(line.name for line in chart.drawn))
    return Table(caption=f"{chart.title}: the numbers", head=head, rows=tuple(rows))


def _heights(chart: Chart, line: Line, x: float) -> str:
    """What a line shows at a place."""
    heights = []
    for point in (point for point in line.points if point.x == x):
        if point.low is None or point.high is None:
            interval = ""
        else:
            interval = f" ({percent(point.low)} to {percent(point.high)})"
        heights.append(
            f"{percent(point.y)}{interval}" if chart.fractions else f"{point.y:.4g}"
        )
    return "; ".join(heights) or "-"


def legend(chart: Chart) -> Iterator[tuple[int, str]]:
    """Number of the colour, and name, of each line."""
    yield from zip(colours(chart), (line.name for line in chart.drawn), strict=True)


ENDINGS = (".html", ".htm")
LONGEST_SIDE = 1200
"""Pixels that the longer side of an image on a page has at most."""
MOST_NAMED = 3
"""Results that are named in the heading of a page without a title."""


def write_page(
    sections: Sequence[Section],
    path: Path,
    *,
    title: str | None = None,
    force: bool = False,
) -> None:
    """Write the page; the file appears whole or not at all."""
    text = page_text(sections, title=title)
    check_new_file(path, ENDINGS, force=force)
    save_text(text, path)


def page_text(sections: Sequence[Section], *, title: str | None = None) -> str:
    """The page as HTML; the same sections give the same text, in which nothing is left
    that a terminal would obey.
    """
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined
    )
    template = environment.from_string(
        resources.files("attacks.report").joinpath("page.html").read_text("utf-8")
    )
    return printable(
        template.render(
            title=title or usual_title(sections),
            parts=[
                {"name": name, **_part(number, section)}
                for number, (name, section) in enumerate(
                    zip(names(sections), sections, strict=True), start=1
                )
            ],
            comparisons=list(comparisons(sections)),
            version=importlib.metadata.version("mi-splat"),
        )
    )


def usual_title(sections: Sequence[Section]) -> str:
    """Heading of a page whose user gave none."""
    if len(sections) == 1:
        return capital(sections[0].kind)
    if len(sections) <= MOST_NAMED:
        return listed(names(sections))
    return f"{len(sections)} results"


def names(sections: Sequence[Section]) -> list[str]:
    """What each result is called on a page: its title, with the name of its folder
    where several have the same.
    """
    titles = [section.title for section in sections]
    return [
        title if titles.count(title) == 1 else f"{title} ({Path(section.folder).name})"
        for title, section in zip(titles, sections, strict=True)
    ]


def comparisons(sections: Sequence[Section]) -> Iterator[dict[str, Any]]:
    """For each kind with several results: their figures side by side, and the settings
    in which they differ.
    """
    kinds: dict[str, list[tuple[str, Section]]] = {}
    for name, section in zip(names(sections), sections, strict=True):
        kinds.setdefault(section.kind, []).append((name, section))
    for kind, members in kinds.items():
        if len(members) > 1:
            head = tuple(name for name, _ in members)
            figures = _rows(
                [
                    {figure.label: figure.cell for figure in section.all_figures}
                    for _, section in members
                ]
            )
            settings = _rows(
                [
                    {"folder": section.folder, **dict(section.configuration)}
                    for _, section in members
                ]
            )
            differing = tuple(row for row in settings if len(set(row[1:])) > 1)
            yield {
                "kind": kind,
                "figures": Table(
                    caption="Figures, with their 95 % intervals",
                    head=("figure", *head),
                    rows=figures,
                ),
                "settings": Table(
                    caption="Settings that differ",
                    head=("setting", *head),
                    rows=differing,
                ),
            }


def _rows(columns: Sequence[dict[str, str]]) -> tuple[tuple[str, ...], ...]:
    """A row for each name in any of the columns."""
    names = dict.fromkeys(name for column in columns for name in column)
    return tuple(
        (name, *(column.get(name, "-") for column in columns)) for name in names
    )


def _part(number: int, section: Section) -> dict[str, Any]:
    """A section with what the template needs besides: images as addresses, charts as
    SVG.
    """
    charts = [
        (chart, svg(chart, f"chart-{number}-{index}"))
        for index, chart in enumerate(section.charts, start=1)
    ]
    columns = 3 if section.has_intervals else 2
    figures = tuple(figure.row[:columns] for figure in section.all_figures)
    return {
        "section": section,
        "pictures": [
            {"of": picture, **data_address(picture.path)}
            for picture in section.pictures
        ],
        "charts": [
            {
                "of": chart,
                "svg": drawing,
                "legend": list(legend(chart)),
                "table": values_of(chart),
            }
            for chart, drawing in charts
        ],
        "figures": Table(
            caption="The figures",
            head=("figure", "value", "95 % interval")[:columns],
            rows=figures,
        ),
        "settings": Table(
            caption="Every setting",
            head=("setting", "value"),
            rows=section.configuration,
        ),
        "versions": Table(
            caption="What made it", head=("package", "version"), rows=section.versions
        ),
    }


def data_address(path: Path) -> dict[str, Any]:
    """An image as a data: address, with its width and height on the page."""
    picture = load_picture(path).convert("RGB")
    picture.thumbnail((LONGEST_SIDE, LONGEST_SIDE), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", optimize=True)
    address = "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode(
        "ascii"
    )
    return {"address": address, "width": picture.width, "height": picture.height}
