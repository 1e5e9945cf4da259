"""A field says once what it takes: flags, constructors and files refuse the same values
in the same words.
"""

import dataclasses
import json
import math
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest

from attacks import cli
from attacks.cli import command_of, parse, parser_of
from mi_splat.cli.console import UsageError
from mi_splat.cli.flags import Option, options_of
from mi_splat.fields import (
    Checked,
    FieldError,
    Range,
    above,
    at_least,
    between,
    checked_number,
    decode,
    field_type,
)

NEEDED = {
    "capture": ["car_street"],
    "prepare": ["photos", "--out", "out"],
    "train": ["set", "--out", "out"],
    "render": ["a.ply"],
    "convert": ["a.ply", "b.spz"],
    "compare": ["a.ply"],
    "select": ["a.ply"],
    "poison": ["set", "a.ply"],
    **{name: ["a.ply"] for name in ("dagger", "dagger --region")},
    "detect": ["a.ply"],
    "evaluate": ["a.ply", "b.ply"],
    "info": ["a.ply"],
    "audit": ["a.ply"],
    "bound": ["a.ply"],
    "cloak": ["study.toml"],
    "view": ["a.ply"],
    "artifact": ["out/study"],
    "artifact-check": ["out/artifact"],
    "rows": ["out/result"],
    "study": ["plan", "study.toml"],
}
"""What a command cannot do without."""


def parsed(command: str, words: list[str]) -> Any:
    return parse(command, [*NEEDED.get(command, []), *words])


def ranges(hint: Any) -> tuple[Range | None, int, bool]:
    """What numbers a field takes, how many at least (0 for none), and whether whole
    ones.
    """
    kind, marks, *_ = field_type(hint)
    allowed = next((mark for mark in marks if isinstance(mark, Range)), None)
    if typing.get_origin(kind) is tuple:
        parts = typing.get_args(kind)
        inner, count, whole = ranges(parts[0])
        return (
            allowed or inner,
            (1 if parts[-1] is Ellipsis else len(parts)) * min(count, 1),
            whole,
        )
    return allowed, int(kind in (int, float)), kind is int


def wrong_values(allowed: Range, whole: bool) -> list[float]:
    """Numbers just outside of a range, and what is no finite number."""
    wrong: list[float] = [] if whole else [math.nan, math.inf]
    if math.isfinite(allowed.low):
        wrong.append(int(allowed.low) - (0 if allowed.open_low else 1))
    if math.isfinite(allowed.high):
        wrong.append(int(allowed.high) + (0 if allowed.open_high else 1))
    return wrong


def flat(options: list[Option]) -> Iterator[Option]:
    """Options, and those of the dataclasses among them."""
    for option in options:
        yield option
        yield from flat(option.fields)


def options_given(command: str) -> list[Option]:
    given = parsed(command, [])
    return options_of(
        type(given),
        {field.name: getattr(given, field.name) for field in dataclasses.fields(given)},
    )


FLAGS = [
    (command, option.flag, *ranges(option.hint))
    for command in cli.COMMANDS
    for option in flat(options_given(command))
    if not option.given.positional and not option.fields
]
RANGED = [
    (command, flag, allowed, count, whole)
    for command, flag, allowed, count, whole in FLAGS
    if count and allowed
]


def flag_words(flag: str, number: float, count: int) -> list[str]:
    """A flag with so many of a number, as a user writes it."""
    mark = {"--size": "x", "--background": ","}.get(flag)
    if mark is None:
        return [flag, *[str(number)] * count]
    return [flag, mark.join([str(number)] * count)]


def is_no_word(flag: str, number: float) -> bool:
    """Whether a flag that takes one word makes no number of it: it is refused as no
    size, or as no colour.
    """
    return (flag == "--size" and number < 0) or (
        flag == "--background" and not math.isfinite(number)
    )


