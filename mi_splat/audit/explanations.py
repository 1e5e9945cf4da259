"""Does one set of directions, the same for all of a surface, explain how its colours change?

The score of a set of directions on a cell of surface is the change of its mean colour, from inside to outside, times
the share of the variance that this explains; changes that point everywhere cancel out. Of an object it is the geometric
mean of two numbers: the mean over all of its surface, and that over its six highest cells.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.results import Region, Scores, vector
from mi_splat.audit.surfaces import Elements, Sight, basis, lattice
from mi_splat.audit.thresholds import LIMITS

_WIDTHS = torch.arange(6, 91, 2, dtype=torch.float64)
_SECTOR_WIDTHS = torch.arange(10, 171, 8, dtype=torch.float64)
_ELEVATIONS = torch.arange(0, 91, 6, dtype=torch.float64)


def region_of(directions: Tensor, shown: Tensor, up: Tensor | None) -> Region:
    """The directions, in the frame of the splat, that overlap most with the cameras that see an appearance."""
    regions = [_cone(directions, shown, complement=False), _cone(directions, ~shown, complement=True)]
    gains = [regions[0].overlap, regions[1].overlap - LIMITS.complement_gain]
    if up is not None:
        regions.append(_sector(directions, shown, up))
        gains.append(regions[2].overlap - LIMITS.sector_gain)
    return regions[max(range(len(gains)), key=gains.__getitem__)]


def _overlaps(sets: Tensor, shown: Tensor) -> Tensor:
    """(T,) intersection over union of (T, K) sets of cameras with one."""
    return (sets & shown).sum(1) / (sets | shown).sum(1).clamp(min=1)


def _cone(directions: Tensor, inside: Tensor, *, complement: bool) -> Region:
    axis = functional.normalize(directions[inside].sum(0), dim=0)
    holds = angles_between(axis[None], directions) <= _WIDTHS[:, None]
    overlap = _overlaps(~holds if complement else holds, ~inside if complement else inside)
    best = int(overlap.argmax())
    return Region(
        axis=vector(axis),
        half_width=float(_WIDTHS[best]),
        complement=complement,
        overlap=float(overlap[best]),
    )


def _sector(directions: Tensor, shown: Tensor, up: Tensor) -> Region:
    local = directions @ basis(up)
    elevation = local[:, 2].clamp(-1, 1).asin().rad2deg()
    azimuth = torch.atan2(local[:, 1], local[:, 0]).rad2deg()
    middle = local[shown, :2].sum(0)
    middle = middle / middle.norm().clamp(min=1e-12)
    turn = (azimuth - torch.atan2(middle[1], middle[0]).rad2deg() + 180) % 360 - 180
    wedges = turn.abs() <= _SECTOR_WIDTHS[:, None]
    low, high = torch.combinations(_ELEVATIONS, 2).unbind(1)
    bands = (elevation >= low[:, None]) & (elevation <= high[:, None])
    overlap = _overlaps((wedges[:, None] & bands[None]).flatten(0, 1), shown)
    best = int(overlap.argmax())
    wedge, band = divmod(best, len(low))
    return Region(
        axis=vector(basis(up)[:, :2] @ middle),
        half_width=float(_SECTOR_WIDTHS[wedge]),
        elevation=(float(low[band]), float(high[band])),
        overlap=float(overlap[best]),
    )


# Do faces that look different ways change from the same directions?
#
# Gloss moves with the normal, and chance in the coefficients of single Gaussians has no common direction. A hidden
# appearance has one for all of the surface. Two numbers of a set of directions say so, both less a multiple of what
# chance would make of them, by how cells of surface differ:
#
# - shift: how far the mean colour of what faces along one normal changes from inside to outside (sRGB): the geometric
#   mean of that over all of the surface, and of that without the face, of the six main ones, that has most of it.
# - fade: the share of its contrast that is gone inside, without the face that speaks most for it. Gloss adds to the
#   colours of surface with one normal and leaves their contrast; a hidden appearance replaces them.


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Profiles:
    """How pieces of surface change with the camera."""

    cell: Tensor  # (E,) int64 cell of each piece
    normals: Tensor  # (C, 3) mean unit normals of the cells
    pieces: Tensor  # (C,) pieces of each
    # (E, K, 6): what a camera sees of a piece less its own mean colour, 0 where it does not see it; how much more of
    # its own contrast to its group of normals that has, times the square of the contrast; that square; whether seen.
    looks: Tensor

    @classmethod
    def of(cls, moments: Tensor, normals: Tensor, cell: Tensor) -> Profiles:
        """Profiles of pieces."""
        seen, colours = moments[..., :1], moments[..., 1:4]
        group, looks = _group_of(normals), moments[..., 0].sum(1, keepdim=True)
        count = torch.zeros(LIMITS.normals, moments.shape[1], 1).index_add_(0, group, seen).clamp(min=1)
        common = torch.zeros(LIMITS.normals, moments.shape[1], 3)
        own = (colours * seen).sum(1) / looks
        for _ in range(LIMITS.profile_rounds):
            common = torch.zeros_like(common).index_add_(0, group, (colours - own[:, None]) * seen) / count
            own = ((colours - common[group]) * seen).sum(1) / looks
        members = torch.bincount(group, minlength=LIMITS.normals)[:, None].clamp(min=1)
        contrast = own - (torch.zeros(LIMITS.normals, 3).index_add_(0, group, own) / members)[group]
        change = (colours - own[:, None]) * seen
        fade = ((change - common[group] * seen) * contrast[:, None]).sum(-1, keepdim=True)
        energy = contrast.square().sum(-1)[:, None, None] * seen
        cells = int(cell.max()) + 1
        return cls(
            cell=cell,
            normals=functional.normalize(torch.zeros(cells, 3).index_add_(0, cell, normals), dim=1),
            pieces=torch.bincount(cell, minlength=cells).float(),
            looks=torch.cat([change, fade, energy, seen], -1),
        )

    def of_cells(self) -> Tensor:
        """(C, K, 6) sums of the looks at each cell."""
        return self._by_cell(self.looks)

    def parted(self, sides: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]], rows: int) -> tuple[Tensor, Tensor]:
        """(C, T, 6) sums inside and outside of sets of cameras that differ from piece to piece, so many at a time."""
        parts = [sides(part, self.looks[part]) for part in torch.split(torch.arange(len(self.looks)), rows)]
        inside, outside = (self._by_cell(torch.cat(values)) for values in zip(*parts, strict=True))
        return inside, outside

    def _by_cell(self, values: Tensor) -> Tensor:
        return torch.zeros(len(self.pieces), *values.shape[1:]).index_add_(0, self.cell, values)

    def shifts(self, inside: Tensor, outside: Tensor) -> Tensor:
        """(T,) float64 shift of each set of cameras, sRGB."""
        first, second = inside[..., 5], outside[..., 5]
        able = (first >= LIMITS.least_looks) & (second >= LIMITS.least_looks)
        change = inside[..., :3] / first.clamp(min=1)[..., None] - outside[..., :3] / second.clamp(min=1)[..., None]
        weight = _weight(first, second) * able
        sums = torch.zeros(LIMITS.normals, *weight.shape[1:], 9, dtype=torch.float64)
        sums.index_add_(0, _group_of(self.normals), _terms(weight, change))
        mean, error, cells = _estimate(sums)
        size = (mean.square().sum(-1) / 3).sqrt() - LIMITS.shift_errors * (error / 3).sqrt()
        pieces = torch.zeros(LIMITS.normals, weight.shape[1], dtype=torch.float64)
        pieces.index_add_(0, _group_of(self.normals), (able * self.pieces[:, None]).double())
        size = size.clamp(min=0) * (cells >= LIMITS.least_cells) * pieces
        faces = torch.zeros(6, weight.shape[1], dtype=torch.float64)
        faces.index_add_(0, face_of(lattice(LIMITS.normals, -90.0, 90.0)), size)
        total = faces.sum(0)
        return (total * (total - faces.amax(0)).clamp(min=0)).sqrt() / pieces.sum(0).clamp(min=1)

    def fades(self, inside: Tensor, outside: Tensor) -> Tensor:
        """(T,) float64 share of the contrast that changes between the sides of each set of cameras, as in `shifts`."""
        first, second = inside[..., 4], outside[..., 4]
        able = (first > 0) & (second > 0)
        change = inside[..., 3] / first.clamp(min=1e-9) - outside[..., 3] / second.clamp(min=1e-9)
        sums = torch.zeros(6, *first.shape[1:], 5, dtype=torch.float64)
        sums.index_add_(0, face_of(self.normals), _terms(_weight(first, second) * able, change[..., None]))
        total = sums.sum(0)
        mean, error, cells = _estimate(total - sums)
        size = mean[..., 0] * total[..., 1].sign() - LIMITS.fade_errors * error.sqrt()
        return (size.clamp(min=0) * (cells > LIMITS.least_fade_cells)).amin(0)


def face_of(normals: Tensor) -> Tensor:
    """(E,) int64 which of six sides (E, 3) normals face along."""
    axis = normals.abs().argmax(1)
    return 2 * axis + (normals.gather(1, axis[:, None])[:, 0] > 0)


def _group_of(normals: Tensor) -> Tensor:
    return (normals @ lattice(LIMITS.normals, -90.0, 90.0).float().T).argmax(1)


def _weight(first: Tensor, second: Tensor) -> Tensor:
    return first * second / (first + second).clamp(min=1e-9)


def _terms(weight: Tensor, value: Tensor) -> Tensor:
    """(C, T, 3 + 2 D) float64 terms of which sums over cells make a mean of (C, T, D) values and its error."""
    weight, value = weight.double()[..., None], value.double()
    squares = weight.square()
    terms = [weight, weight * value, squares, squares * value, squares * value.square().sum(-1, keepdim=True)]
    return torch.cat(terms, -1)


def _estimate(sums: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(..., D) mean, (...) the square of its standard error over all D, and (...) cells by weight."""
    size = (sums.shape[-1] - 3) // 2
    weight, squares = sums[..., 0].clamp(min=1e-12), sums[..., size + 1]
    mean = sums[..., 1 : size + 1] / weight[..., None]
    cross = (mean * sums[..., size + 2 : 2 * size + 2]).sum(-1)
    spread = (sums[..., -1] - 2 * cross + mean.square().sum(-1) * squares).clamp(min=0) / weight.square()
    cells = weight.square() / squares.clamp(min=1e-20)
    return mean, spread * cells / (cells - 1).clamp(min=0.5), cells


