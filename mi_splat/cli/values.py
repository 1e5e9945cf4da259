"""Sizes, colours and directions as options: each is written in a way of its own. Light, so that --help is fast.

Each is one word for the parser, so that a file may follow it. `as_one_word` makes one of the three numbers of a colour
or a direction, and lets `--up -y` through, which would look like a flag.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Annotated

from mi_splat.cli.console import UsageError
from mi_splat.cli.flags import Word
from mi_splat.errors import message, nearest
from mi_splat.fields import Called, between

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_AXIS = re.compile(r"[+-]?[xyz]")
_AXES = {
    f"{sign}{'xyz'[axis]}": tuple((-1.0 if sign == "-" else 1.0) if axis == place else 0.0 for place in range(3))
    for sign in ("", "+", "-")
    for axis in range(3)
}


def _size(word: str) -> tuple[int, int]:
    """Width and height of a word."""
    parts = word.lower().split("x")
    if len(parts) > 2 or not all(part.isdecimal() for part in parts):
        raise ValueError(f"expected pixels as 256 or 256x192, got {word!r}")
    return int(parts[0]), int(parts[-1])


def _three(word: str) -> tuple[float, float, float] | None:
    """Three numbers between commas; None if it is something else."""
    parts = word.split(",")
    if len(parts) != 3 or not all(_NUMBER.fullmatch(part.strip()) for part in parts):
        return None
    return float(parts[0]), float(parts[1]), float(parts[2])


def _colour(word: str) -> tuple[float, float, float]:
    """An sRGB colour, by its name, as CSS writes it, or as three numbers."""
    found = _three(word)
    if found is not None:
        return found
    from PIL import ImageColor  # only where it is needed

    try:
        red, green, blue, *rest = ImageColor.getrgb(word)
        if rest:
            raise ValueError(f"{word} is transparent")
    except ValueError:
        do = nearest(word, ImageColor.colormap, "write for instance white, #80b0e0 or 0.5 0.7 0.9")
        raise ValueError(f"expected a colour, got {word!r}; {do}") from None
    return red / 255, green / 255, blue / 255


def _direction(word: str) -> tuple[float, float, float]:
    """A direction, by its axis or as three numbers."""
    found = _AXES.get(word, _three(word))
    if found is None:
        raise ValueError(f"expected an axis such as y or -y, or three numbers, got {word!r}")
    return found[0], found[1], found[2]


def _written(value: Sequence[float]) -> str:
    return " ".join(f"{number:g}" for number in value)


Size = Annotated[
    tuple[int, int],
    Word(_size, lambda size: f"{size[0]}x{size[1]}"),
    between(1, 1 << 15, "pixels", "for instance 256"),
    Called("PIXELS|WIDTHxHEIGHT"),
]
"""Width and height of pictures: 256, or 256x192."""
Colour = Annotated[
    tuple[float, float, float],
    Word(_colour, _written),
    between(0, 1, "sRGB", "divide 8-bit values by 255"),
    Called("COLOUR"),
]
"""An sRGB colour: white, #80b0e0, or three numbers in [0, 1]."""
Direction = Annotated[tuple[float, float, float], Word(_direction, _written), Called("AXIS|X Y Z")]
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
