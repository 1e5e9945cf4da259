"""Derives the figures of a finished result again from its rows:
`python -m scenes.recipes.derive_again RESULT`.

A version that counts more, or otherwise, thereby makes a result of an earlier one its
own: figures.csv and the manifest are written anew, the rows stay as they are. The
tables of a study go into its table.md. No figure is written by hand.
"""

import argparse
from pathlib import Path

from attacks.figures.frame import read_figures, write_figures
from attacks.figures.result import read_result
from attacks.figures.tables import sections
from attacks.observe.rows import FIGURES_FILE
from attacks.report.checking import agree, derived_figures
from attacks.report.results import kind_of, read_section
from mi_splat.io.documents import save_text
from mi_splat.io.folders import write_manifest

TABLES = "table.md"


def derive(folder: Path) -> int:
    """Write the figures of a result anew; how many are not as they were before."""
    result = read_result(folder)
    kind = kind_of(result)
    if kind.derive is None:
        raise SystemExit(f"{folder}: expected a result with rows, got {kind.name}")
    derived = derived_figures(result, kind.derive)
    stated = {}
    if (folder / FIGURES_FILE).is_file():
        stated = dict(read_figures(folder))
    changed = 0
    for key, figure in derived:
        if key not in stated or not agree(stated[key], figure):
            changed += 1
    write_figures(derived, folder)
    if (folder / TABLES).is_file():
        title = result.record.get("question") or result.record.get("name")
        heading = f"# {title}\n\n" if title else ""
        tables = read_section(folder).tables
        save_text(heading + sections(tables), folder / TABLES)
    write_manifest(folder)
    return changed


def main() -> None:
    """Derive each result that is named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path, nargs="+", metavar="RESULT")
    for folder in parser.parse_args().results:
        print(f"{folder}: {derive(folder)} figures are new or changed")  # noqa: T201


if __name__ == "__main__":
    main()
