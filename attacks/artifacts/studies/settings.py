"""Settings of many attacks without repetition: what all share is kept once, and of each what differs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.artifacts.contents import read_object
from attacks.artifacts.dagger_results import broken, portable
from mi_splat.errors import InvalidValueError, message

SHARED, ATTACKS = "shared", "attacks"
"""Keys of the configuration: what all attacks have in common, and by the name of each what it has besides."""

Values = Mapping[str, Any]
Records = Mapping[str, Values]
"""Records of a ledger by the names of their files."""


def records_of(folder: Path) -> dict[str, dict[str, Any]]:
    """Every record of a ledger, by name.

    Raises:
        InvalidValueError: There is none, or a file is no record.
    """
    found = {path.stem: read_object(path) for path in sorted(folder.glob("*.json"))}
    if not found:
        do = "pass the folder of a finished study"
        raise InvalidValueError(message(str(folder), "JSONs of attacks", "none", do))
    for name, record in found.items():
        if not (isinstance(record.get("job"), dict) and isinstance(record.get("result"), dict)):
            raise broken(folder / f"{name}.json", KeyError("job or result"))
    return found


def configuration_of(several: Mapping[str, Values]) -> dict[str, Any]:
    """The settings of several attacks by name as an artifact holds them."""
    common = _common(list(several.values()))
    return {SHARED: portable(common), ATTACKS: {name: portable(_rest(one, common)) for name, one in several.items()}}


def settings_of(configuration: Values) -> dict[str, dict[str, Any]]:
    """The settings of each attack again.

    Raises:
        InvalidValueError: The configuration is none of a study.
    """
    shared, attacks = configuration.get(SHARED), configuration.get(ATTACKS)
    if not (isinstance(shared, dict) and isinstance(attacks, dict) and attacks):
        do = "get the artifact again"
        raise InvalidValueError(message("configuration", f"{SHARED} and {ATTACKS}", "something else", do))
    return {str(name): _merged(shared, one) for name, one in attacks.items()}


def only(values: Sequence[Any]) -> Any:
    """The value, if all are the same; else None."""
    return values[0] if all(value == values[0] for value in values) else None


def _common(several: Sequence[Values]) -> dict[str, Any]:
    """The entries that all have, at any depth."""
    first, found = several[0], {}
    for key, value in first.items():
        values = [one[key] for one in several if key in one]
        if len(values) < len(several):
            continue
        if all(isinstance(one, Mapping) and one for one in values):
            inner = _common(values)
            if inner:
                found[key] = inner
        elif only(values) is not None or all(one is None for one in values):
            found[key] = value
    return found


def _rest(values: Values, common: Values) -> dict[str, Any]:
    """What one has besides that."""
    found = {}
    for key, value in values.items():
        if key not in common:
            found[key] = value
        elif isinstance(value, Mapping) and value:
            inner = _rest(value, common[key])
            if inner:
                found[key] = inner
    return found


def _merged(common: Values, rest: Any) -> dict[str, Any]:
    found = dict(common)
    for key, value in (rest if isinstance(rest, Mapping) else {}).items():
        both = isinstance(value, Mapping) and isinstance(found.get(key), Mapping)
        found[key] = _merged(found[key], value) if both else value
    return found
