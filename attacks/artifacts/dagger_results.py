"""What the results of `mi-splat dagger` and `dagger-eot` have in common, for artifacts."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path, PureWindowsPath
from typing import Any

from attacks.artifacts.contents import SPLATS, Contents
from attacks.artifacts.places import places_record
from attacks.artifacts.rows import Table
from attacks.objectives import Hide, Objective, Relabel, Untargeted
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import load_splat
from mi_splat.scene import scene_hash

ATTACKED = "attacked.ply"
MASK = "mask.npy"
"""File beside a result that says which Gaussians were attacked."""
_RENDERED = ("background", "near")
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
    result: Mapping[str, Any],
    tables: Mapping[str, Table],
    detectors: Mapping[str, str],
    stated: Sequence[str],
    *,
    folder: Path,
) -> Contents:
    """The contents of an artifact of one attack.

    Args:
        result: Its result.json.
        tables: Its rows.
        detectors: Fingerprint of the weights of each.
        stated: Keys of the figures that do not follow from the rows.
        folder: Of the result.
    """
    origin = {key: result.get(key) for key in ("objective", "target", "scene", "scene_hash", "selection", "cameras")}
    origin |= {key: result[key] for key in ("reference", *_RENDERED) if key in result}
    name = f"{result['objective']}_{result['target'] or 'nothing'}".replace(" ", "_")
    return Contents(
        kind=str(result["attack"]),
        name=name,
        command=str(result.get("command") or ""),
        configuration=portable({**origin, "config": result["config"]}),
        seeds=(int(result["seed"]),),
        versions=result["versions"],
        commit=result["commit"],
        variant=result["variant"],
        detectors=detectors,
        splats=_splats(folder, int(result["seed"])),
        stated={key: result.get(key) for key in stated},
        tables=tables,
    )


def objective_of(values: Mapping[str, Any]) -> Objective:
    """The aim of an attack, by its result.json or by the configuration in its artifact.

    Raises:
        InvalidValueError: It is none of this version's.
    """
    name, settings = values.get("objective"), values["config"]["objective"]
    try:
        aim: Objective = _AIMS[str(name)](**settings)
    except (KeyError, TypeError) as error:
        expected = f"the settings of one of {', '.join(_AIMS)}"
        raise InvalidValueError(message("objective", expected, repr(error), "pack a result of this version")) from error
    return aim


def cameras_of(result: Mapping[str, Any], views: Mapping[int, Mapping[str, Any]]) -> dict[str, Any] | None:
    """cameras.json of an attack; None of a result that does not hold its cameras.

    Args:
        result: Its result.json.
        views: Entries of its `views` by the number of the camera.
    """
    if not all("camera" in view for view in views.values()):
        return None
    entries = [
        {"name": str(number), **view["camera"], **{key: view[key] for key in ("box", "change") if key in view}}
        for number, view in sorted(views.items())
    ]
    return places_record(entries, **{key: result[key] for key in _RENDERED if key in result})


def mask_of(result: Mapping[str, Any], folder: Path) -> dict[str, Path]:
    """The object's mask by its name in an artifact; nothing where the object has a name in its scene."""
    selection, mask = result.get("selection"), folder / MASK
    by_name = isinstance(selection, Mapping) and set(selection) == {"object"}
    return {} if by_name or not mask.is_file() else {MASK: mask}


def _splats(folder: Path, seed: int) -> tuple[dict[str, Any], ...]:
    """What is known of the attacked splat, if it is still there."""
    path = folder / ATTACKED
    if not path.is_file():
        return ()
    scene = load_splat(path)
    return ({"splat": "attacked", "seed": seed, "gaussians": len(scene), "hash": scene_hash(scene)},)


def splat_of(folder: Path) -> dict[str, Path | None]:
    """The attacked splat by its name in an artifact."""
    return {f"{SPLATS}/{ATTACKED}": folder / ATTACKED}


def broken(what: object, error: Exception) -> InvalidValueError:
    """The error for a result that is none of this version."""
    do = "make it again with this version of mi-splat"
    return InvalidValueError(message(str(what), "a result of DAGGER", repr(error)[:200], do))
