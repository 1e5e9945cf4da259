"""`mi-splat doctor`: what it finds, and that it survives what it looks for."""

import json
import sys

import pytest

from attacks import cli
from attacks.cli import doctor
from attacks.cli.doctor import Finding, Probe
from mi_splat.processes import python_command

PROBES = tuple(
    Probe(name=name, run=lambda: "", advice=f"mend {name}", required=name != "third")
    for name in ("first", "second", "third")
)
REPORT = "import os; os.write(1, b'" + '"fine"\\n' + "'); "


def examined(code: str, monkeypatch: pytest.MonkeyPatch) -> list[Finding]:
    """Findings of a group of three probes whose child runs `code`."""
    monkeypatch.setitem(doctor.GROUPS, "group", PROBES)
    return doctor.examine_groups(["group"], [sys.executable, "-c", code])


def test_all_is_well(monkeypatch: pytest.MonkeyPatch) -> None:
    findings = examined(REPORT * 3, monkeypatch)
    assert [finding.state for finding in findings] == ["works"] * 3
    assert [finding.advice for finding in findings] == [""] * 3
    assert [finding.required for finding in findings] == [True, True, False]


def test_a_child_that_aborts(monkeypatch: pytest.MonkeyPatch) -> None:
    findings = examined(REPORT + "os.abort()", monkeypatch)
    assert [finding.state for finding in findings] == ["works", "fails", "skipped"]
    assert "SIGABRT" in findings[1].detail
    assert findings[1].advice == "mend second"


def test_what_follows_a_group_that_failed_is_examined(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(doctor.GROUPS, "before", PROBES)
    monkeypatch.setitem(doctor.GROUPS, "group", PROBES[:1])
    code = "import os, sys; os.write(1, b'\"fine\"\\n'); sys.argv[1:] == ['group'] or os.abort()"
    done: list[str] = []
    findings = doctor.examine_groups(["before", "group"], [sys.executable, "-c", code], done.append)
    assert [finding.state for finding in findings] == ["works", "fails", "skipped", "works"]
    assert done == ["before", "group"]


def test_a_child_that_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    code = "from mi_splat.errors import MiSplatError; raise MiSplatError('libLLVM: expected one, got none; install it')"
    findings = examined(code, monkeypatch)
    assert [finding.state for finding in findings] == ["fails", "skipped", "skipped"]
    assert findings[0].detail == "libLLVM: expected one, got none; install it"


def test_a_child_that_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "TIME_LIMIT", 0.5)
    findings = examined("import time; time.sleep(60)", monkeypatch)
    assert findings[0].state == "fails"
    assert "no answer" in findings[0].detail


def test_what_is_optional_may_be_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    probe = Probe(name="extra", run=lambda: "", advice="get it", required=False)
    monkeypatch.setitem(doctor.GROUPS, "group", (probe,))
    code = "from mi_splat.errors import MiSplatError; raise MiSplatError('no such thing')"
    (finding,) = doctor.examine_groups(["group"], [sys.executable, "-c", code])
    assert (finding.state, finding.detail, finding.advice) == ("absent", "no such thing", "get it")


def test_an_old_llvm_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/nowhere/libLLVM-14.so.1")
    findings = doctor.examine_groups(["renderer"], python_command("attacks.cli.doctor"))
    assert [finding.state for finding in findings] == ["fails", "skipped", "skipped", "skipped"]
    assert "/nowhere/libLLVM-14.so.1" in findings[0].detail
    assert "apt install" in findings[0].advice


def test_this_machine_is_healthy(capsys: pytest.CaptureFixture[str]) -> None:
    status = cli.main(["doctor", "--json"])
    document = json.loads(capsys.readouterr().out)
    states = {finding["name"]: finding["state"] for finding in document["findings"]}
    needed = ("versions", "LLVM", "variant", "one Gaussian", "one gradient", "torch pair", "one detector")
    assert {name: states[name] for name in needed} == dict.fromkeys(needed, "works")
    assert document["healthy"]
    assert status == 0


def test_a_failure_is_told_with_advice(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    finding = Finding(name="LLVM", state="fails", detail="none found", advice="install it", required=True)
    monkeypatch.setattr("attacks.cli.doctor.examine", lambda on_done: [finding])
    assert cli.main(["doctor"]) == 1
    text = capsys.readouterr().out
    assert "none found" in text
    assert "-> install it" in text
