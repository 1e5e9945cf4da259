"""Studies of many attacks of DAGGER: the rows of each are those of a single attack, under its name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from attacks.artifacts.contents import Contents
from attacks.artifacts.dagger_results import broken, portable
from attacks.artifacts.packed import Kind, Packed
from attacks.artifacts.rows import Column, Row, Table
from attacks.artifacts.studies.settings import ATTACKS, Records, configuration_of, only, settings_of

ATTACK = Column(name="attack", kind="text", meaning="name of the attack in configuration.attacks")
_SETTINGS = (
    *("attack", "objective", "target", "config", "detector", "detector_fingerprint", "detectors", "seed"),
    *("scene_hash", "versions", "variant", "commit"),
)
"""Keys of a result that say how it was made."""
STUDY = "study"
"""Key of the configuration: what the study says of itself besides its attacks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """A kind of study.

    Attributes:
        kind: The command that makes it.
        tables: The rows of one attack, of its result.
        figures: The figures of one attack that its rows have to give, of its result and its rows.
        single: The same kind of a single attack.
        stated: Keys of a result that do not follow from the rows.
        ledger: The records in a folder.
        summary: Figures of the whole study, of its records and of what it says of itself.
        stored: The command that made it, what a study says of itself, and the same figures as it has written them, of
            its folder.
        page: The tables of the documentation, of its records and of what it says of itself.
        kept: Keys of the figures of an attack that the artifact keeps; none keeps all.
    """

    kind: str
    tables: Callable[[Mapping[str, Any]], Mapping[str, Table]]
    figures: Callable[[Mapping[str, Any], Mapping[str, Table]], Mapping[str, Any]]
    single: Kind
    stated: tuple[str, ...]
    ledger: Callable[[Path], Records]
    summary: Callable[[Sequence[Mapping[str, Any]], Mapping[str, Any]], Mapping[str, Any]]
    stored: Callable[[Path], tuple[str, Mapping[str, Any], Mapping[str, Any]]]
    page: Callable[[Sequence[Mapping[str, Any]], Mapping[str, Any]], str]
    kept: tuple[str, ...] = ()


def kind(study: Study) -> Kind:
    """As `attacks.artifacts.kinds` wants it."""
    return Kind(
        pack=partial(_pack, study),
        derive=partial(_derive, study),
        columns=partial(_columns, study),
        page=partial(_page, study),
        further=study.single.further,
        rescored=False,
    )


def _pack(study: Study, folder: Path, stages: Path | None) -> Packed:
    """What an artifact of a finished study holds."""
    records = study.ledger(folder)
    try:
        results = {name: record["result"] for name, record in records.items()}
        tables = {name: study.tables(result) for name, result in results.items()}
        figures = {name: _some(study, study.figures(result, tables[name])) for name, result in results.items()}
        command, own, summary = study.stored(folder)
        made = {name: {"job": one["job"], "result": _settings(one["result"])} for name, one in records.items()}
        every = list(results.values())
        contents = Contents(
            kind=study.kind,
            name=study.kind.replace("-", "_"),
            command=command,
            configuration={**configuration_of(made), STUDY: portable(own)},
            seeds=tuple(sorted({int(result["seed"]) for result in every})),
            versions=every[0]["versions"],
            commit=only([result["commit"] for result in every]),
            variant=only([result["variant"] for result in every]),
            detectors=_all_detectors(every),
            stated={
                name: {key: result[key] for key in study.stated if key in result and key not in figures[name]}
                for name, result in results.items()
            },
            tables=_together(tables),
        )
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, ZeroDivisionError) as error:
        raise broken(folder, error) from error
    return Packed(contents=contents, figures={ATTACKS: figures, **summary})


def _derive(study: Study, contents: Contents) -> Mapping[str, Any]:
    """The figures of every attack and of the whole study, of the rows alone."""
    figures = {name: _some(study, study.single.derive(one)) for name, one in _singles(study, contents).items()}
    try:
        return {ATTACKS: figures, **study.summary(_records(contents, figures), _own(contents))}
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise broken("rows", error) from error


