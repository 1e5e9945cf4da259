"""Does one set of directions, the same for all of a surface, explain how its colours change?

The score of a set of directions on a cell of surface is the change of its mean colour, from inside to outside, times
the share of the variance that this explains; changes that point everywhere cancel out. Of an object it is the geometric
mean of two numbers: the mean over all of its surface, and that over its six highest cells.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from mi_splat.audit import gloss
from mi_splat.audit.agreement import Profiles, face_of
from mi_splat.audit.results import excess
from mi_splat.audit.surfaces import Elements, Sight, lattice

NOISE = 0.03
"""sRGB by which clean surface may differ from camera to camera."""
HALF_WIDTHS = (20.0, 27.0, 35.0, 43.0, 51.0, 60.0, 70.0)
"""Degrees from the axis of a cone to its edge."""
AXES = 110
"""Axes of cones all around."""
INSIDE, OUTSIDE = gloss.INSIDE, gloss.OUTSIDE
LEAST_SEEN = 3
"""Cameras on each side of the edge that have to see a piece of surface."""
MOST_PIECES = 2500
"""Pieces of surface on which sets of directions are compared, evenly taken of all."""
_VOTES = 3
"""Rounds of votes on which cameras see a look, at most."""
_CHUNK = 256
_CELL, _CELL_ELEMENTS, _CELLS = 6, 6, 6
"""Side of a cell in voxels, pieces that it has at least, and cells that count."""

Sides = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""From (E,) rows and (E, K, 5) their moments to (E, T, 5) sums inside and outside of T sets of cameras."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bank:
    """Sets of directions to try.

    Attributes:
        axes: (T, 3) float64 unit vectors.
        half_widths: (T,) float64 degrees.
    """

    axes: Tensor
    half_widths: Tensor

    def sides(self, directions: Tensor) -> tuple[Tensor, Tensor]:
        """(T, K) float32, which directions are inside of each set, and which outside; those at its edge are neither."""
        angles = angles_between(self.axes, directions)
        inside = angles < self.half_widths[:, None] - INSIDE
        return inside.float(), (angles > self.half_widths[:, None] + OUTSIDE).float()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scores:
    """How well each explanation fits an object.

    Attributes:
        direction: Score of the best set of directions.
        incidence: Score of the best angle between surface and view.
        mirror: Score of the best set of mirrored directions.
        shift: Of the set of directions that has most of it; see `mi_splat.audit.agreement`.
        fade: The same, less the most that a set of angles of incidence has.
        axis: (3,) of the best set of directions.
        half_width: Its, in degrees.
    """

    direction: float
    incidence: float
    mirror: float
    shift: float
    fade: float
    axis: Tensor
    half_width: float

    @property
    def excess(self) -> float:
        """What gloss does not explain."""
        return excess(self.direction, self.incidence, self.mirror, self.shift, self.fade)


def angles_between(first: Tensor, second: Tensor) -> Tensor:
    """(A, B) float64 degrees between (A, 3) and (B, 3) unit vectors."""
    return (first.double() @ second.double().T).clamp(-1, 1).acos().rad2deg()


def bank() -> Bank:
    """Cones of all half widths about axes all around."""
    axes = lattice(AXES, -90.0, 90.0)
    widths = torch.tensor(HALF_WIDTHS, dtype=torch.float64)
    return Bank(axes=axes.repeat_interleave(len(widths), 0), half_widths=widths.repeat(AXES))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Split:
    """Pieces of surface parted by sets of cameras.

    Attributes:
        change: (..., 3) mean colour inside less that outside.
        weight: (...) how much each change is known, 0 where too few cameras see one side.
        whole: (...) variance of the colours times their number.
        valid: (...) bool, whether enough cameras see both sides.
    """

    change: Tensor
    weight: Tensor
    whole: Tensor
    valid: Tensor

    @classmethod
    def of(cls, inside: Tensor, outside: Tensor) -> Split:
        """Part pieces, given the (..., 5) sums of their moments over the cameras inside and outside."""
        count_in, count_out = inside[..., 0], outside[..., 0]
        count = (count_in + count_out).clamp(min=1)
        mean_in = inside[..., 1:4] / count_in.clamp(min=1)[..., None]
        mean_out = outside[..., 1:4] / count_out.clamp(min=1)[..., None]
        valid = (count_in >= LEAST_SEEN) & (count_out >= LEAST_SEEN)
        squares = (inside[..., 1:4] + outside[..., 1:4]).square().sum(-1)
        whole = inside[..., 4] + outside[..., 4] - squares / count + count * 3 * NOISE**2
        weight = count_in * count_out / count * valid
        return cls(change=mean_in - mean_out, weight=weight, whole=whole, valid=valid)

    def scores(self) -> Tensor:
        """(...) score of each piece by itself, 0 where it is not valid."""
        squares = self.change.square().sum(-1)
        return (squares / 3).sqrt() * self.weight * squares / self.whole.clamp(min=1e-9)


def cells_of(pieces: Elements) -> Tensor:
    """(E,) int64 cell of each piece, by its position and the axis that it faces along."""
    voxel = (pieces.positions / (_CELL * pieces.size)).floor().long()
    voxel = voxel - voxel.amin(0)
    sizes = voxel.amax(0) + 1
    number = ((voxel[:, 0] * sizes[1] + voxel[:, 1]) * sizes[2] + voxel[:, 2]) * 6 + face_of(pieces.normals)
    cell: Tensor = torch.unique(number, return_inverse=True)[1]
    return cell


def set_scores(moments: Tensor, cell: Tensor, sides: Sides) -> Tensor:
    """(T,) score of each set of cameras on an object."""
    sums, able = torch.zeros(0), 0
    for rows in torch.split(torch.arange(len(moments)), _CHUNK):
        split = Split.of(*sides(rows, moments[rows]))
        valid = split.valid.float()[..., None]
        terms = [split.weight[..., None] * split.change, split.weight[..., None], split.whole[..., None] * valid, valid]
        if not len(sums):
            sums = torch.zeros(int(cell.max()) + 1, split.valid.shape[1], 6)
        sums.index_add_(0, cell[rows], torch.cat(terms, -1))
        able += int(split.valid.any(1).sum())
    weight, count = sums[..., 3].clamp(min=1e-9), sums[..., 5]
    squares = (sums[..., :3] / weight[..., None]).square().sum(-1)
    score = (squares / 3).sqrt() * squares * weight / sums[..., 4].clamp(min=1e-9)
    score = torch.where(count >= _CELL_ELEMENTS, score, 0.0)
    highest = score.topk(min(_CELLS, len(score)), dim=0).values.sum(0) / _CELLS
    return ((score * count).sum(0) / max(able, 1) * highest).sqrt()


def explain(pieces: Elements, view: Sight) -> Scores:
    """Score how well sets of directions explain the colours of an object, and how well gloss would."""
    judged = pieces.judged.nonzero()[:, 0]
    judged = judged[torch.linspace(0, len(judged) - 1, min(len(judged), MOST_PIECES)).round().long()]
    cell = torch.unique(cells_of(pieces)[judged], return_inverse=True)[1]
    moments = pieces.moments[judged]
    rays = gloss.rays_of(view, pieces.positions[judged], pieces.normals[judged])
    sets = bank()
    cones = sets.sides(view.directions)

    def by_direction(rows: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
        flat = part.transpose(0, 1).reshape(part.shape[1], -1)
        inside, outside = ((side @ flat).reshape(len(side), len(rows), 5).transpose(0, 1) for side in cones)
        return inside, outside

    def by_incidence(cosines: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
        inside, outside = gloss.incidence(cosines)
        return torch.bmm(inside, part), torch.bmm(outside, part)

    def by_gloss(rows: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
        inside, outside = gloss.sides(rays.cosines[rows], rays.mirrored[rows])
        return torch.bmm(inside, part), torch.bmm(outside, part)

    direct, rivals = set_scores(moments, cell, by_direction), set_scores(moments, cell, by_gloss)
    profiles = Profiles.of(moments, pieces.normals[judged], cell)
    at_cells = profiles.of_cells()
    parted = [torch.einsum("ckx,tk->ctx", at_cells, side) for side in cones]
    by_angle = profiles.parted(lambda rows, part: by_incidence(rays.cosines[rows], part), _CHUNK)
    fade = float(profiles.fades(*parted).max() - profiles.fades(*by_angle).max())
    incidence, mirror = float(rivals[: gloss.ANGLES].max()), float(rivals[gloss.ANGLES :].max())
    best = int(direct.argmax())
    return Scores(
        direction=float(direct[best]),
        incidence=incidence,
        mirror=mirror,
        shift=float(profiles.shifts(*parted).max()),
        fade=max(0.0, fade),
        axis=sets.axes[best],
        half_width=float(sets.half_widths[best]),
    )


def sums_by_side(moments: Tensor, shown: Tensor) -> tuple[Tensor, Tensor]:
    """(E, 5) sums of (E, K, 5) moments over the cameras that see a look, and over those that do not."""
    inside = shown.float()
    return torch.einsum("ekc,k->ec", moments, inside), torch.einsum("ekc,k->ec", moments, 1 - inside)


def piece_scores(pieces: Elements, shown: Tensor) -> Tensor:
    """(E,) score of each piece, 0 where it is not judged."""
    return Split.of(*sums_by_side(pieces.moments, shown)).scores() * pieces.judged


def look_amounts(pieces: Elements, shown: Tensor) -> Tensor:
    """(K,) how much of a look each camera sees, by the mean of the pieces' scores, from 0 (none) to 1."""
    inside, outside = sums_by_side(pieces.moments, shown)
    base = outside[:, 1:4] / outside[:, :1].clamp(min=1)
    change = inside[:, 1:4] / inside[:, :1].clamp(min=1) - base
    projection = torch.einsum("ekc,ec->ek", pieces.moments[..., 1:4] - base[:, None], change)
    weight = (piece_scores(pieces, shown) / change.square().sum(1).clamp(min=1e-6))[:, None] * pieces.moments[..., 0]
    return (projection * weight).sum(0) / (change.square().sum(1)[:, None] * weight).sum(0).clamp(min=1e-12)


