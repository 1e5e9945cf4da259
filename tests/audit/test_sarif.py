"""Audits as SARIF: the essentials of its schema, and which finding is of which rule."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

import pytest

from attacks import cli
from mi_splat.audit import Audit
from mi_splat.audit.files import document
from mi_splat.audit.sarif import sarif
from tests.audit.accounts import account, look

LINT = {"rule": "not-finite", "severity": "error", "reason": "A renderer shows nothing.", "rows": [3, 4], "count": 2}


def told(file: str, judged: Audit, **more: Any) -> dict[str, Any]:
    return {"file": file, **document(judged), **more}


def run_of(*documents: dict[str, Any]) -> dict[str, Any]:
    """The run of a log, after the essentials of the schema were checked."""
    log = json.loads(json.dumps(sarif(documents), allow_nan=False))
    assert log["version"] == "2.1.0"
    assert log["$schema"].endswith("sarif-2.1.0.json")
    (run,) = log["runs"]
    assert set(run) <= {"tool", "invocations", "artifacts", "results"}
    driver = run["tool"]["driver"]
    assert driver["name"]
    assert driver["version"]
    ids = [rule["id"] for rule in driver["rules"]]
    assert len(set(ids)) == len(ids)
    for rule in driver["rules"]:
        assert rule["shortDescription"]["text"]
        assert rule["help"]["text"]
        assert rule["defaultConfiguration"]["level"] in ("error", "warning", "note")
    for result in run["results"]:
        assert set(result) == {"ruleId", "ruleIndex", "level", "message", "locations", "properties"}
        assert ids[result["ruleIndex"]] == result["ruleId"]
        assert result["level"] in ("error", "warning", "note", "none")
        assert result["message"]["text"].endswith(".")
        (location,) = result["locations"]
        place = location["physicalLocation"]["artifactLocation"]
        assert urlparse(place["uri"]).scheme in ("", "file")
        assert " " not in place["uri"]
        assert run["artifacts"][place["index"]]["location"]["uri"] == place["uri"]
        assert location["physicalLocation"]["region"]["startLine"] == 1
    assert isinstance(run["invocations"][0]["executionSuccessful"], bool)
    return dict(run)


@pytest.mark.parametrize(
    ("judged", "rules"),
    [
        (account(look(0.001), count=4), []),
        (account(look(0.008), count=4), [("suspicious-look", "warning")]),
        (account(look(), count=4), [("hidden-look", "error")]),
        (account(look(), look(0.02), count=4), [("hidden-look", "error")] * 2),
        (account(look(0.001), count=4, covered=0.4), [("occluder", "error")]),
        (account(look(0.001), count=4, covered=0.4, passed=0.3), [("occluder", "warning")]),
    ],
)
def test_each_finding_is_of_its_rule(judged: Audit, rules: list[tuple[str, str]]) -> None:
    run = run_of(told("a splat.ply", judged))
    assert [(result["ruleId"], result["level"]) for result in run["results"]] == rules
    (artifact,) = run["artifacts"]
    assert artifact["location"]["uri"] == "a%20splat.ply"
    assert artifact["properties"]["verdict"] == judged.verdict


def test_rules_of_lint_bring_their_own_words() -> None:
    clean = account(look(0.001), count=4)
    run = run_of(told("/a.ply", clean, lint=[LINT, {**LINT, "severity": "warning"}]), told("b.ply", clean))
    assert [(result["ruleId"], result["level"]) for result in run["results"]] == [
        ("lint/not-finite", "error"),
        ("lint/not-finite", "warning"),
    ]
    assert run["results"][0]["properties"]["rows"] == [3, 4]
    assert run["artifacts"][0]["location"]["uri"] == "file:///a.ply"
    assert run["tool"]["driver"]["rules"][-1]["help"]["text"] == LINT["reason"]


def test_a_name_of_any_bytes_is_an_address() -> None:
    run = run_of(told("caf\udce9:1.ply", account(look(0.001), count=4)))
    assert run["artifacts"][0]["location"]["uri"] == "caf%E9%3A1.ply"


def test_a_file_that_cannot_be_judged_is_no_success(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    missing, out = tmp_path / "none.ply", tmp_path / "log.sarif"
    assert cli.main(["audit", str(missing), "--sarif", str(out)]) == 1
    (run,) = json.loads(out.read_text())["runs"]
    assert not run["invocations"][0]["executionSuccessful"]
    assert "none.ply" in run["invocations"][0]["toolExecutionNotifications"][0]["message"]["text"]
    assert run["results"] == []
    assert cli.main(["audit", str(missing), "--sarif", str(out)]) == 1
    assert "expected a free name" in capsys.readouterr().err
