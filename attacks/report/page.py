"""The page: sections as one HTML file that has everything in it, no script, and no address of anybody."""

import base64
import importlib.metadata
import io
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from PIL import Image

from attacks.report.charts import legend, svg, values_of
from attacks.report.section import Section
from attacks.report.wording import capital, listed
from attacks.tables import Table
from mi_splat.errors import printable
from mi_splat.io.documents import save_text
from mi_splat.io.folders import check_new_file
from mi_splat.io.picture_files import load_picture

ENDINGS = (".html", ".htm")
LONGEST_SIDE = 1200
"""Pixels that the longer side of a picture on a page has at most."""
MOST_NAMED = 3
"""Results that are named in the heading of a page without a title."""


def write_page(sections: Sequence[Section], path: Path, *, title: str | None = None, force: bool = False) -> None:
    """Write the page; the file appears whole or not at all."""
    text = page_text(sections, title=title)
    check_new_file(path, ENDINGS, force=force)
    save_text(text, path)


def page_text(sections: Sequence[Section], *, title: str | None = None) -> str:
    """The page as HTML; the same sections give the same text, in which nothing is left that a terminal would obey."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    template = environment.from_string(resources.files("attacks.report").joinpath("page.html").read_text("utf-8"))
    return printable(
        template.render(
            title=title or usual_title(sections),
            parts=[
                {"name": name, **_part(number, section)}
                for number, (name, section) in enumerate(zip(names(sections), sections, strict=True), start=1)
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
    """What each result is called on a page: its title, with the name of its folder where several have the same."""
    titles = [section.title for section in sections]
    return [
        title if titles.count(title) == 1 else f"{title} ({Path(section.folder).name})"
        for title, section in zip(titles, sections, strict=True)
    ]


def comparisons(sections: Sequence[Section]) -> Iterator[dict[str, Any]]:
    """For each kind with several results: their figures side by side, and the settings in which they differ."""
    kinds: dict[str, list[tuple[str, Section]]] = {}
    for name, section in zip(names(sections), sections, strict=True):
        kinds.setdefault(section.kind, []).append((name, section))
    for kind, members in kinds.items():
        if len(members) > 1:
            head = tuple(name for name, _ in members)
            figures = _rows([{figure.label: figure.cell for figure in section.all_figures} for _, section in members])
            settings = _rows([{"folder": section.folder, **dict(section.configuration)} for _, section in members])
            differing = tuple(row for row in settings if len(set(row[1:])) > 1)
            yield {
                "kind": kind,
                "figures": Table(caption="Figures, with their 95 % intervals", head=("figure", *head), rows=figures),
                "settings": Table(caption="Settings that differ", head=("setting", *head), rows=differing),
            }


def _rows(columns: Sequence[dict[str, str]]) -> tuple[tuple[str, ...], ...]:
    """A row for each name in any of the columns."""
    names = dict.fromkeys(name for column in columns for name in column)
    return tuple((name, *(column.get(name, "-") for column in columns)) for name in names)


def _part(number: int, section: Section) -> dict[str, Any]:
    """A section with what the template needs besides: pictures as addresses, charts as SVG."""
    charts = [(chart, svg(chart, f"chart-{number}-{index}")) for index, chart in enumerate(section.charts, start=1)]
    columns = 3 if section.has_intervals else 2
    figures = tuple(figure.row[:columns] for figure in section.all_figures)
    return {
        "section": section,
        "pictures": [{"of": picture, **data_address(picture.path)} for picture in section.pictures],
        "charts": [
            {"of": chart, "svg": drawing, "legend": list(legend(chart)), "table": values_of(chart)}
            for chart, drawing in charts
        ],
        "figures": Table(caption="The figures", head=("figure", "value", "95 % interval")[:columns], rows=figures),
        "settings": Table(caption="Every setting", head=("setting", "value"), rows=section.configuration),
        "versions": Table(caption="What made it", head=("package", "version"), rows=section.versions),
    }


def data_address(path: Path) -> dict[str, Any]:
    """A picture as a data: address, with its width and height on the page."""
    picture = load_picture(path).convert("RGB")
    picture.thumbnail((LONGEST_SIDE, LONGEST_SIDE), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", optimize=True)
    address = "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
    return {"address": address, "width": picture.width, "height": picture.height}
