"""Names of detectors and classes are checked before a command starts."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from attacks import cli

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("dagger --target Person", "got Person; did you mean person?"),
        ("dagger --object car --target car", "another class than the object's, car, got car"),
        ("dagger --object stop_sign --target stop sign", "another class than the object's, stop sign, got stop sign"),
        ("dagger --object person", "--target: expected another class than the object's, person"),
        ("dagger --objective hide --target person", "--target: expected none beside --objective hide, got person"),
        ("dagger-eot --objective untargeted --target car", "none beside --objective untargeted, got car"),
        ("dagger --detectors fasterrcn_small", "did you mean fasterrcnn_small?"),
        ("dagger-sanity --detectors fasterrcnn", "detector: expected"),
        ("view a.ply --detectors yolo8n", "did you mean yolov8n?"),
        ("evaluate a.ply b.ply --original car --target car", "another class than the object's, car"),
        ("evaluate a.ply b.ply --detectors yolov8n_small yolov8n_small", "--detectors: expected different names"),
        ("detect a.png --weights a b", "--weights: expected 1 files, got 2"),
        ("dagger --eps 0", "--eps: expected a number > 0"),
    ],
)
def test_wrong_names_are_refused_before_a_command_starts(
    words: str, says: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in cli.COMMANDS:
        monkeypatch.setattr(cli.module_of(command), "run", None)
    listed = words.replace("stop sign", "stop%sign").split()
    assert cli.main([word.replace("%", " ") for word in listed]) in (1, 2)
    told = capsys.readouterr().err
    assert says in told
    assert len(told.splitlines()) == 1


def test_names_are_checked_without_torch() -> None:
    code = "import sys; from attacks.cli import main; main(['dagger', '--target', 'Person'])"
    code += "; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout == "False\n"
    assert "--target" in done.stderr
    assert "did you mean person?" in done.stderr
