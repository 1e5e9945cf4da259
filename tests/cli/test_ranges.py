"""Every number of every command has a range, and a number out of it is refused before any work is done."""

from __future__ import annotations

import dataclasses
import importlib
import math
import typing
from collections.abc import Iterator
from typing import Any

import pytest
from tyro.conf import OmitArgPrefixes

from attacks import cli
from attacks.cli.examples import EXAMPLES, SEE_ALSO
from attacks.cli.parsing import parse
from attacks.cli.ranges import ALL_RANGES
from mi_splat.cli.ranges import RANGES, Range, UsageError, at_least, check_range, check_ranges, numeric_options
from mi_splat.training.strategies import strategy_config, strategy_names

NEEDED = {
    "capture": ["car_street"],
    "train": ["set", "--out", "out"],
    "render": ["a.ply"],
    "convert": ["a.ply", "b.spz"],
    "compare": ["a.ply"],
    "select": ["a.ply"],
    "detect": ["a.ply"],
    "evaluate": ["a.ply", "b.ply"],
    "info": ["a.ply"],
    "example-scenes": ["stop_sign"],
    "cloak": ["study.toml"],
    "study": ["plan", "study.toml"],
    "rendering-study": ["study.toml"],
    "view": ["a.ply"],
    "cloak-experiment": ["surroundings", "study.toml"],
    "artifact": ["out/study"],
    "rows": ["out/study"],
    "artifact-check": ["out/artifact"],
}
"""What a command cannot do without."""


def numbers(kind: Any, prefix: str = "", *, bare_names: bool = False) -> Iterator[tuple[str, str, bool, int]]:
    """Name and flag of every option of a dataclass that takes numbers, whether whole ones, and how many at least."""
    hints, plain = typing.get_type_hints(kind, include_extras=True), typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        hint, within = hints[field.name], f"{prefix}{field.name}."
        bare = plain[field.name]
        if dataclasses.is_dataclass(bare):
            omits = bare_names or (hint is not bare and OmitArgPrefixes in hint.__metadata__)
            yield from numbers(bare, prefix if omits else within, bare_names=omits)
            continue
        parts = [part for part in (*typing.get_args(bare), bare) if part in (int, float) or typing.get_origin(part)]
        inner = [part for part in parts if typing.get_origin(part) is tuple]
        kinds = [part for part in (typing.get_args(inner[0]) if inner else parts) if part in (int, float)]
        if kinds:
            flag = f"--{prefix}{field.name}".replace("_", "-")
            yield field.name, flag, kinds[0] is int, len(kinds)


def cases() -> Iterator[tuple[str, str, str, bool, int]]:
    for name, command in cli.COMMANDS.items():
        options = getattr(importlib.import_module(f"{command.package}.{command.options_module}"), command.options)
        for option in numbers(options):
            yield name, *option


CASES = list(cases())


def wrong_values(allowed: Range) -> list[str]:
    """What is no finite number, and numbers just outside of a range."""
    wrong = ["nan", "inf"]
    if math.isfinite(allowed.low):
        wrong.append(str(int(allowed.low) - (0 if allowed.open_low else 1)))
    if math.isfinite(allowed.high):
        wrong.append(str(int(allowed.high) + (0 if allowed.open_high else 1)))
    return wrong


def right_value(allowed: Range, whole: bool) -> str:
    """A number inside of a range."""
    low = allowed.low if math.isfinite(allowed.low) else 0
    value = (low + min(allowed.high, low + 2)) / 2
    return str(int(value) if whole else value)


def said(flag: str, number: str, count: int) -> list[str]:
    """A flag with so many of a number, as a user writes it."""
    return [flag, "x".join([number] * count)] if flag == "--size" else [flag, *[number] * count]


def options_of(command: str, words: list[str]) -> object:
    return parse(command, cli.COMMANDS[command], [*NEEDED.get(command, []), *words])


def test_there_are_options_to_walk_through() -> None:
    assert len(CASES) > 60
    assert ("render", "distance", "--distance", False, 1) in CASES
    assert ("train", "lr_means", "--lr-means", False, 1) in CASES
    assert ("render", "background", "--background", False, 3) in CASES


