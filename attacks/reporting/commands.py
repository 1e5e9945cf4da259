"""Command lines that repeat a result, written from the settings that its JSON has."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

PROGRAM = "mi-splat"


def command(name: str, *words: object) -> str:
    """A line for a shell."""
    return shlex.join([PROGRAM, name, *map(str, words)])


def flags(values: Mapping[str, Any], defaults: object, *, skip: Sequence[str] = ()) -> list[str]:
    """The flags that change the defaults of a configuration into these values.

    Args:
        values: As a JSON has them; keys that are no settings are left out.
        defaults: A dataclass with its defaults.
        skip: Settings that are said in another way.
    """
    words: list[str] = []
    for field in dataclasses.fields(defaults):  # type: ignore[arg-type]
        usual = json.loads(json.dumps(getattr(defaults, field.name)))
        if field.name in skip or field.name not in values or values[field.name] == usual:
            continue
        words += flag(field.name, values[field.name])
    return words


def flag(name: str, value: Any) -> list[str]:
    """One flag with its value, as the command line reads it; a switch has none."""
    words = "detectors" if name == "detector" else name.replace("_", "-")
    if name == "size":
        return ["--size", "x".join(map(word, value))]
    if isinstance(value, bool):
        return [f"--{words}" if value else f"--no-{words}"]
    several = value if isinstance(value, (list, tuple)) else [value]
    return [f"--{words}", *map(word, several)] if several else []


def word(value: Any) -> str:
    """A value as the command line reads it."""
    if value is None:
        return "none"
    if isinstance(value, float):
        return str(int(value)) if value.is_integer() else repr(value)
    return str(value)


def chosen(result: Mapping[str, Any], mask: Path | None = None) -> list[str]:
    """The flags that choose the object again: its name, or its mask, or what it was once chosen by.

    Args:
        result: With its `selection`.
        mask: File that says which Gaussians it is, if there is one.
    """
    selection = result.get("selection")
    by = selection if isinstance(selection, Mapping) else {}
    if set(by) != {"object"} and mask is not None:
        return ["--mask", str(mask)]
    return [word for name, value in by.items() if not isinstance(value, Mapping) for word in flag(name, value)]


def rendered(result: Mapping[str, Any]) -> list[str]:
    """The flags that render as the result was rendered; none of an older result, which does not say it."""
    return [word for name in ("near", "background") if name in result for word in flag(name, result[name])]


def without_settings(result: Mapping[str, Any]) -> str:
    """What to say of a result of an older version, which does not store how its pictures were rendered."""
    if "near" in result and "background" in result:
        return ""
    return " It does not store --near and --background; add them if you gave them."


def aim(result: Mapping[str, Any], confidences: Mapping[str, float]) -> list[str]:
    """The flags that say again what the attacker wants.

    Args:
        result: Of an attack.
        confidences: Of each aim, what counts as success if nothing is said.
    """
    name, wanted = str(result["objective"]), result["config"].get("objective", {})
    words = ["--target", str(result["target"])] if name == "relabel" else ["--objective", name]
    confidence = wanted.get("confidence", confidences.get(name))
    return words if confidence == confidences.get(name) else [*words, "--confidence", word(confidence)]


def again(folder: Path) -> list[str]:
    """Where a repeated result goes: beside the one that is there."""
    return ["--out", f"{folder}-again"]


def again_file(path: Path, ending: str = "") -> list[str]:
    """Where a repeated result goes that is one file: beside the one that is there.

    Args:
        path: The file.
        ending: Of its name, if it is longer than the suffix.
    """
    ending = ending or path.suffix
    return ["--out", str(path.with_name(f"{path.name.removesuffix(ending)}-again{ending}"))]
