"""Does one set of directions, the same for all of a surface, explain how its colours change; or does honest gloss?

The score of a set of directions on a piece of surface is the change of its mean colour, from inside to outside, times
the share of the variance that this explains. Of an object it is the geometric mean of two numbers: the mean over all of
its surface, and that over its six highest cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.surfaces import Elements, Sight, lattice

NOISE = 0.03
"""sRGB by which clean surface may differ from camera to camera."""
HALF_WIDTHS = (20.0, 27.0, 35.0, 43.0, 51.0, 60.0, 70.0)
"""Degrees from the axis of a cone to its edge."""
AXES = 110
"""Axes of cones all around."""
INSIDE, OUTSIDE = 3.0, 8.0
"""Degrees at the edge of a cone that count as neither: a look may change there as it likes."""
LEAST_SEEN = 3
"""Cameras on each side of the edge that have to see a piece of surface."""
MOST_PIECES = 5000
"""Pieces of surface on which sets of directions are compared, evenly taken of all."""
_CHUNK = 256
_CELL, _CELL_ELEMENTS, _CELLS = 0.25, 12, 6
"""Side of a cell in radii, pieces that it has at least, and cells that count."""
_COSINES = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
_MIRROR_AXES, _MIRROR_WIDTHS = 52, (30.0, 45.0, 60.0, 75.0, 90.0)


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
class Tally:
    """Scores of sets of directions, summed over surface.

    Attributes:
        total: (T,) sum of the scores of all pieces.
        cells: (C, T) the same by cell.
        valid: (C, T) pieces of each cell that both sides see.
    """

    total: Tensor
    cells: Tensor
    valid: Tensor

    @classmethod
    def empty(cls, cells: int, sets: int) -> Tally:
        """Nothing yet."""
        return cls(total=torch.zeros(sets), cells=torch.zeros(cells, sets), valid=torch.zeros(cells, sets))

    def add(self, score: Tensor, valid: Tensor, cell: Tensor) -> None:
        """Add (E, T) scores of pieces in (E,) cells."""
        self.total.add_(score.sum(0))
        self.cells.index_add_(0, cell, score)
        self.valid.index_add_(0, cell, valid.float())

    def scores(self, pieces: int) -> Tensor:
        """(T,) score of each set on the object, of which so many pieces can be judged."""
        means = torch.where(self.valid >= _CELL_ELEMENTS, self.cells / self.valid.clamp(min=1), 0.0)
        highest = means.topk(min(_CELLS, len(means)), dim=0).values.sum(0) / _CELLS
        return (self.total / max(pieces, 1) * highest).clamp(min=0).sqrt()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scores:
    """How well each explanation fits an object.

    Attributes:
        direction: Score of the best set of directions.
        incidence: Score of the best angle between surface and view.
        mirror: Score of the best set of mirrored directions.
        axis: (3,) of the best set of directions.
        half_width: Its, in degrees.
    """

    direction: float
    incidence: float
    mirror: float
    axis: Tensor
    half_width: float


def angles_between(first: Tensor, second: Tensor) -> Tensor:
    """(A, B) float64 degrees between (A, 3) and (B, 3) unit vectors."""
    return (first.double() @ second.double().T).clamp(-1, 1).acos().rad2deg()


def bank() -> Bank:
    """Cones of all half widths about axes all around."""
    axes = lattice(AXES, -90.0, 90.0)
    widths = torch.tensor(HALF_WIDTHS, dtype=torch.float64)
    return Bank(axes=axes.repeat_interleave(len(widths), 0), half_widths=widths.repeat(AXES))


def split_scores(inside: Tensor, outside: Tensor) -> tuple[Tensor, Tensor]:
    """Scores of sets of directions on pieces of surface.

    Args:
        inside: (..., 5) sums of the moments over the cameras inside.
        outside: (..., 5) the same outside.

    Returns:
        (...) score, 0 where too few cameras see one side; and (...) bool, whether enough do.
    """
    count_in, count_out = inside[..., 0], outside[..., 0]
    mean_in = inside[..., 1:4] / count_in.clamp(min=1)[..., None]
    mean_out = outside[..., 1:4] / count_out.clamp(min=1)[..., None]
    count = (count_in + count_out).clamp(min=1)
    change = (mean_in - mean_out).square().sum(-1)
    between = count_in * count_out / count * change
    whole = inside[..., 4] + outside[..., 4] - (inside[..., 1:4] + outside[..., 1:4]).square().sum(-1) / count
    share = between / (whole + count * 3 * NOISE**2).clamp(min=1e-9)
    valid = (count_in >= LEAST_SEEN) & (count_out >= LEAST_SEEN)
    return (change / 3).sqrt() * share * valid, valid


def cells_of(pieces: Elements, radius: float) -> Tensor:
    """(E,) int64 cell of each piece, by its position."""
    place = (pieces.positions / (_CELL * radius)).floor().long()
    place = place - place.amin(0)
    sizes = place.amax(0) + 1
    number = (place[:, 0] * sizes[1] + place[:, 1]) * sizes[2] + place[:, 2]
    cell: Tensor = torch.unique(number, return_inverse=True)[1]
    return cell


def explain(pieces: Elements, view: Sight, radius: float) -> Scores:
    """Try sets of directions, and what gloss would do.

    Args:
        pieces: The surface.
        view: From where it was seen.
        radius: Of the object.
    """
    sets, mirrors = bank(), lattice(_MIRROR_AXES, -90.0, 90.0).float()
    cell = cells_of(pieces, radius)
    cells = int(cell.max()) + 1 if len(cell) else 0
    inside, outside = sets.sides(view.directions)
    direct = Tally.empty(cells, len(inside))
    rivals = Tally.empty(cells, len(_COSINES) + len(mirrors) * len(_MIRROR_WIDTHS))
    positions = torch.stack([camera.position for camera in view.cameras]).float()
    able = 0
    judged = pieces.judged.nonzero()[:, 0]
    judged = judged[torch.linspace(0, len(judged) - 1, min(len(judged), MOST_PIECES)).round().long()]
    for rows in torch.split(judged, _CHUNK):
        moments = pieces.moments[rows]
        flat = moments.transpose(0, 1).reshape(len(positions), -1)
        sums = [(side @ flat).reshape(len(side), len(rows), 5).transpose(0, 1) for side in (inside, outside)]
        score, valid = split_scores(*sums)
        direct.add(score, valid, cell[rows])
        able += int(valid.any(1).sum())
        views = functional.normalize(positions - pieces.positions[rows, None], dim=-1)
        sides = _gloss(views, pieces.normals[rows], mirrors)
        rivals.add(*split_scores(*(torch.bmm(side, moments) for side in sides)), cell[rows])
    by_direction, by_rival = direct.scores(able), rivals.scores(able)
    best = int(by_direction.argmax())
    return Scores(
        direction=float(by_direction[best]),
        incidence=float(by_rival[: len(_COSINES)].max()),
        mirror=float(by_rival[len(_COSINES) :].max()),
        axis=sets.axes[best],
        half_width=float(sets.half_widths[best]),
    )


def _gloss(views: Tensor, normals: Tensor, mirrors: Tensor) -> tuple[Tensor, Tensor]:
    """(E, R, K) float32 cameras inside and outside of each set of angles of incidence, and of mirrored directions.

    Args:
        views: (E, K, 3) unit vectors to the cameras.
        normals: (E, 3) of the pieces.
        mirrors: (M, 3) axes of cones of mirrored directions.
    """
    cosines = (views * normals[:, None]).sum(-1)
    limits = torch.tensor(_COSINES)[:, None]
    reflected = 2 * cosines[..., None] * normals[:, None] - views
    turned = (reflected @ mirrors.T).transpose(1, 2)
    insides, outsides = [cosines[:, None] > limits + 0.03], [cosines[:, None] < limits - 0.06]
    for width in _MIRROR_WIDTHS:
        insides.append(turned > math.cos(math.radians(width - INSIDE)))
        outsides.append(turned < math.cos(math.radians(width + OUTSIDE)))
    return torch.cat(insides, 1).float(), torch.cat(outsides, 1).float()


def sums_by_side(moments: Tensor, shown: Tensor) -> tuple[Tensor, Tensor]:
    """(E, 5) sums of (E, K, 5) moments over the cameras that see a look, and over those that do not."""
    inside = shown.float()
    return torch.einsum("ekc,k->ec", moments, inside), torch.einsum("ekc,k->ec", moments, 1 - inside)


def piece_scores(pieces: Elements, shown: Tensor) -> Tensor:
    """(E,) score of each piece, 0 where it is not judged.

    Args:
        pieces: The surface.
        shown: (K,) bool, the cameras that see the look.
    """
    return split_scores(*sums_by_side(pieces.moments, shown))[0] * pieces.judged


def reachable(pieces: Elements, view: Sight) -> Tensor:
    """(E,) bool, whether some cone has enough of the cameras that see a piece inside and outside."""
    inside, outside = bank().sides(view.directions)
    seen = pieces.moments[..., 0]
    able = torch.zeros(len(seen), dtype=torch.bool)
    for rows in torch.split(torch.arange(len(seen)), _CHUNK):
        counts = [seen[rows] @ side.T >= LEAST_SEEN for side in (inside, outside)]
        able[rows] = (counts[0] & counts[1]).any(1)
    return able


def cameras_of_look(pieces: Elements, view: Sight, scores: Scores, *, rounds: int = 3) -> Tensor:
    """(K,) bool, which cameras see the look: a set of any form, begun with the best cone.

    Each piece votes for the side whose mean colour is nearer to what the camera sees, by its score.

    Args:
        pieces: The surface.
        view: Its cameras.
        scores: With the cone.
        rounds: Votes at most.
    """
    shown = angles_between(scores.axis[None], view.directions)[0] < scores.half_width + (OUTSIDE - INSIDE) / 2
    for _ in range(rounds):
        inside, outside = sums_by_side(pieces.moments, shown)
        mean_in = inside[:, 1:4] / inside[:, :1].clamp(min=1)
        mean_out = outside[:, 1:4] / outside[:, :1].clamp(min=1)
        change = mean_in - mean_out
        weight = split_scores(inside, outside)[0] * pieces.judged / change.square().sum(1).clamp(min=1e-6)
        seen = pieces.moments[..., 0]
        colours = pieces.moments[..., 1:4]
        votes = ((colours - ((mean_in + mean_out) / 2)[:, None]) * change[:, None]).sum(-1) * seen
        voted = torch.einsum("ek,e->k", votes, weight) > 0
        if not LEAST_SEEN <= int(voted.sum()) <= len(voted) - LEAST_SEEN:
            break
        shown = voted
    return shown
