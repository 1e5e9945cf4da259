"""A suite: a folder of study files in which the detector is left out, so that it is the same for every detector.

suite.toml says what is asked, and which detectors are surrogates. Each column is a study file of the column's name. A
file whose `base` names another one of the folder begins with what stands there. The suite NAME-hidden is NAME with
every seed drawn from a secret: other cameras, other starts of the attacks, another car.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from attacks.studies.study_file import Settings, merged
from mi_splat.errors import InvalidValueError, nearest
from mi_splat.fields import check_choice
from mi_splat.io.documents import sha256
from mi_splat.io.parsing import DocumentReader

SUITES, HEAD, HIDDEN = Path("scenes/suites"), "suite.toml", "-hidden"
ONE_VIEW, ALL_VIEWS, CLOAK, TRANSFER = COLUMNS = ("one_view", "all_views", "cloak", "transfer")
"""What a row has a rate for, each with a study file of its name."""
AUDIT = "audit"
"""The study file of those that audit files."""
ASSETS_FROM = 900_000
"""Seeds of assets that no detector was trained on begin here (`mi_splat.capture.sources`)."""
_SEEDS, _DRAWN = ("seed", "seeds", "judge_seed"), 90_000
_READER = DocumentReader(expected="a TOML file", do="correct it, or get the suite again")


@dataclass(frozen=True, slots=True, kw_only=True)
class Suite:
    """What is asked of everybody."""

    name: str  # of the suite
    question: str  # what it asks, one sentence
    surrogates: tuple[str, ...]  # detectors that the attacks of the column transfer are made on
    studies: Mapping[str, Settings] = field(repr=False)  # tables of the study files, by column
    digest: str  # 32 hex digits that stand for its files, and for the scenes that they name
    secret: str = ""  # SHA-256 of the file that its seeds were drawn from; empty for none


def read_suite(name: str, secret: Path | None = None) -> Suite:
    """A suite by its name."""
    hidden, folder = name.endswith(HIDDEN), SUITES / name.removesuffix(HIDDEN)
    if not (folder / HEAD).is_file():
        folder = Path(name.removesuffix(HIDDEN))
    if not (folder / HEAD).is_file():
        known = sorted(path.parent.name for path in SUITES.glob(f"*/{HEAD}"))
        do = nearest(name, known, "run it in a checkout, or pass a folder of a suite")
        raise InvalidValueError.of("suite", " or ".join(known) or f"a folder with {HEAD}", name, do)
    if hidden is not (secret is not None):
        expected, got = ("a file with a secret", "none") if hidden else (f"none with {name}", str(secret))
        raise InvalidValueError.of("secret", expected, got, "pass --secret FILE with a suite NAME-hidden alone")
    key = b"" if secret is None else _secret(secret)
    head = _READER.read_toml(folder / HEAD)
    files = {path.name: path for path in sorted(folder.glob("*.toml"))}
    tables = {path.stem: _whole(folder, path) for path in files.values()}
    scenes = {Path(scene).as_posix(): Path(scene) for table in tables.values() for scene in _scenes(table)}
    return Suite(
        name=f"{folder.name}{HIDDEN}" if hidden else folder.name,
        question=str(head.get("question", "")),
        surrogates=tuple(map(str, head.get("surrogates", ()))),
        studies={column: _drawn(tables[column], key) for column in (*COLUMNS, AUDIT) if column in tables},
        digest=_digest({**files, **_files_of(scenes)}),
        secret=hashlib.sha256(key).hexdigest() if hidden else "",
    )


def _secret(path: Path) -> bytes:
    if not path.is_file() or len(path.read_bytes().strip()) < 8:
        raise InvalidValueError.of("secret", "a file of 8 characters or more", str(path), "write a long line into it")
    return path.read_bytes().strip()


def _whole(folder: Path, path: Path) -> Settings:
    table = _READER.read_toml(path)
    if "base" not in table:
        return table
    check_choice(f"base of {path}", table["base"], sorted(file.name for file in folder.glob("*.toml")))
    base = _READER.read_toml(folder / str(table["base"]))
    whole: Settings = merged(base, {key: value for key, value in table.items() if key != "base"})
    return whole


def _scenes(table: Any) -> Iterator[str]:
    if isinstance(table, Mapping):
        for value in table.values():
            yield from _scenes(value)
    elif isinstance(table, list):
        for value in table:
            yield from _scenes(value)
    elif isinstance(table, str) and table.endswith(".xml"):
        yield table


def _files_of(scenes: Mapping[str, Path]) -> dict[str, Path]:
    from attacks.studies.attack import scene_files

    return {path.name: path for scene in scenes.values() for path in scene_files(scene).values()}


def _digest(files: Mapping[str, Path]) -> str:
    text = "\n".join(f"{name} {sha256(path)}" for name, path in sorted(files.items()))
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _drawn(table: Any, key: bytes, name: str = "") -> Any:
    """A table with other seeds, of which equal ones stay equal; the same table without a secret."""
    if not key:
        return table
    if isinstance(table, Mapping):
        return {at: _drawn(value, key, at) for at, value in table.items()}
    if isinstance(table, list):
        return [_drawn(value, key, name) for value in table]
    if name.rpartition(".")[2] not in _SEEDS or type(table) is not int:
        return table
    number = int.from_bytes(hashlib.sha256(key + str(table).encode()).digest()[:6], "big") % _DRAWN
    return number + (ASSETS_FROM if table >= ASSETS_FROM else 1)
