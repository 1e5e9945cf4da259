"""Sizes, colours, directions and detectors are written in one way in every command."""

from __future__ import annotations

from typing import Any

import pytest

from attacks import cli
from attacks.cli import parse, parser_of


@pytest.mark.parametrize("command", ["render", "capture", "view", "dagger", "train"])
def test_values_have_one_spelling_in_every_command(command: str) -> None:
    def option(name: str, *words: str) -> object:
        needed = {"train": ["set", "--out", "out"], "dagger": [], "view": ["a"], "render": ["a"], "capture": ["a"]}
        options = parse(command, [*needed[command], f"--{name}", *words])
        return getattr(options, name, None) or getattr(getattr(options, "view", options), name)

    if command != "train":
        assert option("size", "128") == (128, 128)
        assert option("size", "256x192") == (256, 192)
    if command != "capture":
        assert option("background", "white") == option("background", "1", "1", "1") == (1.0, 1.0, 1.0)
        assert option("background", "#80b0e0") == (128 / 255, 176 / 255, 224 / 255)
        assert option("background", "SkyBlue") == (135 / 255, 206 / 255, 235 / 255)


def options_of(command: str, *words: str) -> Any:
    return parse(command, words)


def test_an_axis_is_a_letter_or_three_numbers() -> None:
    up: tuple[float, ...]
    for typed, up in (("-y", (0, -1, 0)), ("+x", (1, 0, 0)), ("0 -1 0", (0, -1, 0)), ("z", (0, 0, 1))):
        options = options_of("render", "--up", *typed.split(), "a.ply")
        assert (options.view.up, options.scene.name) == (up, "a.ply")
    for typed, axis in (("-z", "-z"), ("+y", "y"), ("x", "x")):
        assert options_of("capture", "a.ply", "--up", typed).mesh.up == axis
    for typed, front in (("y", "+y"), ("-x", "-x")):
        assert options_of("capture", "a.ply", "--front", typed).mesh.front == front


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_detectors_are_named_by_one_flag(command: str) -> None:
    flags = {flag for action in parser_of(command)._actions for flag in action.option_strings}
    assert "--detector" not in flags
