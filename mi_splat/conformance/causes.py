"""Which deviations explain the images of a renderer.

A deviation is named only where it holds: under all that are named together images that
differed lie within their tolerance, and none that conformed leaves it. What stays
outside is left unexplained, as nothing in the list is the reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from mi_splat.conformance.deviations import (
    DEVIATIONS,
    Deviation,
    applied,
    changes,
)
from mi_splat.conformance.setups import Setup
from mi_splat.conformance.tolerances import Error, Tolerance, difference
from mi_splat.oracle import Array, Pixels

_FLOOR = 2e-6
"""Mean squared error of 8 bits."""
_SAMPLES = 64
"""Rows and columns that are looked at while searching."""
_CLEARLY = 9.0
_HARDLY = 1.0
"""dB by which an image comes nearer that is explained, and by which one may be further
off that is not.
"""
_ENOUGH = 3
_LESS_EXACT = 9.0
"""Conforming images that show how exact a renderer is; dB by which images under their
causes may be less exact.
"""
_HARD = 3
_BREADTH = 4
_NEARER = 0.1
"""Images to which combinations are fitted where no deviation alone explains more, those
that one more brings nearest; combinations that each of these goes on with; by how much
each deviation lowers the logarithm of the error.
"""

Keys = frozenset[str]


class Cause(NamedTuple):
    """A deviation that explains images."""

    deviation: Deviation
    scenes: tuple[str, ...]  # that conform with it and not without it


def find_causes(
    images: Mapping[str, Array],
    setups: Mapping[str, Setup],
    tolerances: Mapping[str, Tolerance],
) -> list[Cause]:
    """The deviations under which the reference makes the images, the one that explains
    most first.

    Args:
        images: (H, W, 3) by the name of their scene.
        setups: Of every image, what makes its reference.
        tolerances: Of every image, how far it may be off.
    """
    search = _Search(images, setups, tolerances)
    chosen = search.chosen()
    causes = []
    for key in chosen:
        rest = chosen - {key}
        by_it = [
            name for name in search.explained(chosen) if not search.holds(name, rest)
        ]
        causes.append(Cause(DEVIATIONS[key], tuple(by_it)))
    return sorted(causes, key=lambda cause: -len(cause.scenes))


class _Search:
    """Looks at some rows and columns of each image, so that the size of images does not
    matter.
    """

    def __init__(
        self,
        images: Mapping[str, Array],
        setups: Mapping[str, Setup],
        tolerances: Mapping[str, Tolerance],
    ) -> None:
        self.setups = setups
        self.tolerances = dict(tolerances)
        self.least = tolerances  # before more is expected of some
        self.pixels = {name: sampled(image) for name, image in images.items()}
        self.images = {
            name: image[np.ix_(*self.pixels[name])] for name, image in images.items()
        }
        self.errors = dict[tuple[str, Keys], Error]()
        self.references = dict[str, Array]()
        self.shown = set[tuple[str, str]]()
        nothing = Keys()
        self.conforming = [name for name in images if self.holds(name, nothing)]
        self.differing = [name for name in images if name not in self.conforming]
        self.expect_as_exact_as_others()
        self.keys = [
            key
            for key, deviation in DEVIATIONS.items()
            if any(changes(setup, deviation) for setup in setups.values())
        ]

    def expect_as_exact_as_others(self) -> None:
        """Ask of images that differ to be about as exact under their causes as those
        that conform, where there are some: otherwise a deviation that is merely similar
        to what a renderer does would be named.
        """
        nothing = Keys()
        others = [self.error(name, nothing).squared for name in self.conforming]
        if len(others) < _ENOUGH:
            return
        usual = Error(max(float(np.median(others)), _FLOOR), 0.0)
        for name in self.differing:
            tolerance = self.tolerances[name]
            least = max(tolerance.psnr, usual.psnr - _LESS_EXACT)
            self.tolerances[name] = tolerance._replace(psnr=least)

    def error(self, name: str, chosen: Keys) -> Error:
        """How far an image is off under deviations."""
        if len(chosen) > 1:
            chosen = Keys(key for key in chosen if self.shows(name, key))
        if (name, chosen) not in self.errors:
            self.look(name, chosen)
        return self.errors[name, chosen]

    def shows(self, name: str, key: str) -> bool:
        """Whether a scene shows a deviation at all."""
        alone = Keys([key])
        if (name, alone) not in self.errors:
            self.look(name, alone)
        return (name, key) in self.shown

    def look(self, name: str, chosen: Keys) -> None:
        """Render a scene, and keep how far its image is off."""
        setup = applied(self.setups[name], chosen)
        seen, _ = setup.render(self.pixels[name])
        seen = np.nan_to_num(seen)
        self.errors[name, chosen] = difference(self.images[name], seen)
        if not chosen:
            self.references[name] = seen
        elif len(chosen) == 1 and not np.array_equal(seen, self.references[name]):
            self.shown.update((name, key) for key in chosen)

    def holds(self, name: str, chosen: Keys) -> bool:
        """Whether an image is within its tolerance under deviations."""
        return self.tolerances[name].holds(self.error(name, chosen))

    def cost(self, names: Iterable[str], chosen: Keys) -> float:
        """Summed logarithms of the errors."""
        return sum(
            math.log(self.error(name, chosen).squared + _FLOOR) for name in names
        )

    def gain(self, before: Keys, after: Keys) -> int:
        """How many images more are within their tolerance.

        It is 0 if one is no longer, if there are fewer than deviations that were added,
        since a combination fits some image by chance, or if an image that is still off
        is further off: what a renderer does, it does in all of them. An image whose
        error hardly changes counts for nothing.
        """
        every = [*self.differing, *self.conforming]
        held = [name for name in every if self.holds(name, before)]
        left = [name for name in every if name not in held]
        fitted = [name for name in left if self.holds(name, after)]
        gained = sum(self.nears(name, before, after) >= _CLEARLY for name in fitted)
        if gained < max(1, len(after - before)):
            return 0
        if not all(self.least[name].holds(self.error(name, after)) for name in held):
            return 0
        rest = [name for name in left if name not in fitted]
        if any(self.nears(name, before, after) < -_HARDLY for name in rest):
            return 0
        return gained

    def nears(self, name: str, before: Keys, after: Keys) -> float:
        """By how many dB an image comes nearer."""
        return self.error(name, after).psnr - self.error(name, before).psnr

    def chosen(self) -> Keys:
        """Deviations that explain most images."""
        chosen = Keys()
        while left := [name for name in self.differing if not self.holds(name, chosen)]:
            found = self.best(chosen, [_with(chosen, key) for key in self.keys])
            if found == chosen:
                found = self.best(chosen, self.combinations(chosen, left))
            if found == chosen:
                break
            chosen = found
        for key in sorted(chosen):
            chosen = self.nearest_value(chosen, key)
        for key in sorted(chosen):
            rest = chosen - {key}
            if all(self.holds(name, rest) for name in self.explained(chosen)):
                chosen = rest
        return chosen

    def nearest_value(self, chosen: Keys, key: str) -> Keys:
        """The same with a deviation's switch at the value that is nearest to what is
        explained.
        """
        explained = self.explained(chosen)
        switch = DEVIATIONS[key].switch
        others = [
            _with(chosen, other)
            for other in self.keys
            if DEVIATIONS[other].switch == switch
        ]
        hold = [
            other
            for other in others
            if all(self.holds(name, other) for name in [*explained, *self.conforming])
        ]
        return min([chosen, *hold], key=lambda each: self.cost(explained, each))

    def explained(self, chosen: Keys) -> list[str]:
        """The images that differed, and are within their tolerance under deviations."""
        return [name for name in self.differing if self.holds(name, chosen)]

    def best(self, chosen: Keys, candidates: Iterable[Keys]) -> Keys:
        """The candidate that explains most images, of those the one that is nearest to
        all that differ; what was chosen where none explains more.
        """
        gains = {candidate: self.gain(chosen, candidate) for candidate in candidates}
        most = max(gains.values(), default=0)
        if most == 0:
            return chosen
        ties = [candidate for candidate in gains if gains[candidate] == most]
        return min(ties, key=lambda candidate: self.cost(self.differing, candidate))

    def combinations(self, chosen: Keys, left: list[str]) -> list[Keys]:
        """Two or three deviations more that explain an image which no single one
        explains.
        """
        single = [_with(chosen, key) for key in self.keys]
        nearest = sorted(
            left, key=lambda name: min(self.cost([name], each) for each in single)
        )
        found = []
        for name in nearest[:_HARD]:
            keys = [key for key in self.keys if self.shows(name, key)]
            ends = [chosen]
            for _ in range(3):
                longer = {
                    keys_with
                    for end in ends
                    for keys_with in self.nearer(name, end, keys)
                }
                found += [each for each in longer if self.holds(name, each)]
                ends = sorted(longer, key=lambda each: self.cost([name], each))
                ends = ends[:_BREADTH]
        return found

    def nearer(self, name: str, chosen: Keys, keys: Iterable[str]) -> list[Keys]:
        """One deviation more, where it brings an image nearer."""
        before = self.cost([name], chosen)
        longer = (_with(chosen, key) for key in keys)
        return [each for each in longer if self.cost([name], each) < before - _NEARER]


def _with(chosen: Keys, key: str) -> Keys:
    """Deviations and one more, in place of one that sets the same."""
    switch = DEVIATIONS[key].switch
    return Keys(k for k in chosen if DEVIATIONS[k].switch != switch) | {key}


def sampled(image: Array) -> Pixels:
    """Some rows and columns, spread over an image."""
    steps = (max(1, round(count / _SAMPLES)) for count in image.shape[:2])
    along = (
        np.arange(step // 2, count, step)
        for step, count in zip(steps, image.shape, strict=False)
    )
    return Pixels(*along)