@pytest.mark.parametrize(
    ("command", "flag", "allowed", "count", "whole"),
    RANGED,
    ids=[f"{case[0]} {case[1]}" for case in RANGED],
)
def test_flags_refuse_in_the_same_words(
    command: str,
    flag: str,
    allowed: Range,
    count: int,
    whole: bool,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for number in wrong_values(allowed, whole):
        if is_no_word(flag, number):
            continue
        with pytest.raises(FieldError) as expected:
            checked_number(
                flag,
                float(number) if flag == "--background" else number,
                allowed,
                whole=whole,
            )
        with pytest.raises(UsageError) as refused:
            parsed(command, flag_words(flag, number, count))
        assert str(refused.value) == str(expected.value)
    with pytest.raises(UsageError, match=f"^{flag}: expected "):
        parsed(
            command,
            [flag, *["many"] * (1 if flag in ("--size", "--background") else count)],
        )
    assert capsys.readouterr().out == ""


def test_ranges_say_what_they_hold() -> None:
    assert str(at_least(1, "steps")) == "a number >= 1 (steps)"
    assert str(between(0, 2**31 - 1)) == "a number in [0, 2147483647]"
    assert str(Range(unit="metres")) == "a number (metres)"
    half_open = Range(low=0, high=1, open_low=True)
    assert str(half_open) == "a number in (0, 1]"
    assert [half_open.holds(x) for x in (0.0, 0.5, 1.0, 1.1, math.nan)] == [
        False,
        True,
        True,
        False,
        False,
    ]
    assert not Range().holds(math.inf)


@dataclass(frozen=True, kw_only=True)
class Shape(Checked):
    """Of every kind of field."""

    size: Annotated[float, above(0, "metres")] = 1.0
    corners: tuple[Annotated[int, at_least(0)], ...] = ()
    at: tuple[float, float] = (0.0, 0.0)
    kind: Literal["round", "square"] = "round"
    width: Annotated[float | tuple[float, ...], at_least(0)] = 1.0
    name: str | None = None
    path: Path | None = None
    closed: bool = False


def test_values_become_those_of_python() -> None:
    shape = Shape(
        size=np.float32(0.5),  # type: ignore[arg-type]
        corners=np.array([1, 2]),  # type: ignore[arg-type]
        at=[1, 2],  # type: ignore[arg-type]
        path="a.ply",  # type: ignore[arg-type]
    )
    assert shape == Shape(size=0.5, corners=(1, 2), at=(1, 2), path=Path("a.ply"))
    assert json.dumps([shape.size, shape.corners, shape.at])
    assert Shape(corners=3).corners == (3,)  # type: ignore[arg-type]
    assert Shape(width=(1, 2)).width == (1, 2)
    assert decode(
        Shape, {"size": 2, "corners": [1], "width": [0.5, 1], "path": "a"}, "x"
    ) == Shape(size=2.0, corners=(1,), width=(0.5, 1.0), path=Path("a"))
    assert decode(Shape, {"corners": 3}, "x").corners == (3,)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"size": True}, "size: expected a number > 0 \\(metres\\), got True"),
        ({"corners": (1, 2.0)}, "corners: expected a whole number >= 0, got 2.0"),
        ({"at": (1, 2, 3)}, r"at: expected 2 values, got \(1, 2, 3\)"),
        (
            {"kind": "squar"},
            "kind: expected one of round, square, got squar; did you mean square?",
        ),
        ({"width": (1, -1)}, "width: expected a number >= 0, got -1"),
        ({"name": 3}, "name: expected a text, got 3"),
        ({"closed": 1}, "closed: expected true or false, got 1"),
    ],
)
def test_other_values_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(FieldError, match=message):
        Shape(**values)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"siz": 1}, "key in x: expected one of size, .*, got siz; did you mean size"),
        (
            {"corners": {"a": 1}},
            "x, corners: expected a list, got {'a': 1}; write it in brackets",
        ),
        ({"at": [1]}, r"x, at: expected a list of 2, got \[1\]"),
        ({"closed": "yes"}, "x, closed: expected true or false, got 'yes'"),
    ],
)
def test_other_tables_are_refused(table: dict[str, Any], message: str) -> None:
    with pytest.raises(FieldError, match=message):
        decode(Shape, table, "x")


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_help_begins_with_examples_and_explains_every_flag(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([*command.split(), "--help"]) == 0
    text = capsys.readouterr().out
    assert text.index("Examples:") < text.index("See also:") < text.index("-h, --help")
    assert "(default: )" not in text
    for action in parser_of(command)._actions:
        assert action.help, action.dest
        assert action.metavar or action.nargs == 0, action.option_strings
        if isinstance(action.metavar, tuple):
            metavars = action.metavar
        else:
            metavars = (str(action.metavar),)
        assert (
            isinstance(action.nargs, str)
            or action.nargs in (None, 0)
            or len(metavars) == action.nargs
        )
        # one flag in every command, --detectors
        assert "--detector" not in action.option_strings


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_examples_can_be_parsed(command: str) -> None:
    examples = cli.examples_of(command)
    assert examples
    for line in examples:
        parse(*command_of(line.split()))


def test_words_may_stand_in_any_order() -> None:
    options = parsed(
        "detect",
        ["--out", "o", "b.png", "--min_confidence=0.5", "--detectors", "x", "y"],
    )
    assert [path.name for path in options.inputs] == ["a.ply", "b.png"]
    assert (options.out.name, options.min_confidence, options.detectors) == (
        "o",
        0.5,
        ("x", "y"),
    )


def test_none_stands_for_no_value() -> None:
    assert (
        parsed("train", ["--max-gaussians", "none"]).fit.strategy.max_gaussians is None
    )
    assert parsed("detect", ["--weights", "none"]).weights == ()
