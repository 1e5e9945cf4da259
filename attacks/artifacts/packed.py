"""What a kind of result has to give for an artifact."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from attacks.artifacts.contents import Contents
from attacks.artifacts.figures import Line
from attacks.artifacts.rows import Column, Table
from attacks.detectors.base import Detector


@dataclass(frozen=True, slots=True, kw_only=True)
class Packed:
    """A finished result, ready to be written as an artifact.

    Attributes:
        contents: Everything but its figures.
        figures: What the result states, and the rows have to give again.
        cameras: cameras.json; None where the result does not hold its cameras.
        texts: Further files by name.
        files: Further files that are copied, by the name that they have in the artifact.
        splats: Files of splats by the name that they have in the artifact; None for one that is not there any more.
    """

    contents: Contents
    figures: Mapping[str, Any]
    cameras: Mapping[str, Any] | None = None
    texts: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[str, Path] = field(default_factory=dict)
    splats: Mapping[str, Path | None] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What one detector made of the attacked splat in one view, by the rows of an attack.

    Attributes:
        view: Number of the camera in cameras.json.
        detector: Its name.
        original: What it calls the clean object; None if nothing.
        success: Whether the aim was reached.
        unambiguous: Whether so, and nothing spoke against it.
    """

    view: int
    detector: str
    original: str | None
    success: bool
    unambiguous: bool


Pack = Callable[[Path, Path | None], Packed]
"""From the folder of a result and that of its stages, if it has some."""
Derive = Callable[[Contents], Mapping[str, Any]]
"""From the rows to the figures, named as the result names them."""
Columns = Callable[[Contents], Mapping[str, Sequence[Column]]]
"""What the tables of a kind have, which may depend on the configuration."""
Page = Callable[[Mapping[str, Any], Contents], str]
"""From derived figures to the Markdown that a study writes of them."""
OnView = Callable[[int, int], None]
"""Told how many pictures were looked at, and of how many."""
Look = Callable[[Packed, Sequence[Detector], OnView], Mapping[str, Table]]
"""Lets detectors look at the splats of a result again: further tables, with every detection."""
Agree = Callable[[Contents], Sequence[Line]]
"""Whether these further tables and the others say the same."""
Outcomes = Callable[[Contents], Sequence[Outcome]]
"""What the rows of an attack say of the attacked splat, view by view."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """A kind of result.

    Attributes:
        pack: Makes what an artifact needs.
        derive: Makes its figures of its rows.
        columns: The tables that it has.
        page: Makes the tables of the documentation; None where there are none.
        look: Makes further tables; None where there are none.
        agree: Compares them with the others.
        further: Names of tables that an artifact may lack.
        outcomes: What scoring an attack again compares with; None for a study.
        rescored: Whether its splats can be scored again.
    """

    pack: Pack
    derive: Derive
    columns: Columns
    page: Page | None = None
    look: Look | None = None
    agree: Agree = lambda contents: ()
    further: tuple[str, ...] = ()
    outcomes: Outcomes | None = None
    rescored: bool = True


def rows_of(tables: Mapping[str, Table]) -> int:
    """Number of rows of all tables together."""
    return sum(len(table.rows) for table in tables.values())
