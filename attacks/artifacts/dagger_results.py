"""What the results of `mi-splat dagger` and `dagger-eot` have in common, for artifacts."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path, PureWindowsPath
from typing import Any

from attacks.artifacts.contents import SPLATS, Contents
from attacks.artifacts.rows import Table
from attacks.objectives import Hide, Objective, Relabel, Untargeted
from mi_splat.errors import InvalidValueError, message

_AIMS: dict[str, type[Any]] = {"relabel": Relabel, "hide": Hide, "untargeted": Untargeted}
_ABSOLUTE = re.compile(r"/|~|[A-Za-z]:[\\/]|\\\\")


def portable(value: Any) -> Any:
    """A JSON value with the names alone of files that it gives by their place on one machine."""
    if isinstance(value, Mapping):
        return {key: portable(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [portable(entry) for entry in value]
    if isinstance(value, str) and _ABSOLUTE.match(value):
        return PureWindowsPath(value).name
    return value


def contents_of(
    result: Mapping[str, Any], tables: Mapping[str, Table], detectors: Mapping[str, str], stated: Sequence[str]
) -> Contents:
    """The contents of an artifact of one attack.

    Args:
        result: Its result.json.
        tables: Its rows.
        detectors: Fingerprint of the weights of each.
        stated: Keys of the figures that do not follow from the rows.
    """
    origin = {key: result.get(key) for key in ("objective", "target", "scene", "scene_hash", "selection", "cameras")}
    return Contents(
        kind=str(result["attack"]),
        name=f"{result['objective']}_{result['target'] or 'nothing'}".replace(" ", "_"),
        command=f"mi-splat {result['attack']}, with the settings in configuration",
        configuration=portable({**origin, "config": result["config"]}),
        seeds=(int(result["seed"]),),
        versions=result["versions"],
        commit=result["commit"],
        variant=result["variant"],
        detectors=detectors,
        stated={key: result.get(key) for key in stated},
        tables=tables,
    )


def objective_of(contents: Contents) -> Objective:
    """The aim of an attack.

    Raises:
        InvalidValueError: It is none of this version's.
    """
    name, settings = contents.configuration.get("objective"), contents.configuration["config"]["objective"]
    try:
        aim: Objective = _AIMS[str(name)](**settings)
    except (KeyError, TypeError) as error:
        expected = f"the settings of one of {', '.join(_AIMS)}"
        raise InvalidValueError(message("objective", expected, repr(error), "pack a result of this version")) from error
    return aim


def splat_of(folder: Path) -> dict[str, Path | None]:
    """The attacked splat by its name in an artifact."""
    return {f"{SPLATS}/attacked.ply": folder / "attacked.ply"}


def broken(what: object, error: Exception) -> InvalidValueError:
    """The error for a result that is none of this version."""
    do = "make it again with this version of mi-splat"
    return InvalidValueError(message(str(what), "a result of DAGGER", repr(error)[:200], do))