def reachable(pieces: Elements, view: Sight) -> Tensor:
    """(E,) bool, whether some cone has enough of the cameras that see a piece inside and outside."""
    inside, outside = bank().sides(view.directions)
    seen = pieces.moments[..., 0]
    able = torch.zeros(len(seen), dtype=torch.bool)
    for rows in torch.split(torch.arange(len(seen)), _CHUNK):
        counts = [seen[rows] @ side.T >= LEAST_SEEN for side in (inside, outside)]
        able[rows] = (counts[0] & counts[1]).any(1)
    return able


def cameras_of_look(pieces: Elements, view: Sight, scores: Scores) -> Tensor:
    """(K,) bool, which cameras see the look: a set of any form, begun with the best cone.

    Each piece votes for the side whose mean colour is nearer to what the camera sees, by its score.
    """
    shown = angles_between(scores.axis[None], view.directions)[0] < scores.half_width + (OUTSIDE - INSIDE) / 2
    for _ in range(_VOTES):
        inside, outside = sums_by_side(pieces.moments, shown)
        mean_in = inside[:, 1:4] / inside[:, :1].clamp(min=1)
        mean_out = outside[:, 1:4] / outside[:, :1].clamp(min=1)
        change = mean_in - mean_out
        weight = Split.of(inside, outside).scores() * pieces.judged / change.square().sum(1).clamp(min=1e-6)
        seen = pieces.moments[..., 0]
        colours = pieces.moments[..., 1:4]
        votes = ((colours - ((mean_in + mean_out) / 2)[:, None]) * change[:, None]).sum(-1) * seen
        voted = torch.einsum("ek,e->k", votes, weight) > 0
        if not LEAST_SEEN <= int(voted.sum()) <= len(voted) - LEAST_SEEN:
            break
        shown = voted
    return shown
