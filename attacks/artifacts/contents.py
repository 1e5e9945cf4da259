"""What an artifact holds, and its record artifact.json: written whole, read with distrust."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from attacks.artifacts.figures import Figure, read_figure
from attacks.artifacts.rows import Table
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.documents import sha256
from mi_splat.io.parsing import DocumentReader

RECORD, CAMERAS, SPLATS = "artifact.json", "cameras.json", "splats"
FORMAT = 1
"""Raised when older programs could no longer read what this one writes."""

_NAME = re.compile(r"(?:splats/)?[A-Za-z0-9_][A-Za-z0-9_.-]{0,100}")
_PAGE = re.compile(r"(?:[A-Za-z0-9_][A-Za-z0-9_.-]*/)*[A-Za-z0-9_][A-Za-z0-9_.-]*\.md")

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Contents:
    """A result as an artifact keeps it.

    Attributes:
        kind: Name of the command that made the result.
        name: Of the result.
        command: That made it, as it was given; empty if none did.
        pages: Pages of the documentation that show its figures, relative to the checkout.
        configuration: All settings.
        seeds: Of the result.
        versions: Of the packages that made it.
        commit: Of the checkout that made it; None if unknown.
        variant: Of Mitsuba; None if unknown.
        detectors: Fingerprint of each detector's weights.
        splats: What is known of each splat: its name, number of Gaussians, hash.
        stated: Figures of the result that do not follow from the rows, as it states them.
        figures: Those that do.
        tables: Raw rows.
    """

    kind: str
    name: str
    command: str
    pages: tuple[str, ...] = ()
    configuration: Mapping[str, Any]
    seeds: tuple[int, ...]
    versions: Mapping[str, str]
    commit: str | None
    variant: str | None
    detectors: Mapping[str, str]
    splats: tuple[Mapping[str, Any], ...] = ()
    stated: Mapping[str, Any] = field(default_factory=dict)
    figures: tuple[Figure, ...] = ()
    tables: Mapping[str, Table] = field(default_factory=dict)


def record_of(contents: Contents, folder: Path) -> dict[str, Any]:
    """artifact.json of what lies in a folder.

    Args:
        contents: What the artifact holds.
        folder: With all its other files.
    """
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {
        "artifact": FORMAT,
        **{name: getattr(contents, name) for name in ("kind", "name", "command")},
        "pages": list(contents.pages),
        "seeds": list(contents.seeds),
        **{name: getattr(contents, name) for name in ("versions", "commit", "variant", "detectors")},
        "splats": [dict(entry) for entry in contents.splats],
        "files": {
            path.relative_to(folder).as_posix(): {"sha256": sha256(path), "bytes": path.stat().st_size}
            for path in files
        },
        "tables": {name: [column.as_dict() for column in table.columns] for name, table in contents.tables.items()},
        "configuration": contents.configuration,
        "stated": contents.stated,
        "figures": [figure.as_dict() for figure in contents.figures],
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundArtifact:
    """An artifact in a folder, its tables not yet read.

    Attributes:
        folder: Where it is.
        contents: What artifact.json says.
        files: SHA-256 and length of each file.
    """

    folder: Path
    contents: Contents
    files: Mapping[str, tuple[str, int]]

    def has_table(self, name: str) -> bool:
        """Whether the artifact lists a table."""
        return bool({f"{name}.csv", f"{name}.csv.gz"} & set(self.files))

    def table_file(self, name: str) -> Path:
        """The file of a table.

        Raises:
            InvalidValueError: The artifact lists none.
        """
        for file in (f"{name}.csv", f"{name}.csv.gz"):
            if file in self.files:
                return self.folder / file
        raise InvalidValueError(message(str(self.folder), f"a table {name}.csv", "none", "get the artifact again"))


def read_artifact(folder: Path) -> FoundArtifact:
    """What artifact.json in a folder says.

    Raises:
        InvalidValueError: There is none, it is of another version, or something in it is not what it has to be.
    """
    path = folder / RECORD
    values = read_object(path)
    if values.get("artifact") != FORMAT:
        do = "read it with the version of mi-splat that wrote it"
        got = repr(values.get("artifact"))[:40]
        raise InvalidValueError(message(str(path), f"an artifact of format {FORMAT}", got, do))
    where = str(path)
    pages = tuple(map(str, _of(values, "pages", list, where)))
    for page in pages:
        checked_page(page, where)
    contents = Contents(
        kind=_of(values, "kind", str, where),
        name=_of(values, "name", str, where),
        command=_of(values, "command", str, where),
        pages=pages,
        configuration=_of(values, "configuration", dict, where),
        seeds=tuple(_of(values, "seeds", list, where)),
        versions=_of(values, "versions", dict, where),
        commit=values.get("commit"),
        variant=values.get("variant"),
        detectors=_of(values, "detectors", dict, where),
        splats=tuple(entry for entry in _of(values, "splats", list, where) if isinstance(entry, dict)),
        stated=_of(values, "stated", dict, where),
        figures=tuple(read_figure(entry, where) for entry in _of(values, "figures", list, where)),
    )
    files = {name: _file(name, entry, where) for name, entry in _of(values, "files", dict, where).items()}
    return FoundArtifact(folder=folder, contents=contents, files=files)


def read_object(path: Path) -> dict[str, Any]:
    """The object in a JSON file of finite numbers.

    Raises:
        InvalidValueError: It is missing, too large, or holds none.
    """
    return DocumentReader(do="pass a folder that mi-splat artifact has written").read_json(path)


def checked_page(page: str, where: str) -> str:
    """A page's path, which leads nowhere but down.

    Raises:
        InvalidValueError: It is something else.
    """
    if not _PAGE.fullmatch(page):
        expected = "a page such as docs/cloak.md, relative to the checkout"
        raise InvalidValueError(message(where, expected, page[:80], "change it"))
    return page


def _file(name: str, entry: Any, where: str) -> tuple[str, int]:
    """SHA-256 and length of a listed file, whose name leads nowhere but into the artifact."""
    if not _NAME.fullmatch(name):
        expected = f"names of files in the artifact or its {SPLATS}/"
        raise InvalidValueError(message(where, expected, name[:80], "get the artifact again"))
    if not isinstance(entry, dict):
        raise InvalidValueError(message(where, f"sha256 and bytes of {name}", entry, "get the artifact again"))
    return _of(entry, "sha256", str, where), _of(entry, "bytes", int, where)


def _of(values: Mapping[str, Any], name: str, kind: type[_T], where: str) -> _T:
    """A value of artifact.json that is of one type."""
    value = values.get(name)
    if not isinstance(value, kind):
        expected = f"{name}, a {kind.__name__}"
        raise InvalidValueError(message(where, expected, repr(value)[:80], "get the artifact again"))
    return value
