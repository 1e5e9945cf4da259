"""A finished result in its folder, which may come from anybody."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import polars as pl

from attacks.figures.frame import Figures, read_figures
from attacks.observe.rows import SUFFIX, TABLES, read_rows
from mi_splat.io.folders import RECORD, Manifest, file_in, read_manifest
from mi_splat.io.parsing import DocumentReader


@dataclass(frozen=True)
class Result:
    """A finished result; what a reader does not look at is not read."""

    folder: Path
    record: Mapping[str, Any]  # its result.json

    @property
    def kind(self) -> str:
        """Name of its kind."""
        return str(self.record.get("story"))

    @cached_property
    def manifest(self) -> Manifest:
        """Its files."""
        return read_manifest(self.folder)

    @cached_property
    def tables(self) -> dict[str, pl.DataFrame]:
        """Its tables of rows by name."""
        return read_tables(self.folder)

    @cached_property
    def figures(self) -> Figures:
        """Its figures."""
        return read_figures(self.folder)


def read_result(folder: Path) -> Result:
    """The result of a folder."""
    reader = DocumentReader(do="pass a folder of results")
    return Result(folder=folder, record=reader.read_json(file_in(folder, RECORD)))


def read_tables(folder: Path, names: Sequence[str] = TABLES) -> dict[str, pl.DataFrame]:
    """The tables that a result has, of those with these names."""
    paths = {name: file_in(folder, f"{name}{SUFFIX}") for name in names}
    return {name: read_rows(path) for name, path in paths.items() if path.is_file()}
