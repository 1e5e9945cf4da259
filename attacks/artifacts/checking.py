"""Checking an artifact: the bytes of its files, and every figure, derived again from its rows."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from attacks.artifacts.contents import RECORD, Contents, FoundArtifact, read_artifact
from attacks.artifacts.figures import Line, compared, flat, in_words
from attacks.artifacts.kinds import known_kind
from attacks.artifacts.rows import read_table
from mi_splat.io.atomic import is_temporary
from mi_splat.io.documents import sha256
from mi_splat.io.manifest import MANIFEST

_HEADING = re.compile(r"^(?=## )", re.MULTILINE)
_FRACTION = re.compile(r"(?<![\w/.])(\d+/\d+)(?![\w/]|\.\d)")


@dataclass(frozen=True, slots=True, kw_only=True)
class Checked:
    """An artifact that was checked.

    Attributes:
        found: The artifact.
        contents: What it holds, tables included.
        derived: The figures that its rows give.
        files: A line for each file.
        figures: A line for each figure.
    """

    found: FoundArtifact
    contents: Contents
    derived: Mapping[str, Any]
    files: tuple[Line, ...]
    figures: tuple[Line, ...]

    @property
    def passed(self) -> bool:
        """Whether no line is red."""
        return all(line.passed is not False for line in (*self.files, *self.figures))


def check_artifact(folder: Path) -> Checked:
    """Check the files of an artifact and derive its figures again.

    Raises:
        InvalidValueError: It cannot be read: artifact.json is broken, a table is missing, or a cell means nothing.
    """
    found = read_artifact(folder)
    kind = known_kind(found.contents.kind, folder)
    files = check_files(found)
    tables = {
        name: read_table(found.table_file(name), columns)
        for name, columns in kind.columns(found.contents).items()
        if name not in kind.further or found.has_table(name)
    }
    contents = replace(found.contents, tables=tables)
    derived = kind.derive(contents)
    return Checked(
        found=found,
        contents=contents,
        derived=derived,
        files=tuple(files),
        figures=(*compared(contents.figures, tuple(flat(derived))), *kind.agree(contents)),
    )


def check_files(found: FoundArtifact) -> list[Line]:
    """A line for each file that an artifact lists, and for each that it does not list."""
    lines = []
    for name, (digest, length) in found.files.items():
        path = found.folder / name
        if not path.is_file() or path.is_symlink():
            lines.append(Line(name=name, words="missing", passed=False))
        elif path.stat().st_size != length or sha256(path) != digest:
            lines.append(Line(name=name, words="other bytes than artifact.json lists", passed=False))
        else:
            lines.append(Line(name=name, words=f"{length:,} bytes, sha256 {digest[:16]}", passed=True))
    listed = {RECORD, MANIFEST, *found.files}
    for path in sorted(found.folder.rglob("*")):
        name = path.relative_to(found.folder).as_posix()
        if not path.is_dir() and name not in listed and not is_temporary(path.name):
            lines.append(Line(name=name, words="not listed in artifact.json", passed=False))
    return lines


def check_pages(checked: Checked, root: Path) -> list[Line]:
    """Whether the pages of the documentation that an artifact names show its figures.

    A page that holds the study's own tables has to hold each of them word for word. Of any other page, every
    fraction such as 139/139 has to be a figure of the artifact.

    Args:
        checked: The artifact.
        root: The checkout.
    """
    return [_page_line(checked, page, root / page) for page in checked.contents.pages]


def _page_line(checked: Checked, name: str, path: Path) -> Line:
    if not path.is_file():
        return Line(name=name, words="no such page", passed=False)
    text = path.read_text("utf-8")
    make = known_kind(checked.contents.kind, path).page
    tables = "" if make is None else make(checked.derived, checked.contents)
    if tables.strip() and all(table.strip() in text for table in _HEADING.split(tables)):
        return Line(name=name, words="holds the tables that the rows give, word for word", passed=True)
    known = {in_words(figure.value) for figure in flat(checked.derived) if isinstance(figure.value, tuple)}
    shown = set(_FRACTION.findall(text))
    strange = sorted(shown - known)
    if strange or not shown:
        words = f"{', '.join(strange[:5])} not among the figures" if strange else "neither its tables nor a fraction"
        return Line(name=name, words=words, passed=False)
    return Line(name=name, words=f"each of its {len(shown)} fractions is a figure of the rows", passed=True)
