"""Tables as Markdown: for the files beside a result, and for the pages of the documentation."""

from __future__ import annotations

from collections.abc import Iterable

from attacks.report.section import Table
from attacks.report.wording import FIXED


def markdown(tables: Iterable[Table]) -> str:
    """Tables under headings of their captions."""
    return "\n\n".join("\n".join(_lines(table)) for table in tables) + "\n"


def _lines(table: Table) -> list[str]:
    rows = [table.head, ["---"] * len(table.head), *table.rows]
    return [f"## {table.caption}", "", *(f"| {' | '.join(map(_cell, row))} |" for row in rows)]


def _cell(text: str) -> str:
    """A text that does not end its cell."""
    return text.replace(FIXED, " ").replace("|", "\\|").replace("\n", " ")
