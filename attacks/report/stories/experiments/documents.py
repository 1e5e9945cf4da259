"""What every experiment's JSON holds besides what was found: the study, the flags, where it comes from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.cloak.study_toml import study_toml
from attacks.report.section import Chart, Figure, Picture, Section, Table
from attacks.report.wording import sentence, settings

Document = Mapping[str, Any]
Row = Mapping[str, Any]


def matching(rows: Sequence[Row], **wanted: object) -> list[Row]:
    """The rows that have all of the wanted values."""
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def section(
    path: Path,
    document: Document,
    *,
    kind: str,
    done: str,
    conclusion: str,
    headline: Figure,
    control: Figure | None = None,
    attacked: bool = True,
    figures: Sequence[Figure] = (),
    warnings: Sequence[str] = (),
    pictures: tuple[Picture, ...] = (),
    charts: Sequence[Chart] = (),
    tables: Sequence[Table] = (),
) -> Section:
    """The section of an experiment: what is its own, and what all of them have.

    Args:
        path: File or folder of the result.
        document: Its JSON.
        kind: What sort of experiment it is.
        done: What was done.
        conclusion: What may be concluded.
        headline: The figure that matters.
        control: The same where nothing was cloaked.
        attacked: Whether the figure is one of an attack.
        figures: More figures.
        warnings: Reasons to look twice.
        pictures: What can be seen.
        charts: What is drawn.
        tables: More numbers.
    """
    study, given = document.get("configuration"), document.get("settings", {})
    name = str(document.get("study", "study"))
    weights = {"weights": document["detectors"]} if document.get("detectors") else {}
    return Section(
        kind=kind,
        title=name if "study" in document else path.stem,
        folder=str(path),
        done=done,
        conclusion=conclusion,
        headline=headline,
        control=control,
        attacked=attacked,
        figures=tuple(figures),
        warnings=tuple(map(sentence, warnings)),
        pictures=pictures,
        charts=tuple(charts),
        tables=tuple(tables),
        configuration=settings({**given, **({} if study is None else study), **weights}),
        file=None if study is None else (f"{name}.toml", study_toml(study)),
    )
