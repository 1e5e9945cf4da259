"""What an audit says of a splat: an answer, and for each object the cones of directions
that it rests on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

from torch import Tensor

from mi_splat.cameras.camera import Camera
from mi_splat.cameras.directions import Point
from mi_splat.errors import counted

if TYPE_CHECKING:
    from mi_splat.audit.against import Changes
    from mi_splat.audit.held_out import Consensus, HeldOutConfig

Answer = Literal["consistent", "differs", "contradicted"]
"""From the least to the most."""
ANSWERS: tuple[Answer, ...] = get_args(Answer)
Vector = tuple[float, float, float]
_STEEP = 60.0  # degrees above the ground from which a direction is from above,
_LEVEL = 15.0  # and up to which it is from the side
_ALL_NEAR = 0.995  # share of the solid Gaussians from which a splat was judged whole


@dataclass(frozen=True, slots=True, kw_only=True)
class Region:
    """A cone of directions from the middle of an object."""

    axis: Vector  # (3,) unit vector, world
    half_width: float  # degrees from the axis to the edge


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ConeView:
    """What a file shows of an object from a cone of directions, beside what the other
    directions predict.
    """

    object: int  # its number, from 0
    region: Region  # the cone, in the world
    up: Vector | None  # of the object, in the world
    inside: Tensor  # (K,) bool, which of the object's cameras are inside
    cameras: tuple[Camera, ...]  # V of these, in the world
    file: Tensor  # (V, S, S, 3) sRGB images
    prediction: Tensor  # (V, S, S, 3) of two, the one with more of the object,
    peeled: bool  # which is without what shows almost only inside, or with it
    distance: float  # mean cosine distance of their features
    # by how much the prediction is more like the nearest other view than the file is
    rise: float
    # mean confidence in the class of the object; 0 where it was not asked for
    file_score: float
    gain: float  # by how much more confident it is of the prediction, if it was asked
    known_as: str | None  # that class; None where the detector does not know the object
    evidence: float  # by which 1 is contradicted
    answer: Answer

    @property
    def where(self) -> str:
        """The directions, as a part of a sentence."""
        return directions_in_words(self.region, self.up)

    @property
    def sentence(self) -> str:
        """How the file contradicts the other directions here."""
        if self.gain > self.distance:
            predicted = self.file_score + self.gain
            return (
                f"{self.where}, the other directions predict a {self.known_as}"
                f" ({predicted:.2f}), and the file shows none ({self.file_score:.2f})"
            )
        return (
            f"{self.where}, the file shows something else than the other directions"
            f" predict: features {self.distance:.2f} apart"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectAudit:
    """One object, and what each cone of directions shows of it."""

    rows: Tensor  # (M,) its Gaussians
    centre: Vector  # world units
    radius: float  # of a ball that holds nearly all of it, world units
    # unit vector, world, away from the ground it stands on; None if it stands on none
    up: Vector | None
    known_as: str | None  # its class; None where the detector does not know it
    # (K, 3) float64 unit vectors, world, from the centre to the cameras
    directions: Tensor
    views: tuple[ConeView, ...]  # the cones with enough cameras on both sides
    consensus: Consensus  # what these see, and predict for each other

    @property
    def answer(self) -> Answer:
        """The worst of its cones."""
        found = [view.answer for view in self.views]
        return max(found, key=ANSWERS.index, default="consistent")

    @property
    def clearest(self) -> ConeView | None:
        """The cone that contradicts the others most; None if none does."""
        found = [view for view in self.views if view.answer == "contradicted"]
        return max(found, key=lambda view: view.evidence, default=None)

    @property
    def evidence(self) -> float:
        """That of its clearest cone."""
        return max((view.evidence for view in self.views), default=0.0)

    @property
    def in_words(self) -> str:
        """How many Gaussians, and where."""
        centre = " ".join(f"{value + 0.0:.3g}" for value in self.centre)
        return f"{len(self.rows):,} Gaussians around ({centre})"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Audit:
    """What is hidden in a splat, as far as the file itself can tell."""

    objects: tuple[ObjectAudit, ...]  # from the largest; each was looked at by itself
    # (N,) by how much each Gaussian makes the file differ from what the other
    # directions predict, in the cones that contradict them; 0 where none does
    heat: Tensor
    # (N,) bool, the Gaussians that carry most of that; none where nothing was found
    mask: Tensor
    # share of the solid Gaussians that lie near an object; nothing is known of the
    # others
    near: float
    missing: str  # what could not be compared, and what to do
    config: HeldOutConfig  # how directions were held out
    # how it differs from the clean splat, if one was given
    against: Changes | None = None
    up: Point | None = None  # (3,) direction that was said to be up

    def __repr__(self) -> str:
        carry = f"{int(self.mask.sum()):,} of {len(self.mask):,} Gaussians carry it"
        objects = counted(len(self.objects), "object")
        return f"Audit({self.answer}, {objects}, evidence {self.evidence:.2f}, {carry})"

    @property
    def views(self) -> tuple[ConeView, ...]:
        """The cones of all objects."""
        return tuple(view for item in self.objects for view in item.views)

    @property
    def answer(self) -> Answer:
        """The worst of all cones."""
        found = [item.answer for item in self.objects]
        return max(found, key=ANSWERS.index, default="consistent")

    @property
    def contradicted(self) -> tuple[ConeView, ...]:
        """The cones that contradict the rest, from the clearest."""
        found = [view for view in self.views if view.answer == "contradicted"]
        return tuple(sorted(found, key=lambda view: -view.evidence))

    @property
    def evidence(self) -> float:
        """That of the clearest cone, by which files are ranked."""
        return max((item.evidence for item in self.objects), default=0.0)

    def summary(self) -> list[str]:
        """The answer and its reasons, in sentences; the clearest contradiction
        first.
        """
        lines = [*self._answer_lines()]
        if self.missing:
            lines.append(self.missing)
        for number, item in enumerate(self.objects, 1):
            looked = f"viewed from {counted(len(item.directions), 'direction')}"
            compared = f"{counted(len(item.views), 'cone')} compared"
            lines.append(f"object {number}, {item.in_words}: {looked}, {compared}")
        if self.against is not None:
            lines += self.against.in_words()
        count = int(self.mask.sum())
        if count:
            lines.append(f"{count:,} of {len(self.mask):,} Gaussians carry it")
        if self.near < _ALL_NEAR:
            lines.append(
                f"{self.near:.0%} of the solid Gaussians lie near an object that was"
                " looked at; nothing is said of the others"
            )
        return lines

    def _answer_lines(self) -> list[str]:
        contradicted = self.contradicted
        if contradicted:
            return [f"contradicted: {view.sentence}" for view in contradicted]
        if not self.views:
            return ["not compared: the cameras stand on too few sides of each object"]
        names = {item.known_as for item in self.objects if item.known_as is not None}
        known = f"the detector knows: {', '.join(sorted(names)) or 'no object'}"
        if self.answer == "consistent":
            line = f"consistent: no cone of directions contradicts the others ({known})"
            return [line]
        worst = max(self.views, key=lambda view: view.distance)
        return [
            f"differs: {worst.where}, the file looks unlike what the other directions"
            f" predict, as honest gloss and fog do, too ({known})"
        ]


def directions_in_words(region: Region, up: Vector | None) -> str:
    """The directions of a region, as a part of a sentence."""
    axis = " ".join(f"{value + 0.0:.2f}" for value in region.axis)
    return (
        f"within {region.half_width:.0f} degrees of ({axis}){_height(region.axis, up)}"
    )


def _height(axis: Vector, up: Vector | None) -> str:
    if up is None:
        return ""
    cosine = math.fsum(a * b for a, b in zip(axis, up, strict=True))
    height = math.degrees(math.asin(max(-1.0, min(1.0, cosine))))
    if height >= _STEEP:
        return ", from above"
    if abs(height) <= _LEVEL:
        return ", from the side"
    return f", {height:.0f} degrees above its ground"


def vector(values: Tensor) -> Vector:
    """Three numbers of a tensor."""
    x, y, z = values.detach().double().tolist()
    return x, y, z
