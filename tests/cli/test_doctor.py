"""`mi-splat doctor`: what it finds, and that it survives what it looks for."""

import json
import sys

import pytest

from attacks import cli
from attacks.cli import doctor
from attacks.cli.doctor import Check, Finding
from mi_splat.processes import python_command

FINE = "import os; os.write(1, b'\"fine\"\\n')"
RAISE = (
    "from mi_splat.errors import MiSplatError; raise MiSplatError('libLLVM: expected"
    " one, got none; install it')"
)


@pytest.mark.parametrize(
    ("code", "required", "state", "detail"),
    [
        (FINE, True, "works", "fine"),
        ("import os; os.abort()", True, "fails", "SIGABRT"),
        (RAISE, True, "fails", "libLLVM: expected one, got none; install it"),
        (RAISE, False, "absent", "libLLVM: expected one, got none; install it"),
        ("import time; time.sleep(60)", True, "fails", "no answer"),
    ],
)
def test_a_child_says_what_works(
    code: str, required: bool, state: str, detail: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "TIME_LIMIT", 0.5 if "sleep" in code else 60)
    finding = doctor.checked(
        Check("one", lambda: "", "mend it", required), [sys.executable, "-c", code]
    )
    assert (finding.state, finding.required) == (state, required)
    assert detail in finding.detail
    assert finding.advice == ("" if state == "works" else "mend it")


def test_an_old_llvm_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/nowhere/libLLVM-14.so.1")
    finding = doctor.checked(
        doctor.CHECKS[0], python_command("attacks.cli.doctor", "LLVM")
    )
    assert finding.state == "fails"
    assert "/nowhere/libLLVM-14.so.1" in finding.detail
    assert "apt install" in finding.advice


@pytest.mark.nightly  # it starts a process for each check, ten seconds in all
def test_this_machine_is_healthy(capsys: pytest.CaptureFixture[str]) -> None:
    status = cli.main(["doctor", "--json"])
    document = json.loads(capsys.readouterr().out)
    states = {finding["name"]: finding["state"] for finding in document["findings"]}
    needed = ("versions", "LLVM", "one Gaussian", "torch pair", "one detector")
    assert {name: states[name] for name in needed} == dict.fromkeys(needed, "works")
    assert document["healthy"]
    assert status == 0


def test_a_failure_is_told_with_advice(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    finding = Finding(
        name="LLVM",
        state="fails",
        detail="none found",
        advice="install it",
        required=True,
    )
    monkeypatch.setattr("attacks.cli.doctor.examine", lambda on_done: [finding])
    assert cli.main(["doctor"]) == 1
    text = capsys.readouterr().out
    assert "none found" in text
    assert "-> install it" in text
