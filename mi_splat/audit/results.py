"""What an audit says of a splat: a verdict, and for each object the evidence that it
rests on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from mi_splat.audit.thresholds import LIMITS
from mi_splat.cameras.camera import Camera
from mi_splat.cameras.directions import Point
from mi_splat.errors import counted

if TYPE_CHECKING:
    from mi_splat.audit.against import Changes


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
    if height >= LIMITS.steep:
        return ", from above"
    if abs(height) <= LIMITS.level:
        return ", from the side"
    return f", {height:.0f} degrees above its ground"


def headline(audit: Audit) -> str:
    """What changes most with the direction of view, in one sentence."""
    item = audit.strongest
    quiet = item.look.evidence < LIMITS.suspicion
    if audit.verdict == "nothing found":
        seen = f"in the {audit.near:.0%} of its solid Gaussians that were examined, "
        part = "" if audit.near >= LIMITS.all_near else seen
        return (
            f"{part}no set of directions explains how colours change better than honest"
            " gloss does"
        )
    if quiet and item.edit is not None and item.edited:
        return (
            "the colours of an object have shades that neither paint nor light"
            f" explains{_attacked_camera(item.edit)}"
        )
    if quiet and item.roofed:
        return (
            "something far above covers an object, and only cameras below it see the"
            " object"
        )
    if item.fogged:
        share = float(item.look.shown.double().mean())
        return (
            f"from {share:.0%} of directions an object shows fog: no training camera"
            " stood there, or something covers it; pass --cameras"
        )
    if quiet and item.occluder is not None:
        axis = " ".join(f"{value + 0.0:.2f}" for value in item.occluder.axis)
        return (
            "something in the air covers an object from around"
            f" ({axis}), and others see through it"
        )
    where = directions_in_words(item.look.region, item.up)
    if len(audit.objects) == 1:
        which = "an object"
    else:
        which = f"object {audit.objects.index(item) + 1}, {_where(item)},"
    doubt = "; honest splats can look so, too: see the two pictures, or pass --cameras"
    unsure = doubt if item.in_room or item.plain else ""
    return f"{which} has other colours {where}{unsure}"


def _attacked_camera(edit: Edit) -> str:
    if not edit.camera_known:
        return ""
    return (
        ", aimed at a camera towards"
        f" ({' '.join(f'{value + 0.0:.2f}' for value in edit.direction)})"
    )


def summary(audit: Audit) -> list[str]:
    """The reasons after the headline, sentence by sentence."""
    lines = []
    for number, item in enumerate(audit.objects, 1):
        lines.append(f"object {number}, {_where(item)}: {'; '.join(_of_object(item))}")
    if audit.against is not None:
        lines += audit.against.in_words()
    count = int(audit.mask.sum())
    if count:
        lines.append(f"{count:,} of {len(audit.mask):,} Gaussians carry it")
    lines.append(
        f"{audit.near:.0%} of the solid Gaussians lie near an object that was looked"
        " at; nothing is said of the others"
    )
    return lines


def _where(item: ObjectAudit) -> str:
    centre = " ".join(f"{value + 0.0:.3g}" for value in item.centre)
    return f"{len(item.rows):,} Gaussians around ({centre})"


def _of_object(item: ObjectAudit) -> list[str]:
    lines: list[str] = []
    for number, look in enumerate(item.looks, 1):
        if look.incidence > look.mirror:
            rival = "the angle of incidence"
        else:
            rival = "a mirrored direction"
        gloss = max(look.incidence, look.mirror)
        lines.append(
            (f"look {number}: " if len(item.looks) > 1 else "")
            + f"directions explain a drift of colours of {look.direction:.4f}, {rival}"
            f" {gloss:.4f}; net of gloss {look.net:.5f}, supported {look.support:.0%}"
        )
        if look.evidence >= LIMITS.suspicion:
            cameras = f"{int(look.shown.sum())} of {len(look.shown)} cameras"
            lines.append(
                f"{look.changed:.0%} of its surface changes; seen by {cameras}"
            )
        if number > 1:
            lines.append(f"it shows {directions_in_words(look.region, item.up)}")
    if item.occluder is not None and item.covered:
        lines.append(
            f"{item.occluder.transparent:.0%} of the looks from other directions pass"
            " what covers it"
        )
    if item.edit is not None and item.edited:
        camera = _attacked_camera(item.edit)
        lines.append(
            f"its colours look like an attack on a detector{camera}:"
            f" {item.edit.score:.1f} times the bound"
        )
    open_share = item.uncontradicted / max(item.uncontradicted + item.area, 1e-12)
    lines.append(
        f"{open_share:.0%} of what shows is seen from one side or by few cameras:"
        " nothing contradicts it"
    )
    return lines


Verdict = Literal["nothing found", "suspicious", "hidden look"]
"""What a splat is called, from the least to the most evidence."""

Vector = tuple[float, float, float]
_LESS = 0.99


@dataclass(frozen=True, slots=True, kw_only=True)
class Region:
    """A cone of directions from the middle of an object."""

    axis: Vector  # (3,) unit vector, world
    half_width: float  # degrees from the axis to the edge


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pair:
    """Two cameras that prove a look: they see the same surface from inside and from
    outside of its directions.
    """

    inside: Camera  # sees the look
    outside: Camera  # sees the same surface without it
    # mean change of colour (sRGB) of the surface that both see, weighted by its score
    change: float
    numbers: tuple[int, int]  # which of the object's cameras they are


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scores:
    """How well a set of directions explains the colours of an object, and how well
    gloss would.
    """

    # drift of colours (sRGB) that one profile over directions explains, for all of the
    # surface
    direction: float
    incidence: float  # the same, if colours follow the angle between surface and view
    # the same, if colours follow the direction in which a mirror would reflect
    mirror: float
    # what directions explain beyond the better of these, times its share of
    # `direction`; about 0 if honest
    net: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Look(Scores):
    """An appearance that an object shows from some directions only, and how much of it
    gloss would explain.
    """

    region: Region  # the directions, in the simplest form that fits
    shown: Tensor  # (K,) bool, the cameras that see the look
    # (K,) how much of it each camera sees: about 0 none of it, about 1 all; 0 where no
    # surface tells
    amounts: Tensor
    threshold: float  # drift beyond gloss from which it is called hidden
    # share of the surface that the larger side sees well which the smaller side faces
    # and does not see
    lost: float
    # share of the rays of the smaller side that end in one place, by that of the larger
    # side
    air: float
    changed: float  # share of the judged surface whose colour switches with it
    # whether training cameras stood where it was seen from, so that some surface has to
    # change
    given: bool
    pair: Pair | None  # two cameras that prove it; None if no two see the same surface

    @property
    def support(self) -> float:
        """From 1, both sides see the same surface, to 0, one side is fog: no training
        camera may have stood there.
        """
        ramps = (
            (self.lost, LIMITS.lost),
            (min(self.air, 1 / max(self.air, 1e-6)), LIMITS.as_clear),
        )
        return min(
            min(max((none - value) / (none - full), 0.0), 1.0)
            for value, (full, none) in ramps
        )

    @property
    def evidence(self) -> float:
        """By which 1 is called hidden; below 0 where gloss explains more than
        directions do.
        """
        share = min(1.0, self.changed / LIMITS.changed_share) if self.given else 1.0
        return (
            (self.support * share if self.net > 0 else 1.0) * self.net / self.threshold
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Occluder:
    """Something in the air that covers an object from some directions, and that others
    look straight through.
    """

    # (3,) unit vector, world: the middle of the directions that are covered
    axis: Vector
    # (K,) share of the rays to the object that end at something before it, by camera
    blocked: Tensor
    # share of that something that cameras which are not blocked look through
    transparent: float
    score: float  # share of the cameras that are blocked, times `transparent`


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edit:
    """Signs that colours were edited after training, which photographs do not leave;
    see `edit_of`.
    """

    # of how colours change with the direction, what neither the own colour nor grey
    # explains, in [0, 1]
    share: float
    # the same of what is around the object; 0 where there is too little
    usual_share: float
    # of how a colour differs from those around it, what neither these nor grey explain,
    # in [0, 1]
    grain: float
    usual_grain: float  # the same of what is around the object
    # how often more of `share` there is towards one camera than in the mean over all
    # directions
    peak: float
    direction: Vector  # (3,) unit vector, world, from the object to that camera
    rows: Tensor  # (M,) the object's Gaussians that have most of it

    @property
    def aimed(self) -> float:
        """Score of an attack on few views: what of the share is more than usual, times
        its peak.
        """
        return max(0.0, self.share - self.usual_share) * self.peak

    @property
    def score(self) -> float:
        """Score of an edit, the larger of an attack on few views and on many, at least
        0; 1 is an edit.
        """
        return max(
            self.aimed / LIMITS.aimed,
            (self.grain - self.usual_grain) / LIMITS.grain,
            0.0,
        )

    @property
    def camera_known(self) -> bool:
        """Whether colours peak enough to say where an attacked camera stood."""
        return self.aimed >= LIMITS.aimed and self.peak >= LIMITS.peaked


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectAudit:
    """One object: its surface, what changes on it with the direction of view, and its
    verdict.
    """

    rows: Tensor  # (M,) its Gaussians
    centre: Vector  # world units
    radius: float  # of a ball that holds nearly all of it, world units
    # unit vector, world, away from the ground it stands on; None if it stands on none
    up: Vector | None
    # (K, 3) float64 unit vectors, world, from the centre to the cameras
    directions: Tensor
    pieces: int  # pieces of surface that were judged
    area: float  # world units squared of the surface that was judged
    # world units squared of surface that too few cameras see, or cameras of one side
    # only
    uncontradicted: float
    cameras: tuple[Camera, ...]  # the K cameras, in the world
    # what is found first and when that is taken off, from the strongest; at least one
    looks: tuple[Look, ...]
    occluder: Occluder | None  # what covers the object; None if nothing does
    # what looks like an edit of the finished file; None where it has too few Gaussians
    edit: Edit | None = None
    # whether it stands in a room or is around another: honest ones have as much
    # evidence there
    in_room: bool = False
    # whether no Gaussian changes its colour with the direction: only which of them
    # shows changes
    plain: bool = False
    roofed: bool = False  # whether something beyond the cameras covers it from above

    @property
    def edited(self) -> bool:
        """Whether its colours look like an attack on a detector."""
        return self.edit is not None and self.edit.score >= 1

    @property
    def look(self) -> Look:
        """The set of directions that explains most."""
        return self.looks[0]

    @property
    def evidence(self) -> float:
        """By which 1 is called hidden, and less suspicious from `LIMITS.suspicion` on,
        as any sign alone makes it.
        """
        evidence = min(self.look.evidence, _LESS) if self.fogged else self.look.evidence
        if self.covered or self.edited or self.fogged or self.roofed:
            evidence = max(evidence, LIMITS.suspicion)
        if self.in_room or self.plain:
            return min(evidence, _LESS)
        return evidence

    @property
    def fogged(self) -> bool:
        """Whether one side of what changes most sees fog: no camera stood there, or
        something was put before it.
        """
        return self.look.support < LIMITS.supported and not self.in_room

    @property
    def covered(self) -> bool:
        """Whether something covers the object that others see through, as honest leaves
        and fog do, too.
        """
        return self.occluder is not None and self.occluder.score >= LIMITS.covered

    @property
    def verdict(self) -> Verdict:
        """Verdict on this object alone."""
        if self.evidence >= 1:
            return "hidden look"
        if self.evidence >= LIMITS.suspicion:
            return "suspicious"
        return "nothing found"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Audit:
    """What is hidden in a splat, as far as the file itself can tell."""

    objects: tuple[ObjectAudit, ...]  # from the largest; each was looked at by itself
    # (N,) score of the surface that each Gaussian makes up, 0 of those that no image
    # showed
    heat: Tensor
    # (N,) bool, the Gaussians that carry most of what was found; none where nothing was
    mask: Tensor
    # share of the solid Gaussians that lie near an object; nothing is known of the
    # others
    near: float
    # how it differs from the clean splat, if one was given
    against: Changes | None = None
    up: Point | None = None  # (3,) direction that was said to be up

    def __repr__(self) -> str:
        carry = f"{int(self.mask.sum()):,} of {len(self.mask):,} Gaussians carry it"
        evidence = f"evidence {self.strongest.evidence:.2f}"
        return (
            f"Audit({self.verdict}, {counted(len(self.objects), 'object')}, {evidence},"
            f" {carry})"
        )

    @property
    def strongest(self) -> ObjectAudit:
        """The object with the most evidence."""
        return max(self.objects, key=lambda item: item.evidence)

    @property
    def verdict(self) -> Verdict:
        """Verdict on the object with the most evidence."""
        return self.strongest.verdict


def vector(values: Tensor) -> Vector:
    """Three numbers of a tensor."""
    x, y, z = values.detach().to(torch.float64).tolist()
    return x, y, z
