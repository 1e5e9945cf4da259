"""`mi-splat rows`: what detectors saw in the views of a result, as a table."""

import sys
from dataclasses import dataclass
from typing import Literal

from mi_splat.cli.flags import Positional
from mi_splat.cli.options import JsonOptions
from mi_splat.fields import Folder

EXAMPLES = (
    "rows out/dagger",
    "rows out/cloak --csv",
    "rows out/cloak --table detections --json",
)


@dataclass(frozen=True, kw_only=True)
class RowsOptions(JsonOptions):
    """Show the rows of a result: a line for each splat, view and detector, from which every figure is counted.

    Without --csv or --json it says which columns there are and what they mean. Takes a folder that mi-splat dagger,
    evaluate, cloak or study has written.
    """

    result: Positional[Folder]
    """Folder of a result."""
    table: Literal["rows", "detections", "fidelity", "transition"] = "rows"
    """Which table: what is reported on the object, every single detection, or (cloak) pictures without a detector."""
    csv: bool = False
    """Write the table as CSV on stdout."""


def run(options: RowsOptions) -> None:
    """Read a table and show it."""
    from attacks.observe.rows import columns_of, rows, rows_bytes
    from mi_splat.cli.console import show, show_json, show_table

    table = rows(options.result, options.table)
    columns = columns_of(table.columns)
    if options.csv:
        sys.stdout.write(rows_bytes(table).decode())
    elif options.json:
        show_json({"columns": [column.as_dict() for column in columns], "rows": table.to_dicts()})
    else:
        show_table([(column.name, column.words) for column in columns])
        show(f"{len(table):,} rows; --csv or --json prints them.")
