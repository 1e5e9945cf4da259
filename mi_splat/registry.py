"""Things by their names: those of this project, those that a script registers, and
those of other installed packages.

Another package names what it brings in its pyproject.toml, in the group of a registry:

    [project.entry-points."mi_splat.detectors"]
    my_detector = "my_package.detector:SPEC"

Looking at names imports nothing. Such a value is imported when it is asked for, so that
a package that is broken breaks nothing but itself, and the error names it.
docs/plug-ins.md has a section for each group.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import TypeVar

from mi_splat.errors import InvalidValueError, MiSplatError, nearest

_Value = TypeVar("_Value")
_OURS = "mi_splat."
"""How the names of our groups begin."""


class Registry(Mapping[str, _Value]):
    """Values of one kind by their names: first the project's own and those registered,
    then those of other packages.
    """

    def __init__(
        self,
        group: str,
        expected: str,
        fits: Callable[[object], bool],
        *,
        what: str,
        error: type[MiSplatError] = InvalidValueError,
    ) -> None:
        self.group = group
        self.what = what
        self.own: dict[str, _Value] = {}
        self._expected = expected
        self._fits = fits
        self._error = error

    def __getitem__(self, name: str) -> _Value:
        """A value by its name."""
        if name in self.own:
            return self.own[name]
        return self._brought(_points(self.group)[name])

    def __iter__(self) -> Iterator[str]:
        yield from self.own
        yield from self.brought

    def __len__(self) -> int:
        return len(self.own) + len(self.brought)

    def __contains__(self, name: object) -> bool:
        return name in self.own or name in _points(self.group)

    @property
    def brought(self) -> tuple[str, ...]:
        """Names that other packages bring; nothing of them is imported."""
        return tuple(name for name in _points(self.group) if name not in self.own)

    def add(self, name: str, value: _Value) -> None:
        """Register a value for this process."""
        if name in self.own:
            raise self._error.of(
                self.what, "a name that is free", repr(name), "choose another name"
            )
        self.own[name] = value

    def chosen(self, name: object) -> _Value:
        """A value by a name that a user gave."""
        if not isinstance(name, str) or name not in self:
            do = nearest(str(name), self, "choose one of them")
            raise self._error.of(self.what, " or ".join(self), repr(name), do)
        return self[name]

    def package(self, name: str) -> str:
        """Which package brings a value, as "my-package 1.0"; empty for the project's
        own and registered ones.
        """
        if name in self.own:
            return ""
        return _package(_points(self.group)[name][0])

    def _brought(self, points: tuple[EntryPoint, ...]) -> _Value:
        point = points[0]
        what = (
            f"entry point {point.name} = {point.value} of {_package(point)}"
            f" ({self.group})"
        )
        if len(points) > 1:
            others = " and ".join(_package(point) for point in points)
            raise self._error.of(
                what, "one package that brings it", others, "uninstall one of them"
            )
        try:
            value = point.load()
        except Exception as error:  # what another package raises has no common base
            got = f"{type(error).__name__}: {error}"
            do = f"repair or uninstall {_package(point)}"
            raise self._error.of(
                what, "something that can be imported", got, do
            ) from error
        named = getattr(value, "name", point.name)
        if not self._fits(value) or named != point.name:
            if self._fits(value):
                got = f"one of the name {named}"
            else:
                got = type(value).__name__
            raise self._error.of(
                what,
                f"{self._expected} of the name {point.name}",
                got,
                "correct it there",
            )
        kept: _Value = value
        return kept


def brought_by_packages() -> list[tuple[str, str, str]]:
    """Everything that other packages bring, in whatever group of ours; nothing is
    imported.
    """
    groups = sorted(group for group in entry_points().groups if group.startswith(_OURS))
    points = (point for group in groups for point in entry_points(group=group))
    return [
        (point.group, point.name, f"{point.value} of {_package(point)}")
        for point in points
    ]


def _points(group: str) -> dict[str, tuple[EntryPoint, ...]]:
    return _points_on(group, tuple(sys.path))


@functools.lru_cache(maxsize=32)
def _points_on(group: str, path: tuple[str, ...]) -> dict[str, tuple[EntryPoint, ...]]:
    """Entry points by their names; folders are looked through once, for that takes as
    long as an image.
    """
    points: dict[str, tuple[EntryPoint, ...]] = {}
    for point in entry_points(group=group):
        points[point.name] = (*points.get(point.name, ()), point)
    return points


def _package(point: EntryPoint) -> str:
    distribution = point.dist
    if distribution is None:
        return "an unknown package"
    return f"{distribution.name} {distribution.version}"
