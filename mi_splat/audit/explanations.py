"""Do directions, the same for all of a surface, explain how its colours change, better
than gloss would?
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.results import Region, Scores, vector
from mi_splat.audit.surfaces import Elements, Sight
from mi_splat.audit.thresholds import LIMITS
from mi_splat.audit.viewpoints import lattice

_WIDTHS = torch.arange(6, 91, 2, dtype=torch.float64)


def region_of(directions: Tensor, amounts: Tensor, shown: Tensor) -> Region:
    """The cone around an appearance: of (K,) amounts, high ones attract its axis, and
    its edge explains the most.
    """
    weights = shown * amounts.double().clamp(min=0) ** LIMITS.attraction
    axis = functional.normalize(weights @ directions, dim=0)
    sets = (angles_between(axis[None], directions) <= _WIDTHS[:, None]).double()
    inside = sets.sum(1)
    between = (
        sets
        @ (amounts - amounts.mean()).double()
        / (inside * (len(amounts) - inside)).sqrt().clamp(min=1)
    )
    return Region(axis=vector(axis), half_width=float(_WIDTHS[between.argmax()]))


def _reflected(
    view: Sight, positions: Tensor, normals: Tensor
) -> tuple[Tensor, Tensor]:
    """(E, K) cosines of the angles of incidence, and (E, K, 3) directions in which a
    mirror would reflect the views.
    """
    eyes = torch.stack([camera.position for camera in view.cameras]).float()
    views = functional.normalize(eyes - positions[:, None], dim=-1)
    cosines = (views * normals[:, None]).sum(-1)
    return cosines, 2 * cosines[..., None] * normals[:, None] - views


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Explanation(Scores):
    """What each kind of profile explains, and which cameras see what that over
    directions says.
    """

    shown: Tensor  # (K,) bool, the cameras that see the look
    # (K,) how much of it each camera sees: in the mean 1 where it is shown, else 0
    amounts: Tensor
    pieces: Elements  # the surface that it was measured on
    # the same for the cameras in the tail of the profile, if that is on the other side
    tail: Explanation | None = None


def angles_between(first: Tensor, second: Tensor) -> Tensor:
    """(A, B) float64 degrees between (A, 3) and (B, 3) unit vectors."""
    return (first.double() @ second.double().T).clamp(-1, 1).acos().rad2deg()


def switch_scores(inside: Tensor, outside: Tensor) -> Tensor:
    """(...) change of mean colour between sides, times the share of the variance that
    it explains.

    Each side has (5, ...) sums of moments over its cameras; the score is 0 where too
    few see a side.
    """
    count_in = inside[0]
    count_out = outside[0]
    count = (count_in + count_out).clamp(min=1)
    squares = (
        (inside[1:4] / count_in.clamp(min=1) - outside[1:4] / count_out.clamp(min=1))
        .square()
        .sum(0)
    )
    mean = (inside[1:4] + outside[1:4]).square().sum(0) / count
    whole = inside[4] + outside[4] - mean + count * 3 * LIMITS.noise**2
    weight = (
        count_in
        * count_out
        / count
        * ((count_in >= LIMITS.least_seen) & (count_out >= LIMITS.least_seen))
    )
    return (squares / 3).sqrt() * weight * squares / whole.clamp(min=1e-9)


# Is an appearance hidden, or only invented where no training camera stood? There fog
# stands before the surface, or the surface is missing, whereas an attacker's two
# appearances are both seen on the same surface through clear air.


def support_of(pieces: Elements, view: Sight, shown: Tensor) -> tuple[float, float]:
    """Share of well seen surface that the cameras of an appearance lose, and their
    clear rays by the others'.
    """
    if not bool(shown.any()):
        return 0.0, 1.0
    cosines, _ = _reflected(
        view, pieces.positions[pieces.judged], pieces.normals[pieces.judged]
    )
    faces = (cosines > LIMITS.towards).T
    sees = faces & (pieces.moments[:, pieces.judged, 0] > 0)
    facing, seeing = (
        torch.stack([part[shown].sum(0), part[~shown].sum(0)]) for part in (faces, sees)
    )
    inside, outside = (seeing / facing.clamp(min=1))[
        :, (facing >= LIMITS.least_seen).all(0)
    ]
    well = outside > LIMITS.well_seen
    if bool(well.any()):
        lost = float((inside < LIMITS.hardly_seen * outside)[well].float().mean())
    else:
        lost = 0.0
    air = view.clear[shown].median() / view.clear[~shown].median().clamp(min=1e-4)
    return lost, float(air)


# Does one profile over directions, of whatever form, explain how colours drift? Each
# piece follows it by an amount and a colour of its own; both are fitted in turn. Gloss
# follows a profile over mirrored directions or angles of incidence. What one over
# directions explains beyond that, times its share of it all, is the evidence: about 0
# if honest.


def _explained(
    colours: Tensor, seen: Tensor, bins: Tensor, smooth: Tensor, starts: Tensor
) -> tuple[Tensor, Tensor]:
    """(E,) drift (sRGB) of (E, K, 3) colours that the best of the profiles over bins
    explains, and that profile.
    """
    count = seen.sum(1).clamp(min=1)
    drift = (
        colours - ((colours * seen[..., None]).sum(1) / count[:, None])[:, None]
    ) * seen[..., None]
    total = drift.square().sum((1, 2)) / count / 3
    trust = count / (3 * (LIMITS.noise**2 + total)).sqrt()
    weight = seen * trust[:, None]
    flat = bins.flatten()
    most = -1.0
    best = (total, starts[0])

    def amounts(profile: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        at = profile[bins]
        mean = (at * seen).sum(1, keepdim=True) / count[:, None]
        at = (at - mean) * seen
        size = at.square().sum(1)
        return (
            mean,
            at,
            size,
            (drift * at[..., None]).sum(1) / (size + 1e-3 * count)[:, None],
        )

    for start in starts:
        profile = start
        for _ in range(LIMITS.profile_rounds):
            mean, _, _, amount = amounts(profile)
            energy = amount.square().sum(1, keepdim=True)
            wanted = ((drift @ amount[..., None])[..., 0] + energy * mean) * weight
            sums = torch.zeros(2, len(start)).index_add_(
                1, flat, torch.stack([wanted, energy * weight]).flatten(1)
            )
            profile = smooth @ sums[0] / (smooth @ sums[1]).clamp(min=1e-9)
            profile = (profile - profile.mean()) / profile.std(correction=0).clamp(
                min=1e-6
            )
        _, at, size, amount = amounts(profile)
        gain = (
            2 * (drift * amount[:, None] * at[..., None]).sum((1, 2))
            - amount.square().sum(1) * size
        )
        part = gain.clamp(min=0) / count / 3
        if float((part * trust).sum()) > most:
            most = float((part * trust).sum())
            best = (part, profile)
    part, profile = best
    return part.sqrt() * part / (total + LIMITS.noise**2), profile


def _close(directions: Tensor) -> Tensor:
    return (
        (
            -0.5
            * (angles_between(directions, directions) / LIMITS.profile_width).square()
        )
        .exp()
        .float()
    )


def explain(pieces: Elements, view: Sight, kept: Tensor) -> Explanation:
    """What directions explain of how the colours drift that (K,) kept cameras see, and
    gloss does not.
    """
    judged = pieces.judged.nonzero()[:, 0]
    some = judged[
        torch.linspace(0, len(judged) - 1, min(len(judged), LIMITS.profile_pieces))
        .round()
        .long()
    ]
    moments = pieces.moments[:, some].transpose(0, 1)
    seen = moments[..., 0].contiguous()
    colours = moments[..., 1:4].contiguous()
    cosines, mirrored = _reflected(view, pieces.positions[some], pieces.normals[some])
    places = lattice(LIMITS.profile_places, -90.0, 90.0)
    steps = torch.arange(float(LIMITS.profile_angles))
    each = torch.arange(len(view.directions)).expand(seen.shape)
    mirror = torch.cat(
        [(part @ places.float().T).argmax(-1) for part in torch.split(mirrored, 64)]
    )
    angle = (cosines * len(steps)).long().clamp(0, len(steps) - 1)
    near = (-0.5 * (steps[:, None] - steps).square()).exp()
    by_direction, profile = _explained(
        colours, seen, each, _close(view.directions), view.directions.float().T
    )
    by_mirror, _ = _explained(colours, seen, mirror, _close(places), places.float().T)
    by_angle, _ = _explained(colours, seen, angle, near, (steps - steps.mean())[None])
    shown = _alike(pieces, _narrower_side(profile, kept, view.directions))
    direction = by_direction.mean()
    beyond = (by_direction - torch.maximum(by_mirror, by_angle)).mean()
    explanation = Explanation(
        direction=float(direction),
        incidence=float(by_angle.mean()),
        mirror=float(by_mirror.mean()),
        net=float(beyond * beyond.abs() / direction.clamp(min=1e-9)),
        shown=shown,
        amounts=_amounts(profile, kept, shown),
        pieces=pieces,
    )
    skewed = (profile - profile[kept].mean()) * kept
    skewed *= skewed.pow(3).sum().sign()
    high = kept & (skewed > _split(skewed[kept]))
    if bool((shown & high).any()) or int(high.sum()) <= LIMITS.least_seen:
        return explanation
    tail = _alike(pieces, high & (skewed > _split(skewed[high])))
    return replace(
        explanation,
        tail=replace(explanation, shown=tail, amounts=_amounts(profile, kept, tail)),
    )


def _amounts(profile: Tensor, kept: Tensor, shown: Tensor) -> Tensor:
    """(K,) profile of kept cameras, scaled to means of 1 where an appearance is shown
    and of 0 elsewhere.
    """
    inside = profile[shown].mean()
    outside = profile[kept & ~shown].mean()
    return kept * ((profile - outside) / (inside - outside)).nan_to_num(0.0, 0.0, 0.0)


def _split(values: Tensor) -> Tensor:
    """Above which of the values lies one of the two sets that differ most (Otsu
    1979).
    """
    values = values.sort().values
    count = torch.arange(1, len(values))
    low = values.cumsum(0)[:-1]
    gap = low / count - (values.sum() - low) / (len(values) - count)
    return values[(count * (len(values) - count) * gap.square()).argmax()]


def _narrower_side(profile: Tensor, kept: Tensor, directions: Tensor) -> Tensor:
    """(K,) bool, of the two sides of kept cameras that differ most the one that lies
    closer together.
    """
    high = kept & (profile > _split(profile[kept]))
    sides = torch.stack([high, kept & ~high])
    means = (sides.double() @ directions).norm(dim=1) / sides.sum(1).clamp(min=1)
    return sides[means.argmax()]


def _alike(pieces: Elements, shown: Tensor) -> Tensor:
    """(K,) bool, of the cameras that see a look those to which it looks as to the one
    that sees most of it.
    """
    seen = pieces.moments[..., 0] * pieces.judged
    colours = pieces.moments[..., 1:4]
    others = seen[~shown].sum(0)
    usual = (seen[~shown, :, None] * colours[~shown]).sum(0) / others.clamp(min=1)[
        :, None
    ]
    change = (colours - usual) * (seen * (others >= LIMITS.least_seen))[..., None]
    energy = change.square().sum(2)
    first = int((energy.sum(1) * shown).argmax())
    # on the pieces that both see
    common = (energy @ seen[first]) * (seen @ energy[first])
    alike: Tensor = (change * change[first]).sum(
        (1, 2)
    ) >= LIMITS.same_look * common.sqrt()
    return shown & alike


def piece_scores(pieces: Elements, shown: Tensor) -> Tensor:
    """(E,) how far the colour of each piece switches with a look, 0 where it is not
    judged.
    """
    sums = torch.stack([shown, ~shown]).float() @ pieces.moments.flatten(1)
    return switch_scores(*sums.reshape(2, -1, 5).mT) * pieces.judged


def reachable(pieces: Elements, view: Sight) -> Tensor:
    """(E,) bool, whether a piece is seen from directions that differ enough to
    contradict each other.
    """
    ways = pieces.moments[..., 0].T @ view.directions.float()
    apart: Tensor = ways.norm(dim=1) < LIMITS.one_sided * pieces.moments[..., 0].sum(0)
    return apart
