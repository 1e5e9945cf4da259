"""What numbers each option takes: one table, by the name of the option, for every command that has it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

from mi_splat.errors import MiSplatError, message


class UsageError(MiSplatError):
    """An option that makes no sense; the command line prints it and exits with status 2."""


@dataclass(frozen=True, slots=True)
class Range:
    """The numbers that an option takes, each number of it if it takes several.

    Attributes:
        low: The least, -inf for none.
        high: The greatest, inf for none; infinite numbers are never taken.
        open_low: Whether `low` itself is left out.
        open_high: Whether `high` itself is left out.
        unit: What is counted or measured, in words.
        do: What to do with another number.
    """

    low: float = -math.inf
    high: float = math.inf
    open_low: bool = False
    open_high: bool = False
    unit: str = ""
    do: str = "change it"

    def holds(self, value: float) -> bool:
        """Whether the option takes a number."""
        above = value > self.low if self.open_low else value >= self.low
        below = value < self.high if self.open_high else value <= self.high
        return math.isfinite(value) and above and below

    def __str__(self) -> str:
        if math.isinf(self.high):
            words = "a number" if math.isinf(self.low) else f"a number {'>' if self.open_low else '>='} {self.low:g}"
        else:
            words = f"a number in {'(' if self.open_low else '['}{self.low:g}, {self.high:g}"
            words += ")" if self.open_high else "]"
        return f"{words} ({self.unit})" if self.unit else words


def at_least(low: float, unit: str = "", do: str = "change it") -> Range:
    """The numbers from `low` on."""
    return Range(low=low, unit=unit, do=do)


def above(low: float, unit: str = "", do: str = "change it") -> Range:
    """The numbers greater than `low`."""
    return Range(low=low, open_low=True, unit=unit, do=do)


FRACTION = Range(0.0, 1.0)
POSITIVE_FRACTION = Range(0.0, 1.0, open_low=True)
SEED = Range(0, 2**31 - 1, unit="whole", do="0 is usual")
LENGTH = above(0, "world units")

RANGES: dict[str, Range] = {
    # cameras and pictures
    "azimuth": Range(-360, 360, unit="degrees"),
    "elevation": Range(-90, 90, unit="degrees", do="90 is straight down"),
    "distance": LENGTH,
    "near": LENGTH,
    "centre": Range(unit="world units"),
    "fov": Range(0, 180, open_low=True, open_high=True, unit="degrees", do="45 is usual"),
    "up": Range(),
    "fps": Range(0, 1000, open_low=True, unit="pictures a second", do="24 is usual"),
    "size": Range(1, 1 << 15, unit="pixels", do="for instance 256"),
    "background": Range(0, 1, unit="sRGB", do="divide 8-bit values by 255"),
    # selection
    "box": Range(unit="world units"),
    "box_rotation": Range(-360, 360, unit="degrees"),
    "cluster": at_least(1, do="1 is the largest"),
    "link_distance": above(0, do="1.5 is usual"),
    "link_colour": FRACTION,
    "planes": Range(0, 20, do="1 is usual"),
    # capture
    "samples": Range(1, 1 << 16, unit="samples per pixel", do="32 is usual"),
    "test": Range(0, 100_000, unit="pictures"),
    "scale": above(0, "metres per unit of the file"),
    "rotate": Range(-360, 360, unit="degrees"),
    "points": Range(0, 100_000_000, unit="points"),
    # training
    "iterations": at_least(1, "steps"),
    "random": Range(1, 100_000_000, unit="Gaussians"),
    "outliers": Range(0, 100_000_000, unit="Gaussians"),
    "downscale": Range(1, 64, unit="times smaller"),
    "checkpoint_every": at_least(1, "steps", "1000 is usual"),
    "eval_interval": at_least(0, "steps", "0 evaluates at the end only"),
    "sh_degree": Range(0, 3),
    "sh_degree_interval": at_least(0, "steps"),
    "lambda_dssim": FRACTION,
    "lr_means": above(0),
    "lr_means_final": above(0),
    "lr_scales": at_least(0),
    "lr_rotations": at_least(0),
    "lr_opacities": at_least(0),
    "lr_sh": at_least(0),
    "lr_sh_final": above(0),
    "max_gaussians": Range(1, 100_000_000, unit="Gaussians", do="leave it out for no limit"),
    "densify_from": at_least(0, "steps"),
    "densify_until": at_least(0, "steps"),
    "densify_interval": at_least(1, "steps"),
    "densify_grad_threshold": at_least(0),
    "percent_dense": at_least(0, "shares of the scene's extent"),
    "prune_opacity": FRACTION,
    "prune_scale": above(0, "shares of the scene's extent"),
    "opacity_reset_interval": at_least(0, "steps"),
    "growth": at_least(0),
    "dead_opacity": FRACTION,
    "noise_lr": at_least(0),
    "opacity_reg": at_least(0),
    "scale_reg": at_least(0),
    # example scenes
    "views": at_least(1, "pictures"),
    "steps": at_least(1, "steps"),
    "seed": SEED,
}
"""Name of an option to the numbers that it takes; dashes are underscores here."""


def check_ranges(options: object, ranges: Mapping[str, Range]) -> None:
    """Raise unless every number among the options of a command is one that it takes.

    Args:
        options: A dataclass; options may be dataclasses themselves.
        ranges: The table.

    Raises:
        UsageError: A number is out of its range.
    """
    for name, value in numeric_options(options):
        check_range(name, value, ranges)


def check_range(name: str, value: float, ranges: Mapping[str, Range]) -> None:
    """Raise unless a number is one that an option takes.

    Args:
        name: Of the option, with underscores.
        value: The number.
        ranges: The table; an option that is not in it takes any.

    Raises:
        UsageError: It is not.
    """
    if name in ranges and not ranges[name].holds(value):
        expected, limits = str(ranges[name]), (ranges[name].low, ranges[name].high)
        if not (math.isfinite(value) or all(map(math.isfinite, limits))):
            expected = expected.replace("a number", "a finite number", 1)
        raise UsageError(message(f"--{name.replace('_', '-')}", expected, value, ranges[name].do))


def numeric_options(options: object) -> Iterator[tuple[str, Any]]:
    """Name and value of every number among options; of several numbers each."""
    for field in dataclasses.fields(options):  # type: ignore[arg-type]  # a dataclass, as said above
        value = getattr(options, field.name)
        if dataclasses.is_dataclass(value):
            yield from numeric_options(value)
            continue
        yield from ((field.name, one) for one in numbers_of(value))


def numbers_of(value: object) -> Iterator[Any]:
    """The numbers of an option, which has one value or several."""
    for one in value if isinstance(value, tuple) else (value,):
        if isinstance(one, Real) and not isinstance(one, bool):
            yield one


def take_max_pixels(words: list[str]) -> int | None:
    """The number behind --max-pixels, which every command takes; None if it is not there.

    Args:
        words: What the user typed; the flag and its number are removed.

    Raises:
        UsageError: It is no number of pixels.
    """
    found = None
    for word in [word for word in words if word.partition("=")[0] in ("--max-pixels", "--max_pixels")]:
        place = words.index(word)
        values = [word.partition("=")[2]] if "=" in word else words[place + 1 : place + 2]
        del words[place : place + (1 if "=" in word else 2)]
        if not values or not values[0].isdecimal() or len(values[0]) > 18 or int(values[0]) < 1:
            got = values[0][:40] if values else "nothing"
            raise UsageError(f"--max-pixels: expected a number of pixels, 1 or more, got {got}; 50000000 is usual")
        found = int(values[0])
    return found
