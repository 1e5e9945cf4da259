"""`mi-splat report` and `rows`: results as one page, which needs no server and no
network, and as tables.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from attacks.cli.options import check_result_folder
from attacks.figures.rate import FIXED
from mi_splat.cli.console import progress, show, show_json, show_table, warn
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import JsonOptions
from mi_splat.errors import InvalidValueError, counted
from mi_splat.fields import Folder, OutFile

if TYPE_CHECKING:
    pass

EXAMPLES = (
    "report out/dagger --out dagger.html",
    "report out/cloak out/dagger-eot --out page.html",
    "rows out/dagger",
    "rows out/cloak --csv",
    "rows out/cloak --table detections --json",
)


@dataclass(frozen=True, kw_only=True)
class ReportOptions(JsonOptions):
    """Write one HTML page of results: images, curves with intervals, controls,
    warnings, settings, and the commands to reproduce it.

    Takes folders that mi-splat dagger, study, evaluate, compare, detect, cloak, audit,
    train and poison have written. The page is one file without scripts, and loads no
    external resources.
    """

    results: Positional[tuple[Folder, ...]] = ()
    """Folders or files of results; at least one. Those of one kind are compared."""
    out: OutFile = Path("out/report.html")
    """The page; its folder must exist."""
    title: str | None = None
    """Heading of the page. Default: derived from the results."""
    force: bool = False
    """Replace an existing page."""


def check_inputs(options: ReportOptions) -> None:
    """Raise unless there are folders that may be results."""
    if not options.results:
        raise InvalidValueError.of(
            "results", "one folder or more", "none", "name what a command has written"
        )
    for folder in options.results:
        check_result_folder(folder)


def run(options: ReportOptions) -> None:
    """Read the results and write the page."""
    from attacks.report.page import ENDINGS, need_packages, write_page
    from attacks.report.results import read_section
    from mi_splat.io.folders import check_new_file

    check_new_file(options.out, ENDINGS, force=options.force)
    need_packages()
    with progress("reading", total=len(options.results)) as advance:
        sections = []
        for folder in options.results:
            advance(str(folder))
            sections.append(read_section(folder))
    with progress("writing the page"):
        write_page(sections, options.out, title=options.title, force=options.force)
    if options.json:
        keys = ("folder", "kind", "title", "warnings")
        results = [{key: getattr(section, key) for key in keys} for section in sections]
        show_json({"out": str(options.out), "results": results})
    else:
        for section in sections:
            show(
                f"{section.folder}: {section.headline.label}:"
                f" {section.headline.value.replace(FIXED, ' ')}"
            )
            if section.warnings:
                warn(
                    f"{section.folder}: {counted(len(section.warnings), 'warning')} on"
                    " the page"
                )
        show(f"{options.out}: open it in any browser; it asks nothing of any network.")


@dataclass(frozen=True, kw_only=True)
class RowsOptions(JsonOptions):
    """Show the rows of a result: a line for each splat, view and detector, from which
    every figure is counted.

    Without --csv or --json it lists the columns and their meaning. Takes a folder that
    mi-splat dagger, evaluate, cloak or study has written.
    """

    result: Positional[Folder]
    """Folder of a result."""
    table: Literal["rows", "detections", "fidelity", "transition", "figures"] = "rows"
    """Which table: what is reported on the object, every single detection, (cloak)
    images without a detector, or the figures of the result.
    """
    csv: bool = False
    """Write the table as CSV on stdout."""


def run_rows(options: RowsOptions) -> None:
    """Read a table and show it."""
    from attacks.observe.rows import columns_of, rows, rows_bytes

    table = rows(options.result, options.table)
    columns = columns_of(table.columns)
    if options.csv:
        sys.stdout.write(rows_bytes(table).decode())
    elif options.json:
        show_json(
            {
                "columns": [column.as_dict() for column in columns],
                "rows": table.to_dicts(),
            }
        )
    else:
        show_table([(column.name, column.words) for column in columns])
        show(f"{len(table):,} rows; --csv or --json prints them.")
