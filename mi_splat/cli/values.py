"""Sizes, colours and directions as options: each is written in a way of its own. Light, so that --help is fast.

Each is one word for the parser, so that a file may follow it. `as_one_word` makes one of the three numbers of a colour
or a direction, and lets `--up -y` through, which would look like a flag.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec

from mi_splat.cli.ranges import UsageError
from mi_splat.errors import message, nearest

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_AXIS = re.compile(r"[+-]?[xyz]")
_AXES = {
    f"{sign}{'xyz'[axis]}": tuple((-1.0 if sign == "-" else 1.0) if axis == place else 0.0 for place in range(3))
    for sign in ("", "+", "-")
    for axis in range(3)
}


def _size(words: Sequence[str]) -> tuple[int, int]:
    """Width and height of a word."""
    parts = words[0].lower().split("x")
    if len(parts) > 2 or not all(part.isdecimal() for part in parts):
        raise ValueError(f"expected pixels as 256 or 256x192, got {words[0]!r}")
    return int(parts[0]), int(parts[-1])


def _three(word: str) -> tuple[float, float, float] | None:
    """Three numbers between commas; None if it is something else."""
    parts = word.split(",")
    if len(parts) != 3 or not all(_NUMBER.fullmatch(part.strip()) for part in parts):
        return None
    return float(parts[0]), float(parts[1]), float(parts[2])


def _colour(words: Sequence[str]) -> tuple[float, float, float]:
    """An sRGB colour, by its name, as CSS writes it, or as three numbers."""
    found = _three(words[0])
    if found is not None:
        return found
    from PIL import ImageColor  # only where it is needed

    try:
        red, green, blue, *rest = ImageColor.getrgb(words[0])
        if rest:
            raise ValueError(f"{words[0]} is transparent")
    except ValueError:
        do = nearest(words[0], ImageColor.colormap, "write for instance white, #80b0e0 or 0.5 0.7 0.9")
        raise ValueError(f"expected a colour, got {words[0]!r}; {do}") from None
    return red / 255, green / 255, blue / 255


def _direction(words: Sequence[str]) -> tuple[float, float, float]:
    """A direction, by its axis or as three numbers."""
    found = _AXES.get(words[0], _three(words[0]))
    if found is None:
        raise ValueError(f"expected an axis such as y or -y, or three numbers, got {words[0]!r}")
    return found[0], found[1], found[2]


def _numbers(value: Sequence[float]) -> list[str]:
    return [" ".join(f"{one:g}" for one in value)]


def _spec(
    read: Callable[[Sequence[str]], Any], count: int, metavar: str, write: Callable[[Any], list[str]]
) -> PrimitiveConstructorSpec[Any]:
    """How the parser makes a tuple of so many numbers of one word."""
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, tuple) and len(value) == count,
        str_from_instance=write,
    )


Size = Annotated[tuple[int, int], _spec(_size, 2, "PIXELS|WIDTHxHEIGHT", lambda v: [f"{v[0]}x{v[1]}"])]
"""Width and height of pictures: 256, or 256x192."""
Colour = Annotated[tuple[float, float, float], _spec(_colour, 3, "COLOUR", _numbers)]
"""An sRGB colour: white, #80b0e0, or three numbers in [0, 1]."""
Direction = Annotated[tuple[float, float, float], _spec(_direction, 3, "AXIS|X Y Z", _numbers)]
"""A direction: y, -y, or three numbers."""


def as_one_word(words: Sequence[str]) -> list[str]:
    """Words of the user, in which the values of these options are one word each, behind an equals sign.

    Raises:
        UsageError: A size is two numbers.
    """
    found, rest = [], list(words)
    while rest:
        word = rest.pop(0)
        if word == "--size" and len(rest) > 1 and rest[0].isdecimal() and rest[1].isdecimal():
            expected, got = "pixels as 256 or 256x192", f"{rest[0]} {rest[1]}"
            raise UsageError(message("--size", expected, got, f"write {rest[0]}x{rest[1]}"))
        if word in ("--background", "--up") and len(rest) > 2 and all(map(_NUMBER.fullmatch, rest[:3])):
            word, rest = f"{word}={','.join(rest[:3])}", rest[3:]
        elif word in ("--up", "--front") and rest and _AXIS.fullmatch(rest[0]):
            axis = rest.pop(0).removeprefix("+")
            word = f"{word}={'+' if word == '--front' and len(axis) == 1 else ''}{axis}"
        found.append(word)
    return found
