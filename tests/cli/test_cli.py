"""The command line: exit statuses, messages, JSON, and that each command does what it
says.
"""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from attacks import cli
from mi_splat.errors import MiSplatError
from mi_splat.io import load_splat, save_splat
from mi_splat.scene import GaussianScene, scene_hash

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def splat(tmp_path: Path) -> Path:
    """A cloud of 200 Gaussians around (1, 2, 3)."""
    count = 200
    turns = torch.nn.functional.normalize(torch.randn(count, 4), dim=1)
    middle = torch.tensor([1.0, 2.0, 3.0])
    sh = torch.ones(count, 4, 3)
    sh[0] *= 2
    scene = GaussianScene(
        means=middle + 0.3 * torch.randn(count, 3),
        scales=torch.full((count, 3), 0.1),
        rotations=turns,
        opacities=torch.full((count,), 0.8),
        sh=sh,
    )
    path = tmp_path / "cloud.ply"
    save_splat(scene, path)
    return path


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(
        name in text and summary in text for name, summary in cli.COMMANDS.items()
    )


def test_unknown_command_names_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["dager"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "did you mean dagger?" in captured.err
    assert len(captured.err.splitlines()) == 1


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["info"], "arguments: expected FILE, got none; add it"),
        (
            ["info", "a.ply", "--nonsense"],
            "options: expected those of the command, got --nonsense",
        ),
        (
            ["train", "s", "--out", "o", "--iteratons", "5"],
            "did you mean --iterations?",
        ),
        (
            ["dagger", "a.ply", "--norm", "l7"],
            "--norm: expected one of linf, l2, l2_per_gaussian, got l7",
        ),
        (
            ["dagger", "a.ply", "--size", "small"],
            "--size: expected pixels as 256 or 256x192, got 'small'",
        ),
        (
            ["view", "a.ply", "--background", "skyblu"],
            "--background: expected a colour, got 'skyblu'; did you mean skyblue?",
        ),
        (
            ["select", "a.ply", "--up", "q"],
            "--up: expected an axis such as y or -y, or three numbers, got 'q'",
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_wrong_usage_is_told_in_one_line(
    words: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert says in captured.err
    assert captured.err.endswith(f"(see mi-splat {words[0]} --help)\n")
    assert len(captured.err.splitlines()) == 1


def command_that(
    action: Callable[[object], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Put `action` in the place of `mi-splat doctor`."""
    monkeypatch.setattr("attacks.cli.doctor.run", action)


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (
            MiSplatError("eps: expected a positive number,\ngot -1; choose one"),
            1,
            "eps: expected a positive number, got -1",
        ),
        (
            PermissionError(13, "Permission denied", "/out"),
            1,
            "/out: expected files that can be read and written, got Perm",
        ),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
    ids=["ours", "system", "interrupt"],
)
def test_errors_are_one_line(
    error: BaseException,
    status: int,
    line: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(options: object) -> int:
        raise error

    command_that(fail, monkeypatch)
    assert cli.main(["doctor"]) == status
    captured = capsys.readouterr()
    assert captured.out == ""
    assert line in captured.err
    assert len(captured.err.splitlines()) == 1


@pytest.mark.parametrize("interrupt", [signal.default_int_handler, signal.SIG_IGN])
def test_sigterm_is_an_interrupt_with_another_status(
    interrupt: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[str] = []

    def wait(options: object) -> int:
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            kept.append("what there was")
        return 0

    command_that(wait, monkeypatch)
    handlers = {
        number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)
    }
    signal.signal(signal.SIGINT, interrupt)
    try:
        assert cli.main(["doctor"]) == 143
    finally:
        signal.signal(signal.SIGINT, handlers[signal.SIGINT])
    assert kept == ["what there was"]
    assert signal.getsignal(signal.SIGTERM) == handlers[signal.SIGTERM]


def test_bugs_keep_their_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(options: object) -> int:
        raise ZeroDivisionError

    command_that(fail, monkeypatch)
    with pytest.raises(ZeroDivisionError):
        cli.main(["doctor"])


def test_a_reader_that_goes_away_is_no_error(splat: Path) -> None:
    code = "import sys; from attacks.cli import main; sys.exit(main(sys.argv[1:]))"
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as closed:
        done = subprocess.run(
            [sys.executable, "-c", code, "info", str(splat)],
            stdout=closed,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert done.returncode == 0
    assert "Traceback" not in done.stderr


def test_info_describes_a_splat(
    splat: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["info", str(splat), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["gaussians"] == 200
    assert facts["sh_degree"] == 1
    assert facts["notes"] is None
    assert facts["opacity"]["50%"] == pytest.approx(0.8, abs=1e-6)
    assert (
        facts["bounds"][0][2]
        < facts["box"][0][2]
        < facts["middle"][2]
        < facts["box"][1][2]
        < facts["bounds"][1][2]
    )
    assert 0 < facts["reach"] < 3
    assert facts["parts"] is None
    assert (
        facts["colour"]["least mean"]
        < facts["colour"]["most mean"]
        < facts["colour"]["largest"]
    )
    assert len(facts["hash"]) == 64
    assert cli.main(["info", str(splat)]) == 0
    assert "gaussians  200" in capsys.readouterr().out


def test_info_counts_invalid_rows(
    splat: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(splat.read_bytes())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    data[start : start + 4] = b"\x00\x00\xc0\x7f"  # the first x becomes NaN
    splat.write_bytes(bytes(data))
    assert cli.main(["info", str(splat), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["gaussians"] == 199
    assert "1 of 200" in facts["notes"]


def test_info_of_a_ply_needs_no_torch(tmp_path: Path) -> None:
    code = (
        "import sys; from attacks.cli import main; assert main(sys.argv[1:]) == 0;"
        " print('torch' in sys.modules)"
    )
    path = ROOT / "scenes" / "car_street_car.ply"
    words = [sys.executable, "-c", code, "info", str(path)]
    done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=ROOT)
    lines = done.stdout.splitlines()
    assert lines[-1] == "False"
    assert lines[2].split() == ["gaussians", "10,075"]
    assert lines[-5].split() == ["hash", scene_hash(load_splat(path))]
