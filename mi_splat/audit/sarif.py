"""Audits as SARIF 2.1.0, the format in which build pipelines and editors take findings of static analysis."""

import importlib.metadata
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

from mi_splat.audit.results import SEEN_THROUGH

Level = Literal["error", "warning", "note"]

SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"
ENDINGS = (".sarif", ".json")
_LEVELS: tuple[Level, ...] = ("error", "warning", "note")
_RULES: dict[str, tuple[Level, str, str]] = {
    "hidden-look": (
        "error",
        "An object has other colours from some directions than from others, and gloss does not explain it.",
        "Look at the pair of pictures that `mi-splat audit --out` writes; do not use the file unless you know why.",
    ),
    "suspicious-look": (
        "warning",
        "Colours of an object change with the direction of view more than gloss quite explains.",
        "Look at the pair of pictures that `mi-splat audit --out` writes.",
    ),
    "occluder": (
        "warning",
        "Something in the air covers an object from some directions, and cameras elsewhere look through it.",
        "Look at the object from the directions that are named; an honest canopy may look the same.",
    ),
    "edited": (
        "warning",
        "Colours of an object have shades that neither paint nor light explains; an attack on a detector leaves them.",
        "Compare it with an older copy by `mi-splat audit --against`, or train it again.",
    ),
}
"""Level, what is wrong, and what to do, by the name of the rule. Rules of lint bring their own."""

_Finding = tuple[str, Level, str, dict[str, Any]]
"""Rule, level, what was found, and numbers of it."""


def sarif(documents: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """One run of the tool over some files.

    SARIF 2.1.0, https://docs.oasis-open.org/sarif/sarif/v2.1.0/sarif-v2.1.0.html. A file that could not be judged is a
    notification of the tool, and the run then has no success. Results name line 1: readers want one, and a splat has
    none.
    """
    rules = {name: _rule(name, *values) for name, values in _RULES.items()}
    results, artifacts, notes = [], [], []
    for index, document in enumerate(documents):
        address = {"uri": _address(document["file"]), "index": index}
        location = {"physicalLocation": {"artifactLocation": address, "region": {"startLine": 1}}}
        artifacts.append({"location": {"uri": address["uri"]}, "properties": {"verdict": document["verdict"]}})
        if "error" in document:
            note = {"level": "error", "message": {"text": document["error"]}, "locations": [location]}
            notes.append(note)
            continue
        artifacts[-1]["properties"]["summary"] = document["summary"]
        for finding in document.get("lint") or ():
            name = f"lint/{finding['rule']}"
            rules.setdefault(name, _rule(name, _level(finding["severity"]), finding["rule"], finding["reason"]))
        for name, level, text, values in _findings(document):
            result = {"ruleId": name, "ruleIndex": list(rules).index(name), "level": level, "message": {"text": text}}
            results.append({**result, "locations": [location], "properties": values})
    driver = {"name": "mi-splat audit", "version": importlib.metadata.version("mi-splat"), "rules": [*rules.values()]}
    invocation = {"executionSuccessful": not notes, "toolExecutionNotifications": notes}
    run = {"tool": {"driver": driver}, "invocations": [invocation], "artifacts": artifacts, "results": results}
    return {"$schema": SCHEMA, "version": "2.1.0", "runs": [run]}


def _findings(document: Mapping[str, Any]) -> Iterator[_Finding]:
    """What was found in a file."""
    thresholds = document["thresholds"]
    for number, item in enumerate(document["objects"], 1):
        for index, look in enumerate(item["looks"], 1):
            evidence = look["excess"] / thresholds["excess"]
            if evidence >= thresholds["suspicion"]:
                name = "hidden-look" if evidence >= 1 and not item["in_room"] else "suspicious-look"
                text = f"Object {number}, look {index}: other colours {look['where']}; excess {look['excess']:.4f}."
                values = {key: look[key] for key in ("score", "incidence", "mirror", "shift", "fade", "excess")}
                yield name, _RULES[name][0], text, values
        cover = item["occluder"]
        if cover is not None and cover["score"] >= thresholds["covered"]:
            axis = " ".join(f"{value + 0.0:.2f}" for value in cover["axis"])
            text = f"Object {number}: something in the air covers it from around ({axis}), and others see through it."
            hides = item["verdict"] == "hidden look" and cover["transparent"] >= SEEN_THROUGH
            yield "occluder", "error" if hides else _RULES["occluder"][0], text, {"score": cover["score"]}
        edit = item.get("edited")
        if edit is not None and edit["score"] >= 1:
            text = f"Object {number}: its colours look edited, as an attack on a detector leaves them."
            yield "edited", _RULES["edited"][0], text, edit
    for finding in document.get("lint") or ():
        count = f"{finding['count']:,} Gaussians. " if finding["count"] else ""
        text = f"{finding['rule']}: {count}{finding['reason']}"
        yield f"lint/{finding['rule']}", _level(finding["severity"]), text, {"rows": finding["rows"]}


def _rule(name: str, level: Level, what: str, do: str) -> dict[str, Any]:
    default = {"level": level}
    return {"id": name, "shortDescription": {"text": what}, "help": {"text": do}, "defaultConfiguration": default}


def _level(severity: str) -> Level:
    """The level of a severity; what is of none of these is a warning."""
    return next((level for level in _LEVELS if level == severity), "warning")


def _address(file: str) -> str:
    """The name of a file as an address; a relative one stays relative to where the command ran."""
    path = Path(file)
    return path.as_uri() if path.is_absolute() else quote(os.fsencode(path.as_posix()))
