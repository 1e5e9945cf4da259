"""Derives the figures of a finished result again from its rows:
`python -m scenes.recipes.derive_again RESULT`.

A version that counts more, or otherwise, thereby makes a result of an earlier one its
own: result.json and the manifest are written anew, the rows stay as they are. The
tables of a study go into its table.md. No figure is written by hand.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.report.checking import check_result, read_result
from attacks.report.results import kind_of
from attacks.studies.result import tables
from attacks.tables import sections
from mi_splat.io.documents import save_json, save_text
from mi_splat.io.folders import RECORD, write_manifest

TABLES = "table.md"


def with_figures(stated: Any, derived: Any) -> Any:
    """What is stated, with derived figures in place of those at the same keys, and
    beside what else stands there.
    """
    if isinstance(stated, dict) and isinstance(derived, Mapping):
        both = {
            key: with_figures(stated[key], value) if key in stated else value
            for key, value in derived.items()
        }
        return {**stated, **both}
    if (
        isinstance(stated, list)
        and isinstance(derived, Sequence)
        and len(stated) == len(derived)
    ):
        return [with_figures(*pair) for pair in zip(stated, derived, strict=True)]
    return derived


def derive(folder: Path) -> int:
    """Write a result anew; the number of figures that were red before."""
    result = read_result(folder)
    kind = kind_of(result)
    if kind.figures is None:
        raise SystemExit(f"{folder}: expected a result with rows, got {kind.name}")
    red = [
        line
        for line in check_result(result, kind.figures, kind.given)
        if line.passed is False
    ]
    record = with_figures(result.record, kind.figures(result.record, result.tables))
    save_json(record, folder / RECORD)
    if kind.name == "study" and (folder / TABLES).is_file():
        question = f"# {record['question']}\n\n" if record.get("question") else ""
        save_text(question + sections(tables(record)), folder / TABLES)
    write_manifest(folder)
    return len(red)


def main() -> None:
    """Derive each result that is named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path, nargs="+", metavar="RESULT")
    for folder in parser.parse_args().results:
        print(f"{folder}: {derive(folder)} lines were red")  # noqa: T201


if __name__ == "__main__":
    main()
