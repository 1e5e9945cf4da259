"""Do directions, the same for all of a surface, explain how its colours change, better than gloss would?

The score of a cone of directions on a cell of surface is the change of its mean colour, from inside to outside, times
the share of the variance that this explains; changes that point everywhere cancel out. Of an object it is the geometric
mean of two numbers: the mean over all of its surface, and that over its six highest cells.
"""

from __future__ import annotations

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


def face_of(normals: Tensor) -> Tensor:
    """(E,) int64 which of six sides (E, 3) normals face along."""
    axis = normals.abs().argmax(1)
    return 2 * axis + (normals.gather(1, axis[:, None])[:, 0] > 0)


def _reflected(view: Sight, positions: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """(E, K) cosines of the angles of incidence, and (E, K, 3) directions in which a mirror would reflect the views."""
    eyes = torch.stack([camera.position for camera in view.cameras]).float()
    views = functional.normalize(eyes - positions[:, None], dim=-1)
    cosines = (views * normals[:, None]).sum(-1)
    return cosines, 2 * cosines[..., None] * normals[:, None] - views


_CHUNK = 32  # pieces that are compared together, so that their numbers stay in the cache


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Explanation(Scores):
    """The cone of directions that explains most, and what each kind of profile explains."""

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


def cone_scores(moments: Tensor, cell: Tensor, directions: Tensor) -> Tensor:
    """(T,) score of each cone on an object of (E, K, 5) moments."""
    sums, able, sides = torch.zeros(0), 0, [side.T.contiguous() for side in cone_sides(directions)]
    for rows in torch.split(torch.arange(len(moments)), _CHUNK):
        part = moments[rows].transpose(1, 2).contiguous()
        split = Split.of(*((part @ side).movedim(1, 0) for side in sides))
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
    """The cone that explains the colours of an object best, and what directions explain of them and gloss does not."""
    judged = pieces.judged.nonzero()[:, 0]
    judged = judged[torch.linspace(0, len(judged) - 1, min(len(judged), LIMITS.most_pieces)).round().long()]
    cell = torch.unique(cells_of(pieces)[judged], return_inverse=True)[1]
    moments = pieces.moments[:, judged].transpose(0, 1).contiguous()
    scores, (axes, half_widths) = cone_scores(moments, cell, view.directions), _cones()
    best = int(scores.argmax())
    some = torch.linspace(0, len(judged) - 1, min(len(judged), LIMITS.profile_pieces)).round().long()
    return Explanation(
        score=float(scores[best]),
        **drifts_of(moments[some], view, pieces.positions[judged[some]], pieces.normals[judged[some]]),
        axis=axes[best],
        half_width=float(half_widths[best]),
    )


# Is an appearance hidden, or only invented where no training camera stood? There fog stands before the surface, or the
# surface is missing, whereas an attacker's two appearances are both seen on the same surface through clear air.


def support_of(pieces: Elements, view: Sight, shown: Tensor) -> tuple[float, float]:
    """Share of well seen surface that the smaller side of an appearance loses, and its clear rays by the others'."""
    small = shown if 2 * int(shown.sum()) <= len(shown) else ~shown
    if not bool(small.any()):
        return 0.0, 1.0
    cosines, _ = _reflected(view, pieces.positions[pieces.judged], pieces.normals[pieces.judged])
    faces = (cosines > LIMITS.towards).T
    sees = faces & (pieces.moments[:, pieces.judged, 0] > 0)
    facing, seeing = (torch.stack([part[small].sum(0), part[~small].sum(0)]) for part in (faces, sees))
    inside, outside = (seeing / facing.clamp(min=1))[:, (facing >= LIMITS.least_seen).all(0)]
    well = outside > LIMITS.well_seen
    lost = float((inside < LIMITS.hardly_seen * outside)[well].float().mean()) if bool(well.any()) else 0.0
    air = view.clear[small].median() / view.clear[~small].median().clamp(min=1e-4)
    return lost, float(air)


# Does one profile over directions, of whatever form, explain how colours drift? Each piece follows it by an amount and
# a colour of its own; both are fitted in turn. Gloss
# follows a profile over mirrored directions or angles of incidence. What one over directions explains beyond that is
# the evidence: about 0 if honest.


def _explained(colours: Tensor, seen: Tensor, bins: Tensor, smooth: Tensor, starts: Tensor) -> Tensor:
    """(E,) drift (sRGB) of (E, K, 3) colours that the best of the profiles over bins explains."""
    count = seen.sum(1).clamp(min=1)
    drift = (colours - ((colours * seen[..., None]).sum(1) / count[:, None])[:, None]) * seen[..., None]
    total = drift.square().sum((1, 2)) / count / 3
    trust = count / (3 * (LIMITS.noise**2 + total)).sqrt()
    weight, flat, most, best = seen * trust[:, None], bins.flatten(), -1.0, total

    def amounts(profile: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        at = profile[bins]
        mean = (at * seen).sum(1, keepdim=True) / count[:, None]
        at = (at - mean) * seen
        size = at.square().sum(1)
        return mean, at, size, (drift * at[..., None]).sum(1) / (size + 1e-3 * count)[:, None]

    for start in starts:
        profile = start
        for _ in range(LIMITS.profile_rounds):
            mean, _, _, amount = amounts(profile)
            energy = amount.square().sum(1, keepdim=True)
            wanted = ((drift @ amount[..., None])[..., 0] + energy * mean) * weight
            sums = torch.zeros(2, len(start)).index_add_(1, flat, torch.stack([wanted, energy * weight]).flatten(1))
            profile = smooth @ sums[0] / (smooth @ sums[1]).clamp(min=1e-9)
            profile = (profile - profile.mean()) / profile.std(correction=0).clamp(min=1e-6)
        _, at, size, amount = amounts(profile)
        gain = 2 * (drift * amount[:, None] * at[..., None]).sum((1, 2)) - amount.square().sum(1) * size
        part = gain.clamp(min=0) / count / 3
        if float((part * trust).sum()) > most:
            most, best = float((part * trust).sum()), part
    return best.sqrt() * best / (total + LIMITS.noise**2)


def _close(directions: Tensor) -> Tensor:
    return (-0.5 * (angles_between(directions, directions) / LIMITS.profile_width).square()).exp().float()


def drifts_of(moments: Tensor, view: Sight, positions: Tensor, normals: Tensor) -> dict[str, float]:
    """Mean drift (sRGB) of (E, K, 5) moments that each profile explains, and that of directions beyond gloss."""
    seen, colours = moments[..., 0].contiguous(), moments[..., 1:4].contiguous()
    cosines, mirrored = _reflected(view, positions, normals)
    places, steps = lattice(LIMITS.profile_places, -90.0, 90.0), torch.arange(float(LIMITS.profile_angles))
    each = torch.arange(len(view.directions)).expand(seen.shape)
    by_direction = _explained(colours, seen, each, _close(view.directions), view.directions.float().T)
    by_mirror = _explained(colours, seen, (mirrored @ places.float().T).argmax(-1), _close(places), places.float().T)
    near, angle = (-0.5 * (steps[:, None] - steps).square()).exp(), (cosines * len(steps)).long()
    by_angle = _explained(colours, seen, angle.clamp(0, len(steps) - 1), near, (steps - steps.mean())[None])
    parts = {"direction": by_direction, "incidence": by_angle, "mirror": by_mirror}
    net = by_direction - torch.maximum(by_mirror, by_angle)
    return {**{name: float(part.mean()) for name, part in parts.items()}, "net": float(net.mean())}


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


def _change(pieces: Elements, shown: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(E, 3) colours outside of a look, their change, and that times the share of a piece's score that it has."""
    inside, outside = (side[1:4].T / side[0, :, None].clamp(min=1) for side in sums_by_side(pieces.moments, shown))
    change = inside - outside
    weight = piece_scores(pieces, shown) / change.square().sum(1).clamp(min=1e-6)
    return outside, change, change * weight[:, None]


def look_amounts(pieces: Elements, shown: Tensor) -> Tensor:
    """(K,) how much of a look each camera sees, by the mean of the pieces' scores, from 0 (none) to 1."""
    outside, change, way = _change(pieces, shown)
    most = pieces.moments[..., 0] @ (change * way).sum(1)
    return _along(pieces.moments, outside, way) / most.clamp(min=1e-12)


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
        outside, change, way = _change(pieces, shown)
        voted = _along(pieces.moments, outside + change / 2, way) > 0
        if not LIMITS.least_seen <= int(voted.sum()) <= len(voted) - LIMITS.least_seen:
            break
        shown = voted
    return shown
