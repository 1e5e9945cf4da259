"""What a command says of the result that it has written: the figures of its page, or its record with --json."""

from pathlib import Path

from attacks.rate import FIXED
from mi_splat.cli.console import show, show_json, show_table, warn
from mi_splat.io.folders import RECORD
from mi_splat.io.parsing import read_json


def show_summary(result: Path, *, as_json: bool, tables: int = 0) -> None:
    """Print the conclusion, the figures and the warnings of a finished result, and where to look."""
    if as_json:
        show_json({**read_json(result / RECORD), "out": str(result)})
        return
    from attacks.report.results import read_section

    section = read_section(result)
    show(_plain(section.conclusion))
    cells = ((figure.label, "; ".join(filter(None, (figure.cell, figure.note)))) for figure in section.all_figures)
    show_table((_plain(label), _plain(text)) for label, text in cells)
    for table in section.tables[:tables]:
        show(f"\n{_plain(table.markdown)}\n")
    for text in section.warnings:
        warn(f"warning: {_plain(text)}")
    if section.pictures:
        show(f"Look at {section.pictures[0].path} first.")
    show(f"{result}: every number is in {RECORD}; mi-splat report {result} makes a page.")


def _plain(text: str) -> str:
    return text.replace(FIXED, " ")
