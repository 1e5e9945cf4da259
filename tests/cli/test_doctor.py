"""`mi-splat doctor`: what it finds, and that it survives what it looks for."""

import json
import sys

import pytest

from attacks import cli
from attacks.cli import doctor
from attacks.cli.doctor import Check, Finding
from mi_splat.processes import python_command

CHECKS = tuple(Check(name, lambda: "", f"mend {name}", name != "third") for name in ("first", "second", "third"))
FINE = "import os; os.write(1, b'\"fine\"\\n'); "
RAISE = "from mi_splat.errors import MiSplatError; raise MiSplatError('libLLVM: expected one, got none; install it')"


@pytest.mark.parametrize(
    ("code", "states", "detail"),
    [
        (FINE * 3, ["works", "works", "works"], "fine"),
        (FINE + "os.abort()", ["works", "fails", "skipped"], "SIGABRT"),
        (FINE * 2 + RAISE, ["works", "works", "absent"], "libLLVM: expected one, got none; install it"),
        (RAISE, ["fails", "skipped", "skipped"], "libLLVM: expected one, got none; install it"),
        ("import time; time.sleep(60)", ["fails", "skipped", "skipped"], "no answer"),
    ],
)
def test_a_child_says_what_works(code: str, states: list[str], detail: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "TIME_LIMIT", 0.5 if "sleep" in code else 60)
    findings = doctor.examine_group(CHECKS, [sys.executable, "-c", code])
    assert [finding.state for finding in findings] == states
    worst = next((finding for finding in findings if finding.state in ("fails", "absent")), findings[0])
    assert detail in worst.detail
    assert worst.advice == ("" if worst.state == "works" else f"mend {worst.name}")
    assert [finding.required for finding in findings] == [True, True, False]


def test_an_old_llvm_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/nowhere/libLLVM-14.so.1")
    findings = doctor.examine_group(doctor.GROUPS["renderer"], python_command("attacks.cli.doctor", "renderer"))
    assert [finding.state for finding in findings] == ["fails", "skipped"]
    assert "/nowhere/libLLVM-14.so.1" in findings[0].detail
    assert "apt install" in findings[0].advice


def test_this_machine_is_healthy(capsys: pytest.CaptureFixture[str]) -> None:
    status = cli.main(["doctor", "--json"])
    document = json.loads(capsys.readouterr().out)
    states = {finding["name"]: finding["state"] for finding in document["findings"]}
    needed = ("versions", "LLVM", "one Gaussian", "torch pair", "one detector")
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