@pytest.mark.parametrize(("command", "name", "flag", "whole", "count"), CASES, ids=[f"{c[0]} {c[2]}" for c in CASES])
def test_wrong_numbers_are_refused(
    command: str, name: str, flag: str, whole: bool, count: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each wrong number by the table, and the last, just outside, on the whole command line, too."""
    assert name in ALL_RANGES, f"{flag} of {command} has no range: add one to the table"
    wrong = wrong_values(ALL_RANGES[name])
    for number in wrong:
        with pytest.raises(UsageError):
            check_range(name, float(number), ALL_RANGES)
    with pytest.raises((UsageError, SystemExit)) as refused:
        options_of(command, said(flag, wrong[-1], count))
    assert getattr(refused.value, "code", 2) == 2
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("command", sorted({case[0] for case in CASES}))
def test_right_numbers_are_taken(command: str) -> None:
    """All of a command at once, but two seeds that have to differ."""
    together: list[str] = []
    for name, flag, whole, count in (case[1:] for case in CASES if case[0] == command):
        words = said(flag, right_value(ALL_RANGES[name], whole), count)
        if name == "judge_seed":
            options_of(command, words)
        else:
            together += words
    options_of(command, together)


@pytest.mark.parametrize("kind", sorted({(whole, count) for _, _, _, whole, count in CASES}), ids=str)
def test_what_is_no_number_is_refused(kind: tuple[bool, int], capsys: pytest.CaptureFixture[str]) -> None:
    """For one option of each kind that there is; the others have the same types."""
    command, _, flag, _, count = next(case for case in CASES if case[3:] == kind)
    for wrong in ["nan", "many"] if kind[0] else ["nan", "inf", "many"]:
        with pytest.raises((UsageError, SystemExit)) as refused:
            options_of(command, [flag, *[wrong] * count])
        assert getattr(refused.value, "code", 2) == 2
        assert capsys.readouterr().out == ""


@pytest.mark.parametrize("strategy", strategy_names())
def test_every_option_of_a_strategy_has_a_range(strategy: str) -> None:
    options = strategy_config(strategy)
    assert {name for name, _ in numeric_options(options)} <= set(RANGES)
    check_ranges(options, RANGES)


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_the_defaults_are_in_range(command: str) -> None:
    parse(command, cli.COMMANDS[command], NEEDED.get(command, []))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["render", "a.ply", "--distance", "-1"], "--distance: expected a number > 0 (world units), got -1.0"),
        (["render", "a.ply", "--background", "255", "255", "255"], "divide 8-bit values by 255"),
        (["render", "a.ply", "--azimuth", "nan"], "--azimuth: expected a number in [-360, 360] (degrees), got nan"),
        (["train", "s", "--out", "o", "--eval-interval", "-1"], "--eval-interval: expected a number >= 0 (steps)"),
        (["train", "s", "--out", "o", "--max-gaussians", "0"], "--max-gaussians: expected"),
        (["train", "s", "--out", "o", "--max-gaussians", "-5"], "--max-gaussians: expected"),
    ],
)
def test_the_message_is_one_line_and_says_what_to_do(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert said in captured.err
    assert f"see mi-splat {words[0]} --help" in captured.err
    assert len(captured.err.splitlines()) == 1


def test_ranges_say_what_they_hold() -> None:
    assert str(at_least(1, "steps")) == "a number >= 1 (steps)"
    half_open = Range(0, 1, open_low=True)
    assert str(half_open) == "a number in (0, 1]"
    assert [half_open.holds(x) for x in (0.0, 0.5, 1.0, 1.1, math.nan)] == [False, True, True, False, False]
    assert not Range().holds(math.inf)


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_help_begins_with_what_it_does_and_examples(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert text.index("Examples:") < text.index("-h, --help")
    assert "See also:" in text
    assert "{None}" not in text
    assert "(default: )" not in text


@pytest.mark.parametrize("line", [line for lines in EXAMPLES.values() for line in lines])
def test_examples_can_be_parsed(line: str) -> None:
    command, *words = line.split()
    parse(command, cli.COMMANDS[command], words)


def test_examples_and_neighbours_are_of_commands() -> None:
    assert set(EXAMPLES) == set(SEE_ALSO) == set(cli.COMMANDS)
    assert {other for others in SEE_ALSO.values() for other in others} <= set(cli.COMMANDS)
    assert all(line.split()[0] == command for command, lines in EXAMPLES.items() for line in lines)


def test_none_stands_for_no_value() -> None:
    options: Any = parse("train", cli.COMMANDS["train"], ["s", "--out", "o", "--max-gaussians", "none"])
    assert options.fit.strategy.max_gaussians is None
