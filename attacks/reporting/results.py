"""Folders of results as sections: which command has written a folder, and what reads it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from attacks.reporting.kinds import (
    cloak,
    dagger,
    eot,
    eot_study,
    evaluation,
    pairs,
    sanity,
    study,
    transfer,
    variations,
)
from attacks.reporting.section import Section
from mi_splat.errors import InvalidValueError, MiSplatError, message
from mi_splat.io.documents import read_json

Found = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """A kind of result.

    Attributes:
        command: What writes it.
        record: File by which it is known.
        is_it: Whether such a file is of this kind.
        read: Makes the section of a folder and of what its file holds.
    """

    command: str
    record: str
    is_it: Callable[[Found], bool]
    read: Callable[[Path, Found], Section]


def _always(found: Found) -> bool:
    return True


KINDS = (
    Kind(command="dagger", record="result.json", is_it=lambda one: one.get("attack") == "dagger", read=dagger.read),
    Kind(
        command="dagger-eot", record="result.json", is_it=lambda one: one.get("attack") == "dagger-eot", read=eot.read
    ),
    Kind(command="dagger-pairs", record="summary.json", is_it=lambda one: "pairs" in one, read=pairs.read),
    Kind(command="cloak", record="summary.json", is_it=lambda one: "study" in one, read=cloak.read),
    Kind(command="cloak --vary", record="variations.json", is_it=_always, read=variations.read),
    Kind(command="dagger-study", record="table.json", is_it=lambda one: "by_radius" in one, read=study.read),
    Kind(command="dagger-eot-study", record="table.json", is_it=lambda one: "smallest" in one, read=eot_study.read),
    Kind(command="dagger-transfer", record="transfer.json", is_it=_always, read=transfer.read),
    Kind(command="dagger-transfer --eot-study", record="held_out.json", is_it=_always, read=transfer.read_held_out),
    Kind(command="dagger-sanity", record="sanity.json", is_it=_always, read=sanity.read),
    Kind(command="evaluate", record="evaluation.json", is_it=_always, read=evaluation.read),
)
"""Every kind of result that a page can show."""


def read_section(folder: Path) -> Section:
    """What a page says of one folder of results.

    Raises:
        InvalidValueError: It is no folder that one of `KINDS` names, or a file in it is broken.
    """
    commands = ", ".join(f"mi-splat {kind.command}" for kind in KINDS if " " not in kind.command)
    if not folder.is_dir():
        got = "a file" if folder.exists() else "nothing there"
        do = f"pass {folder.parent}" if folder.exists() else "check the path"
        raise InvalidValueError(message(str(folder), "a folder of results", got, do))
    records = dict.fromkeys(kind.record for kind in KINDS if (folder / kind.record).is_file())
    if not records:
        expected = f"a folder that one of {commands} has written"
        raise InvalidValueError(message(str(folder), expected, "one without a result", "pass a finished result"))
    for record in records:
        found = read_json(folder / record)
        for kind in KINDS:
            if kind.record == record and kind.is_it(found):
                return _read(kind, folder, found)
    do = "make the result again"
    raise InvalidValueError(message(str(folder / next(iter(records))), f"a result of {commands}", "something else", do))


def _read(kind: Kind, folder: Path, found: Found) -> Section:
    """The section of a folder; whatever is broken in it is told in one line."""
    try:
        return kind.read(folder, found)
    except MiSplatError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, ZeroDivisionError) as error:
        expected, do = f"a finished result of mi-splat {kind.command}", "make the result again"
        got = f"a broken or an older one ({type(error).__name__}: {error})"
        raise InvalidValueError(message(str(folder / kind.record), expected, got, do)) from error
