"""Findings of audits as SARIF, which forges and editors show."""

import importlib.metadata
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, get_args
from urllib.parse import quote

from mi_splat.audit.rules import Severity

SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"
_RULES: dict[str, tuple[Severity, str, str]] = {
    "contradicted": (
        "error",
        (
            "What an object shows from a cone of directions contradicts what all other"
            " directions predict."
        ),
        (
            "Look at contradicted.png, which `mi-splat audit --out` writes; do not use"
            " the file unless you know why."
        ),
    ),
    "differs": (
        "note",
        (
            "From a cone of directions an object looks unlike what the other directions"
            " predict, as gloss and fog do, too."
        ),
        "Look at differs.png, which `mi-splat audit --out` writes.",
    ),
    "unreadable": (
        "error",
        "The file is damaged, or of another kind than it says.",
        "Export it again; do not use it as it is.",
    ),
    "two-groups": (
        "warning",
        "Two groups of images of a set contradict each other.",
        "Look at the pair of images that `mi-splat audit --out` writes.",
    ),
    "unbounded": (
        "warning",
        "Colours may depend on the direction by more than the policy allows.",
        "Write a copy that does not with `mi-splat bound`.",
    ),
    "changed": (
        "warning",
        "The file differs from an older copy that is known to be clean.",
        "Look at what `mi-splat audit --against` shows of the difference.",
    ),
    "not-judged": (
        "error",
        (
            "The file, or a claim about it, was not judged, so that nothing is known"
            " of it."
        ),
        (
            "Do not use it until it is: `mi-splat gate` says why, and its policy says"
            " what a file may take."
        ),
    ),
}
"""Level, what is wrong, and what to do, by the name of the rule.

Rules of lint bring their own.
"""

_NOTED = ("unreadable", "not-judged")
"""Rules that say that the tool did not come to its end."""
# rule, level, what was found, and numbers of it
_Finding = tuple[str, Severity, str, dict[str, Any]]


_MEASURED = ("evidence", "distance", "rise", "file_score", "gain")


def sarif(documents: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Files as one run of the tool, in SARIF 2.1.0; results name line 1, because
    readers want one.
    """
    rules = {name: _rule(name, *values) for name, values in _RULES.items()}
    results = []
    artifacts = []
    notes = []
    for index, document in enumerate(documents):
        address = {"uri": _address(document["file"]), "index": index}
        location = {
            "physicalLocation": {
                "artifactLocation": address,
                "region": {"startLine": 1},
            }
        }
        artifacts.append(
            {
                "location": {"uri": address["uri"]},
                "properties": {"verdict": document["verdict"]},
            }
        )
        more: list[_Finding] = [(*reason, {}) for reason in document.get("more", ())]
        if "error" in document:
            more.append(("unreadable", "error", document["error"], {}))
        if any(level == "error" and name in _NOTED for name, level, _, _ in more):
            text = "; ".join(text for name, _, text, _ in more if name in _NOTED)
            notes.append(
                {"level": "error", "message": {"text": text}, "locations": [location]}
            )
        artifacts[-1]["properties"]["summary"] = document.get("summary", [])
        for finding in document.get("lint") or ():
            name = f"lint/{finding['rule']}"
            rules.setdefault(
                name,
                _rule(
                    name,
                    _level(finding["severity"]),
                    finding["rule"],
                    finding["reason"],
                ),
            )
        found = [*findings(document), *more] if "objects" in document else more
        for name, level, text, values in found:
            rules.setdefault(name, _rule(name, _level(level), name, text))
            result = {
                "ruleId": name,
                "ruleIndex": list(rules).index(name),
                "level": level,
                "message": {"text": text},
            }
            results.append({**result, "locations": [location], "properties": values})
    driver = {
        "name": "mi-splat audit",
        "version": importlib.metadata.version("mi-splat"),
        "rules": [*rules.values()],
    }
    invocation = {"executionSuccessful": not notes, "toolExecutionNotifications": notes}
    run = {
        "tool": {"driver": driver},
        "invocations": [invocation],
        "artifacts": artifacts,
        "results": results,
    }
    return {"$schema": SCHEMA, "version": "2.1.0", "runs": [run]}


def findings(document: Mapping[str, Any]) -> Iterator[_Finding]:
    """What was found in a file."""
    for number, item in enumerate(document["objects"], 1):
        for cone in item["cones"]:
            if cone["answer"] == "consistent":
                continue
            name = cone["answer"]
            values = {key: cone[key] for key in _MEASURED}
            text = f"Object {number}: {cone['sentence']}."
            yield name, _RULES[name][0], text, values
    for finding in document.get("lint") or ():
        count = f"{finding['count']:,} Gaussians. " if finding["count"] else ""
        text = f"{finding['rule']}: {count}{finding['reason']}"
        yield (
            f"lint/{finding['rule']}",
            _level(finding["severity"]),
            text,
            {"rows": finding["rows"]},
        )


def _rule(name: str, level: Severity, what: str, do: str) -> dict[str, Any]:
    texts = {"shortDescription": {"text": what}, "help": {"text": do}}
    return {"id": name, **texts, "defaultConfiguration": {"level": level}}


def _level(severity: str) -> Severity:
    """The level of a severity; what is of none of these is a warning."""
    return next((level for level in get_args(Severity) if level == severity), "warning")


def _address(file: str) -> str:
    """The name of a file as an address; a relative one stays relative to where the
    command ran.
    """
    path = Path(file)
    if path.is_absolute():
        return path.as_uri()
    return quote(os.fsencode(path.as_posix()))