def _some(study: Study, figures: Mapping[str, Any]) -> dict[str, Any]:
    """Of the figures of an attack those that the artifact of a study keeps."""
    return {key: value for key, value in figures.items() if not study.kept or key in study.kept}


def _columns(study: Study, contents: Contents) -> Mapping[str, Sequence[Column]]:
    """The tables of a study: those of its attacks, which all have the same."""
    several = [study.single.columns(one) for one in _alone(contents).values()]
    if only(several) is None:
        raise broken("configuration", ValueError("attacks with different columns"))
    return {name: (ATTACK, *columns) for name, columns in several[0].items()}


def _page(study: Study, derived: Mapping[str, Any], contents: Contents) -> str:
    """The tables of the documentation, from their first heading on."""
    text = study.page(_records(contents, derived[ATTACKS]), _own(contents))
    return text[text.index("## ") :] if "## " in text else text


def _alone(contents: Contents) -> dict[str, Contents]:
    """Each attack as an artifact of its own, without its rows."""
    try:
        return {
            name: replace(
                contents,
                configuration=values["result"],
                detectors=_detectors(values["result"]),
                tables={},
            )
            for name, values in settings_of(contents.configuration).items()
        }
    except (KeyError, TypeError) as error:
        raise broken("configuration", error) from error


def _singles(study: Study, contents: Contents) -> dict[str, Contents]:
    """Each attack as an artifact of its own."""
    rows: dict[tuple[str, Any], list[Row]] = {}
    for name, table in contents.tables.items():
        for row in table.rows:
            rows.setdefault((name, row[ATTACK.name]), []).append(row)
    alone = _alone(contents)
    strange = {attack for _, attack in rows} - set(alone)
    if strange:
        raise broken("rows", ValueError(f"an attack {min(strange)} that is not in the configuration"))

    def tables(attack: str) -> dict[str, Table]:
        return {
            name: Table(columns=table.columns[1:], rows=tuple(rows.get((name, attack), ())))
            for name, table in contents.tables.items()
            if (name, attack) in rows or name not in study.single.further
        }

    return {attack: replace(one, tables=tables(attack)) for attack, one in alone.items()}


def _records(contents: Contents, figures: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The records of the ledger as far as tables need them: settings, what is stated, and what is derived."""
    return [
        {
            "job": values["job"],
            "result": {**values["result"], **contents.stated.get(name, {}), **figures[name]},
        }
        for name, values in settings_of(contents.configuration).items()
    ]


def _own(contents: Contents) -> Mapping[str, Any]:
    """What a study says of itself besides its attacks."""
    found = contents.configuration.get(STUDY)
    return found if isinstance(found, Mapping) else {}


def _settings(result: Mapping[str, Any]) -> dict[str, Any]:
    return {key: result[key] for key in _SETTINGS if key in result}


def _detectors(result: Mapping[str, Any]) -> dict[str, str]:
    """Fingerprint of each detector attacked; the results of the two commands have them in different forms."""
    found = result["detectors"]
    if isinstance(found, Mapping):
        return {str(name): str(mark) for name, mark in found.items()}
    return {str(one["detector"]): str(one["detector_fingerprint"]) for one in found}


def _all_detectors(results: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    marks: dict[str, dict[str, None]] = {}
    for result in results:
        for name, mark in _detectors(result).items():
            marks.setdefault(name, {})[mark] = None
    return {name: ", ".join(several) for name, several in marks.items()}


def _together(tables: Mapping[str, Mapping[str, Table]]) -> dict[str, Table]:
    """The tables of all attacks, each row under the name of its attack."""
    found: dict[str, Table] = {}
    for attack, several in tables.items():
        for name, table in several.items():
            columns = (ATTACK, *table.columns)
            before = found.get(name, Table(columns=columns, rows=()))
            if before.columns != columns:
                raise ValueError(f"{attack}: other columns than the attacks before it")
            rows = tuple({ATTACK.name: attack, **row} for row in table.rows)
            found[name] = Table(columns=columns, rows=(*before.rows, *rows))
    return found
