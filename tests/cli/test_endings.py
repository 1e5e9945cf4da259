"""How a command ends: by signals at any moment, and where nobody can read what it
says.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from attacks import cli
from mi_splat.io import save_splat
from mi_splat.processes import INTERRUPTED, TERMINATED
from tests.fakes import toy_scene
from tests.project.layers import ROOT

SLOW = """
import os, signal
number, times = int(os.environ["SIGNAL"]), int(os.environ["TIMES"])
for _ in range(times):
    os.kill(os.getpid(), number)
import time
time.sleep(0.1)
value = 1
"""
"""A module during whose import signals come, as during that of numpy, which cannot be
imported twice.
"""
IMPORTS = """
import signal, sys
# a shell's background job ignores it
signal.signal(signal.SIGINT, signal.default_int_handler)
from attacks import __main__, cli

def dispatch(words):
    import comes_slowly
    print("imported", flush=True)
    import time
    time.sleep(60)

cli._dispatch = dispatch
__main__.run()
"""


@pytest.mark.parametrize(
    ("number", "times", "status", "said"),
    [
        (signal.SIGTERM, 1, TERMINATED, "terminated"),
        (signal.SIGINT, 1, INTERRUPTED, "interrupted"),
        (signal.SIGINT, 2, INTERRUPTED, ""),
        (signal.SIGTERM, 2, TERMINATED, ""),
    ],
)
def test_a_signal_breaks_off_no_import(
    number: signal.Signals, times: int, status: int, said: str, tmp_path: Path
) -> None:
    (tmp_path / "comes_slowly.py").write_text(SLOW)
    variables = {
        "PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}",
        "SIGNAL": str(int(number)),
        "TIMES": str(times),
    }
    done = subprocess.run(
        [sys.executable, "-c", IMPORTS],
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=50,
    )
    assert done.returncode == status
    assert done.stderr == (f"mi-splat: {said}\n" if said else "")


def test_what_a_signal_breaks_off_may_fail_in_other_words(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def dispatch(_: object) -> int:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5)
        except KeyboardInterrupt:
            raise ImportError("cannot load module more than once per process") from None
        return 0

    monkeypatch.setattr(cli, "_dispatch", dispatch)
    assert cli.main(["info", "a.ply"]) == TERMINATED
    assert capsys.readouterr().err == "mi-splat: terminated\n"


def in_shell(redirected: str, *words: str) -> subprocess.CompletedProcess[str]:
    line = [
        "bash",
        "-c",
        f'"$@" {redirected}; exit ${{PIPESTATUS[0]}}',
        "bash",
        sys.executable,
        "-m",
        "attacks",
        *words,
    ]
    variables = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        line, env=variables, capture_output=True, text=True, timeout=100
    )


@pytest.mark.parametrize(
    ("redirected", "status"),
    [(">/dev/full", 1), (">&-", 1), ("| head -0", 0), ("2>&-", 0), ("<&- 2>&-", 0)],
)
def test_an_output_that_cannot_be_written_is_an_error(
    redirected: str, status: int, tmp_path: Path
) -> None:
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full")
    save_splat(toy_scene()[0], tmp_path / "a.ply")
    done = in_shell(redirected, "info", str(tmp_path / "a.ply"))
    assert done.returncode == status
    assert len(done.stderr.splitlines()) == (status == 1)
    assert "Traceback" not in done.stderr


def test_a_gate_without_files_and_standard_input_is_misuse(tmp_path: Path) -> None:
    done = in_shell("<&-", "gate", "--strict", "--store", str(tmp_path))
    assert done.returncode == 2
    assert "expected paths, or a standard input that names them" in done.stderr
