"""What a command prints of the result that it has written: the figures of its page,
the most important ones if the page names them, or its record with --json.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from attacks.figures.rate import FIXED
from mi_splat.cli.console import show, show_json, show_table, warn
from mi_splat.io.folders import RECORD
from mi_splat.io.parsing import read_json

if TYPE_CHECKING:
    from attacks.report.section import Section


def show_summary(result: Path, *, as_json: bool, tables: int = 0) -> None:
    """Print the conclusion, the figures and the warnings of a finished result, and
    where to look.
    """
    if as_json:
        from attacks.figures.frame import read_figures
        from attacks.observe.rows import FIGURES_FILE

        document = {**read_json(result / RECORD), "out": str(result)}
        if (result / FIGURES_FILE).is_file():
            document["figures"] = read_figures(result).as_dicts()
        show_json(document)
        return
    from attacks.report.results import read_section

    section = read_section(result)
    show(plain(section.conclusion))
    show_table(figure_rows(section))
    for table in section.tables[:tables]:
        show(f"\n{plain(table.markdown)}\n")
    for text in section.warnings:
        warn(f"warning: {plain(text)}")
    if section.pictures:
        show(f"Open {section.pictures[0].path} first.")
    show(
        f"{result}: every figure is in figures.csv; mi-splat report {result} makes a"
        " page."
    )


def figure_rows(section: Section) -> list[tuple[str, str]]:
    """The label of each figure that a terminal shows, and its value with its note."""
    first = (section.headline.label, section.control and section.control.label)
    shown = (*first, *section.brief)
    texts = (
        (figure.label, "; ".join(filter(None, (figure.cell, figure.note))))
        for figure in section.all_figures
        if not section.brief or figure.label in shown
    )
    return [(plain(label), plain(text)) for label, text in texts]


def plain(text: str) -> str:
    """Text without the spaces that do not break."""
    return text.replace(FIXED, " ")
