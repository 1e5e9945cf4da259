"""What goes to the terminal: progress, and names that a terminal would obey."""

import json
import sys
import warnings
from pathlib import Path

import pytest

from attacks import cli
from mi_splat.cli import console

HOSTILE = "a\x1b[31mred\x07\r\x9b2J\u202egnp.exe\udcff[red]b[/]"
SHOWN = r"a\x1b[31mred\x07\r\x9b2J\u202egnp.exe\udcff[red]b[/]"


def test_what_a_terminal_would_obey_is_shown(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    console.show(f"{HOSTILE}\n\tdomů")
    console.show_table([(HOSTILE, "1"), ("b", HOSTILE)])
    assert capsys.readouterr().out.splitlines() == [
        SHOWN,
        "\tdomů",
        f"{SHOWN}  1",
        f"{'b':{len(SHOWN)}}  {SHOWN}",
    ]
    console.warn(HOSTILE)
    monkeypatch.setattr(console, "LINE_SECONDS", 0.0)
    with console.progress("working") as advance:
        advance(HOSTILE)
    assert capsys.readouterr().err.splitlines() == [f"mi-splat: {SHOWN}"] * 2
    console.show_json({"name": HOSTILE})
    assert json.loads(capsys.readouterr().out) == {"name": HOSTILE}


def test_progress_obeys_neither_markup_nor_controls(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "200")
    with console.progress(HOSTILE, total=2) as advance:
        advance("\x1b]0;title\x07[/][bold]x")
        advance()
    captured = capsys.readouterr()
    assert captured.out == ""
    error = captured.err
    assert SHOWN in error
    assert r"\x1b]0;title\x07[/][bold]x" in error


def test_errors_and_warnings_of_hostile_names_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for words, status in (
        (["info", f"{HOSTILE}.ply"], 1),
        (["detect", f"{HOSTILE}.png"], 1),
        (["info", f"{HOSTILE}.xml"], 1),
        (["capture", f"{HOSTILE}.obj"], 1),
        ([HOSTILE], 2),
        (["render", "a.ply", "--fps", HOSTILE], 2),
        (["render", "a.ply", f"--{HOSTILE}", "1"], 2),
    ):
        assert cli.main(words) == status
        error = capsys.readouterr().err
        assert len(error.splitlines()) == 1, error
        assert "[red]b[/]" in error
        assert error.rstrip("\n").isprintable()
    with warnings.catch_warnings(), cli._plain_warnings():
        warnings.simplefilter("always")
        assert warnings.formatwarning(
            HOSTILE, UserWarning, "", 0
        ) == f"mi-splat: warning: {SHOWN}\n".replace("\\r", " ")


def test_a_warning_is_said_once() -> None:
    """A set is read for its training and for its held-out images, and may be warned of
    twice.
    """
    with warnings.catch_warnings(), cli._plain_warnings():
        texts = ("12 masks missing", "12 masks  missing", "another")
        said = [warnings.formatwarning(text, UserWarning, "", 0) for text in texts]
    assert said == [
        "mi-splat: warning: 12 masks missing\n",
        "",
        "mi-splat: warning: another\n",
    ]