def _reflected(view: Sight, positions: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """(E, K) cosines of the angles of incidence, and (E, K, 3) directions in which a mirror would reflect the views."""
    eyes = torch.stack([camera.position for camera in view.cameras]).float()
    views = functional.normalize(eyes - positions[:, None], dim=-1)
    cosines = (views * normals[:, None]).sum(-1)
    return cosines, 2 * cosines[..., None] * normals[:, None] - views


def incidence_sides(cosines: Tensor) -> tuple[Tensor, Tensor]:
    """(E, K, A) float32 cameras inside and outside of each set of angles of incidence."""
    limits = torch.tensor(LIMITS.cosines)
    return (cosines[..., None] > limits + 0.03).float(), (cosines[..., None] < limits - 0.06).float()


def gloss_sides(cosines: Tensor, mirrored: Tensor) -> tuple[Tensor, Tensor]:
    """(E, K, R) float32 cameras inside and outside of each set of angles of incidence, and of mirrored directions."""
    limits, widths, axes = torch.tensor(LIMITS.cosines), LIMITS.mirror_widths, LIMITS.mirror_axes
    inner, outer = (
        torch.cat(
            [limits + step, torch.tensor([math.cos(math.radians(w + edge)) for w in widths for _ in range(axes)])]
        )
        for step, edge in ((0.03, -LIMITS.inside), (-0.06, LIMITS.outside))
    )
    turned = mirrored @ lattice(axes, -90.0, 90.0).float().T
    values = torch.cat([cosines[..., None].expand(-1, -1, len(limits)), turned.repeat(1, 1, len(widths))], 2)
    return torch.gt(values, inner, out=torch.empty_like(values)), values.lt_(outer)


_CHUNK = 32  # pieces that are compared together, so that their numbers stay in the cache

Sides = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""From (E,) rows and (E, 5, K) their moments to (E, 5, T) sums inside and outside of T sets of cameras."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Explanation(Scores):
    """The cone of directions that explains most, and how well gloss would."""

    axis: Tensor  # (3,)
    half_width: float  # degrees


def angles_between(first: Tensor, second: Tensor) -> Tensor:
    """(A, B) float64 degrees between (A, 3) and (B, 3) unit vectors."""
    return (first.double() @ second.double().T).clamp(-1, 1).acos().rad2deg()


def _cones() -> tuple[Tensor, Tensor]:
    """(T, 3) float64 axes all around, and (T,) half widths in degrees, of the cones that are tried."""
    widths = torch.tensor(LIMITS.half_widths, dtype=torch.float64)
    return lattice(LIMITS.axes, -90.0, 90.0).repeat_interleave(len(widths), 0), widths.repeat(LIMITS.axes)


def cone_sides(directions: Tensor) -> tuple[Tensor, Tensor]:
    """(T, K) float32, which directions are inside of each cone, and which outside; those at its edge are neither."""
    axes, half_widths = _cones()
    angles = angles_between(axes, directions)
    inside = angles < half_widths[:, None] - LIMITS.inside
    return inside.float(), (angles > half_widths[:, None] + LIMITS.outside).float()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Split:
    """Pieces of surface parted by sets of cameras."""

    change: Tensor  # (3, ...) mean colour inside less that outside
    weight: Tensor  # (...) how much each change is known, 0 where too few cameras see one side
    whole: Tensor  # (...) variance of the colours times their number
    valid: Tensor  # (...) bool, whether enough cameras see both sides

    @classmethod
    def of(cls, inside: Tensor, outside: Tensor) -> Split:
        """Part pieces, given the (5, ...) sums of their moments over the cameras inside and outside."""
        count_in, count_out = inside[0], outside[0]
        count = (count_in + count_out).clamp(min=1)
        mean_in = inside[1:4] / count_in.clamp(min=1)
        mean_out = outside[1:4] / count_out.clamp(min=1)
        valid = (count_in >= LIMITS.least_seen) & (count_out >= LIMITS.least_seen)
        squares = (inside[1:4] + outside[1:4]).square().sum(0)
        whole = inside[4] + outside[4] - squares / count + count * 3 * LIMITS.noise**2
        weight = count_in * count_out / count * valid
        return cls(change=mean_in - mean_out, weight=weight, whole=whole, valid=valid)

    def scores(self) -> Tensor:
        """(...) score of each piece by itself, 0 where it is not valid."""
        squares = self.change.square().sum(0)
        return (squares / 3).sqrt() * self.weight * squares / self.whole.clamp(min=1e-9)


def cells_of(pieces: Elements) -> Tensor:
    """(E,) int64 cell of each piece, by its position and the axis that it faces along."""
    voxel = (pieces.positions / (LIMITS.cell_size * pieces.size)).floor().long()
    voxel = voxel - voxel.amin(0)
    sizes = voxel.amax(0) + 1
    number = ((voxel[:, 0] * sizes[1] + voxel[:, 1]) * sizes[2] + voxel[:, 2]) * 6 + face_of(pieces.normals)
    cell: Tensor = torch.unique(number, return_inverse=True)[1]
    return cell


def set_scores(moments: Tensor, cell: Tensor, sides: Sides) -> Tensor:
    """(T,) score of each set of cameras on an object."""
    sums, able = torch.zeros(0), 0
    for rows in torch.split(torch.arange(len(moments)), _CHUNK):
        split = Split.of(*(side.movedim(1, 0) for side in sides(rows, moments[rows].transpose(1, 2).contiguous())))
        valid = split.valid.float()
        others = torch.stack([split.weight, split.whole * valid, valid])
        if not len(sums):
            sums = torch.zeros(int(cell.max()) + 1, 6, valid.shape[1])
        sums.index_add_(0, cell[rows], torch.cat([split.weight * split.change, others]).movedim(0, 1))
        able += int(split.valid.any(1).sum())
    weight, count = sums[:, 3].clamp(min=1e-9), sums[:, 5]
    squares = (sums[:, :3] / weight[:, None]).square().sum(1)
    score = (squares / 3).sqrt() * squares * weight / sums[:, 4].clamp(min=1e-9)
    score = torch.where(count >= LIMITS.cell_pieces, score, 0.0)
    highest = score.topk(min(LIMITS.highest_cells, len(score)), dim=0).values.sum(0) / LIMITS.highest_cells
    return ((score * count).sum(0) / max(able, 1) * highest).sqrt()


def explain(pieces: Elements, view: Sight) -> Explanation:
    """Score how well sets of directions explain the colours of an object, and how well gloss would."""
    judged = pieces.judged.nonzero()[:, 0]
    judged = judged[torch.linspace(0, len(judged) - 1, min(len(judged), LIMITS.most_pieces)).round().long()]
    cell = torch.unique(cells_of(pieces)[judged], return_inverse=True)[1]
    moments = pieces.moments[:, judged].permute(1, 2, 0).contiguous().transpose(1, 2)
    cosines, mirrored = _reflected(view, pieces.positions[judged], pieces.normals[judged])
    cones = cone_sides(view.directions)

    def by_incidence(rows: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
        inside, outside = incidence_sides(cosines[rows])
        return inside.transpose(1, 2) @ part, outside.transpose(1, 2) @ part

    def by_gloss(rows: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
        inside, outside = gloss_sides(cosines[rows], mirrored[rows])
        return part @ inside, part @ outside

    direct = set_scores(moments, cell, lambda _, part: (part @ cones[0].T, part @ cones[1].T))
    rivals = set_scores(moments, cell, by_gloss)
    profiles = Profiles.of(moments, pieces.normals[judged], cell)
    at_cells = profiles.of_cells()
    parted = [torch.einsum("ckx,tk->ctx", at_cells, side) for side in cones]
    by_angle = profiles.parted(by_incidence, _CHUNK)
    fade = float(profiles.fades(*parted).max() - profiles.fades(*by_angle).max())
    angles, best, (axes, half_widths) = len(LIMITS.cosines), int(direct.argmax()), _cones()
    return Explanation(
        score=float(direct[best]),
        incidence=float(rivals[:angles].max()),
        mirror=float(rivals[angles:].max()),
        shift=float(profiles.shifts(*parted).max()),
        fade=max(0.0, fade),
        axis=axes[best],
        half_width=float(half_widths[best]),
    )


def sums_by_side(moments: Tensor, shown: Tensor) -> tuple[Tensor, Tensor]:
    """(5, E) sums of (K, E, 5) moments over the cameras that see a look, and over those that do not."""
    sums = torch.stack([shown, ~shown]).float() @ moments.flatten(1)
    inside, outside = sums.reshape(2, -1, 5).mT.contiguous()
    return inside, outside


def _along(moments: Tensor, origin: Tensor, way: Tensor) -> Tensor:
    """(K,) sums over the pieces that each camera sees of (E, 3) ways times their colours less (E, 3) others."""
    factors = torch.cat([-(origin * way).sum(1, keepdim=True), way, torch.zeros(len(way), 1)], 1)
    return moments.flatten(1) @ factors.flatten()


def piece_scores(pieces: Elements, shown: Tensor) -> Tensor:
    """(E,) score of each piece, 0 where it is not judged."""
    return Split.of(*sums_by_side(pieces.moments, shown)).scores() * pieces.judged


def look_amounts(pieces: Elements, shown: Tensor) -> Tensor:
    """(K,) how much of a look each camera sees, by the mean of the pieces' scores, from 0 (none) to 1."""
    inside, outside = (side[1:4].T / side[0, :, None].clamp(min=1) for side in sums_by_side(pieces.moments, shown))
    change = inside - outside
    weight = piece_scores(pieces, shown) / change.square().sum(1).clamp(min=1e-6)
    most = pieces.moments[..., 0] @ (change.square().sum(1) * weight)
    return _along(pieces.moments, outside, change * weight[:, None]) / most.clamp(min=1e-12)


def reachable(pieces: Elements, view: Sight) -> Tensor:
    """(E,) bool, whether some cone has enough of the cameras that see a piece inside and outside."""
    inside, outside = cone_sides(view.directions)
    parts, least = torch.split(pieces.moments[..., 0].T.contiguous(), _CHUNK), LIMITS.least_seen
    return torch.cat([((part @ inside.T >= least) & (part @ outside.T >= least)).any(1) for part in parts])


def cameras_of_look(pieces: Elements, view: Sight, scores: Explanation) -> Tensor:
    """(K,) bool, which cameras see the look: a set of any form, begun with the best cone."""
    width = scores.half_width + (LIMITS.outside - LIMITS.inside) / 2
    shown = angles_between(scores.axis[None], view.directions)[0] < width
    for _ in range(LIMITS.votes):
        inside, outside = (side[1:4].T / side[0, :, None].clamp(min=1) for side in sums_by_side(pieces.moments, shown))
        change = inside - outside
        weight = piece_scores(pieces, shown) / change.square().sum(1).clamp(min=1e-6)
        voted = _along(pieces.moments, (inside + outside) / 2, change * weight[:, None]) > 0
        if not LIMITS.least_seen <= int(voted.sum()) <= len(voted) - LIMITS.least_seen:
            break
        shown = voted
    return shown
