"""Configurations of the kinds of jobs that tests run."""

import enum
from dataclasses import dataclass, field


class Sign(enum.Enum):
    """Of a number."""

    PLUS = 1
    MINUS = -1


@dataclass(frozen=True, kw_only=True)
class Shift:
    """A part of a configuration."""

    by: float = 0.0
    sign: Sign = Sign.PLUS


@dataclass(frozen=True, kw_only=True)
class NumbersConfig:
    """Of `numbers`."""

    values: tuple[float, ...] = (1.0,)
    shift: Shift = field(default_factory=Shift)
    name: str = "sum"
    most: int | None = None
    loud: bool = False


@dataclass(frozen=True, kw_only=True)
class WalkConfig:
    """Of `walk`."""

    start: int = 0
    steps: int = 1
    seconds: float = 0.0
    trouble: str = ""
