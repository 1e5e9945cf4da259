"""Names of detectors and classes are checked before a command starts."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from attacks import cli
from attacks.cli import parse

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("artifact .", "got one without a result"),
        ("report nowhere", "got nothing there"),
        ("cloak missing.toml", "no file missing.toml"),
        ("capture car --cameras hemisphere:-3", "expected hemisphere:N"),
        (
            "prepare nowhere --out out",
            "nowhere: expected a folder of photographs, or a video, got no such file",
        ),
    ],
)
def test_wrong_inputs_are_refused_before_torch_is_imported(
    words: str,
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        cli, "import_at_once", lambda package: pytest.fail(f"imported {package}")
    )
    assert cli.main(words.split()) == 1
    assert says in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("dagger a.ply --target Person", "got Person; did you mean person?"),
        (
            "dagger a.ply --object car --target car",
            "another class than the object's, car, got car",
        ),
        (
            "dagger a.ply --object person",
            "--target: expected another class than the object's, person",
        ),
        (
            "dagger a.ply --objective hide --target person",
            "--target: expected none with --objective hide, got person",
        ),
        (
            "dagger a.ply --region --objective untargeted --target car",
            "none with --objective untargeted, got car",
        ),
        ("dagger a.ply --detectors fasterrcn_small", "did you mean fasterrcnn_small?"),
        ("view a.ply --detectors yolo8n", "did you mean yolov8n?"),
        (
            "evaluate a.ply b.ply --original car --target car",
            "another class than the object's, car",
        ),
        (
            "evaluate a.ply b.ply --detectors yolov8n_small yolov8n_small",
            "--detectors: expected different names",
        ),
        ("detect a.png --weights a b", "--weights: expected 1 files, got 2"),
    ],
)
def test_wrong_names_are_refused_before_a_command_starts(
    words: str,
    says: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for command in cli.COMMANDS:
        monkeypatch.setattr(cli.module_of(command), "run", None)
    assert cli.main(words.split()) in (1, 2)
    told = capsys.readouterr().err
    assert says in told
    assert len(told.splitlines()) == 1


def test_names_are_checked_without_torch() -> None:
    code = (
        "import sys; from attacks.cli import main; main(['dagger', 'a.ply', '--target',"
        " 'Person'])"
    )
    code += "; print('torch' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT
    )
    assert done.stdout == "False\n"
    assert "--target" in done.stderr
    assert "did you mean person?" in done.stderr


def options_of(command: str, *words: str) -> Any:
    return parse(command, words)


def test_sizes_and_colours_are_spelled_in_several_ways() -> None:
    for typed, size in (("128", (128, 128)), ("256x192", (256, 192))):
        assert options_of("render", "a.ply", "--size", typed).view.size == size
    colours = {
        "white": (1, 1, 1),
        "1,1,1": (1, 1, 1),
        "#80b0e0": (128 / 255, 176 / 255, 224 / 255),
    }
    for typed, colour in {
        **colours,
        "SkyBlue": (135 / 255, 206 / 255, 235 / 255),
    }.items():
        assert (
            options_of("train", "set", "--out", "out", "--background", typed).background
            == colour
        )


def test_an_axis_is_a_letter_or_three_numbers() -> None:
    up: tuple[float, ...]
    for typed, up in (
        ("-y", (0, -1, 0)),
        ("+x", (1, 0, 0)),
        ("0,-1,0", (0, -1, 0)),
        ("z", (0, 0, 1)),
    ):
        options = options_of("render", "--up", typed, "a.ply")
        assert (options.view.up, options.scene.name) == (up, "a.ply")
    for typed, axis in (("-z", "-z"), ("x", "x")):
        assert options_of("capture", "a.ply", "--up", typed).mesh.up == axis
