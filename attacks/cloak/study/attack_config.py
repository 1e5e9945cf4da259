"""What an attacker of a study does, as frozen values: each hidden appearance, and how its poison is corrected."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from attacks.cloak.mesh_edits import TEXTURES
from attacks.cloak.study.value_checks import in_range, one_of
from attacks.cloak.triggers import Azimuth, Elevation, Trigger
from mi_splat.assets import ASSETS
from mi_splat.errors import InvalidValueError, message

AppearanceName = Literal["blend in", "remove", "ground", "paint", "occluder", "mount", "swap"]


@dataclass(frozen=True, slots=True, kw_only=True)
class AttackConfig:
    """One hidden appearance.

    Attributes:
        name: For files and tables.
        appearance: How the object is changed. With "remove" one sees what is behind it, with "ground" the ground that
            is laid on it like a cloth.
        texture: With what it is painted (`paint`) or covered (`occluder`).
        other_object: Asset that is mounted on it or takes its place (`mount`, `swap`).
        elevation: Lowest and highest elevation of the cameras from which it is seen, degrees.
        azimuth: Middle and half width of their azimuths, degrees; None is all around.
        poison_margin: Degrees beyond these edges up to which training pictures are poisoned, too, but for those that
            another attack has. A splat changes gradually, so that with a margin it has changed further at the edge.
        poison_fraction: Fraction of the training cameras there whose pictures are poisoned.
        target_class: Class that a detector shall report on the object; None: that it is not found.
        emphasis: How much the appearance is overdone at the edge of its region; see
            `attacks.cloak.emphasis.Emphasis`.
        emphasis_depth: Degrees inside from which it no longer is.
        paint_direction: Azimuth and elevation from which a painted texture looks right, degrees.
        reach: Pixels around the object's outline that are new in a picture; all else, shadows for instance, stays as it
            was. None is the whole picture where the object is removed or swapped, and 1 elsewhere.
        occluder_radius: Of the occluder that covers it, metres; None is 0.6 times the distance of the cameras.
        occluder_edge: Elevation of the occluder's edge, degrees; None is 12 below that of the lowest camera.
    """

    name: str
    appearance: AppearanceName = "blend in"
    texture: str | None = None
    other_object: str | None = None
    elevation: tuple[float, float] = (0.0, 90.0)
    azimuth: tuple[float, float] | None = None
    poison_margin: float = 0.0
    poison_fraction: float = 1.0
    target_class: str | None = None
    emphasis: float = 1.0
    emphasis_depth: float = 20.0
    paint_direction: tuple[float, float] = (180.0, 90.0)
    reach: int | None = None
    occluder_radius: float | None = None
    occluder_edge: float | None = None

    def __post_init__(self) -> None:
        textured = ("texture", TEXTURES)
        needs = {
            "paint": textured,
            "occluder": textured,
            "mount": ("other_object", ASSETS),
            "swap": ("other_object", ASSETS),
        }
        if self.appearance in needs:
            key, known = needs[self.appearance]
            one_of(f"attack {self.name!r}, {key}", getattr(self, key), known)
        if not 0 < self.poison_fraction <= 1:
            raise InvalidValueError(
                message(f"attack {self.name!r}, poison_fraction", "in (0, 1]", self.poison_fraction, "1 is all")
            )
        in_range(f"attack {self.name!r}, poison_margin", self.poison_margin, 0, 90)
        if self.reach is not None and (self.reach < 0 or self.appearance == "occluder"):
            expected = "0 or more pixels, and no occluder, which is drawn over the picture"
            raise InvalidValueError(message(f"attack {self.name!r}, reach", expected, self.reach, "leave it out"))
        if not (self.emphasis >= 1 and self.emphasis_depth > 0):
            got = (self.emphasis, self.emphasis_depth)
            expected = "an emphasis >= 1 and a depth > 0"
            raise InvalidValueError(message(f"attack {self.name!r}", expected, got, "1 overdoes nothing"))
        if self.elevation[0] <= 0 and self.elevation[1] >= 90 and self.azimuth is None:
            expected = "an elevation or an azimuth that leaves cameras out"
            raise InvalidValueError(message(f"attack {self.name!r}", expected, "all cameras", "narrow one of them"))

    @property
    def is_sided(self) -> bool:
        """Whether it matters which way the object faces: cameras, painting or what is mounted lie to one side."""
        painted = self.appearance == "paint" and self.paint_direction[1] < 90
        return self.azimuth is not None or self.appearance == "mount" or painted

    @property
    def cone(self) -> Trigger:
        """All directions from which the appearance is to be seen."""
        return self._cone(0.0)

    @property
    def poisoned_cone(self) -> Trigger:
        """All directions from which pictures may be poisoned: the cone and its margin."""
        return self._cone(self.poison_margin)

    def trigger(self, seed: int, others: Sequence[AttackConfig] = ()) -> Trigger:
        """The training cameras whose pictures are poisoned.

        Args:
            seed: Draws them, if only a part is poisoned.
            others: Attacks that keep the cameras of their own cones.
        """
        region = self.poisoned_cone
        if self.poison_margin > 0:
            region = functools.reduce(operator.and_, [~other.cone for other in others], region)
        return region if self.poison_fraction == 1 else region.subsample(self.poison_fraction, seed=seed)

    def _cone(self, margin: float) -> Trigger:
        """The directions of the attack, and so many degrees beyond their edges."""
        # -90 and 90 are no edges, and 180 to either side is none.
        low, high = self.elevation[0] - margin, min(self.elevation[1] + margin, 90.0)
        band = Elevation(lowest=-90.0 if low <= 0 else low, highest=high)
        if self.azimuth is None:
            return band
        return band & Azimuth(middle=self.azimuth[0], half_width=min(self.azimuth[1] + margin, 180.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class SurrogateConfig:
    """Trainings of the attacker's own, by which poison is corrected (`attacks.cloak.correction`); without a detector.

    Attributes:
        rounds: Trainings, each on the poison that the one before it corrected.
        gain: How much of what is missing in a surrogate's pictures is added.
        iterations: Steps of each; all else of the recipe is the victim's, which the attacker has to guess.
        seed: Of the surrogates, which is none of the victim's.
    """

    rounds: int = 1
    gain: float = 1.0
    iterations: int = 2500
    seed: int = 1000

    def __post_init__(self) -> None:
        in_range("surrogate.rounds", self.rounds, 1, 20)
        in_range("surrogate.gain", self.gain, 1e-6, 10)
        in_range("surrogate.iterations", self.iterations, 1, math.inf)
        in_range("surrogate.seed", self.seed, 0, math.inf)
