"""Two groups of images that contradict each other, from what they show of the same
points.

From many starting splits, the median colour of each point in each group and the group
that each image contradicts less are found in turn, until nothing changes. Parts of the
set that share few points, such as cameras in front of a thin sheet and behind it, can
be matched either way by that. The side of each part is therefore the one on which
neighbouring images agree.
"""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from mi_splat.audit.observations import Observations, median_of
from mi_splat.maths.sh import even_directions

FIRST_POINTS = 800  # that the starting splits see
STARTS = 16  # directions from which images are split in two ways each
CENTRES = 8  # images around which the nearest ones are split off
CAP = 0.15  # sRGB above which a larger difference counts no more
ROUNDS = 20
LEAST_SEEN = 2  # images of a group that have to see a point
NOISE = 0.02  # sRGB by which honest images differ
NEIGHBOURS = 8  # nearest images in which the noise of a point is looked for
UNDECIDED = 0.15
"""Share of the usual evidence, and difference of the two costs in their sum, below
which an image belongs to neither group.
"""
TYPICAL = 0.5  # share of the usual score of a group below which nothing is named
LEAST_POINTS = 50
BESIDE = 0.5  # separation up to which two images are side by side
SPACINGS = 3.0  # median distance to the nearest image, up to which they are, too
SEES = 0.5  # of what the smaller group usually sees of the disputed points
CLEAR = 0.2  # from the middle between the colours of both groups
LOWER = 0.25  # quantile of these pairs that has to differ
SPREAD = 0.1  # that images of one group have at least
NEAREST = 0.15  # share of these pairs, the nearest, that say how sharp the edge is
LEAST_PAIRS = 4
ALIKE = 15  # pairs of one group as far apart, with which each is compared
FLOOR = 0.01  # sRGB that images of one group differ by at least
SHARED = 0.3  # of what an image sees, that another has to see to be compared with it
AGREEING = 6  # nearest images with which an image should agree
AGREEMENT = 0.1  # what this counts, next to what the images show
ALIGNMENTS = 5  # rounds
RIVAL = 0.6  # share of the strength from which another split disputes a group
FEWER = 0.6  # share of one side, below which another is clearly smaller
LITTLE = 0.05  # of the usual evidence, that an image without any has


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Split:
    """Two groups of V images, and how much they contradict each other."""

    smaller: Tensor  # (V,) bool, images of the smaller group; the others are the larger
    decided: Tensor  # (V,) bool, images that see enough to belong to one of the two
    # (V,) in [-1, 1], by how much less an image contradicts the smaller group; at most
    # 0 where no neighbours lead from it to images side by side that contradict
    scores: Tensor
    # sRGB by which an image differs less from its own group than from the other, in the
    # mean over all points that it sees
    gain: float
    # difference of images of the two groups that were taken side by side, by that of
    # images of one group that are as far apart
    edge: float = 0.0
    difference: float = 0.0  # sRGB of the former less that of the latter
    # how far images side by side lie apart on the way from the colours of one group to
    # those of the other: 1 if all is different, and little where it changes gradually
    step: float = 0.0
    spread: float = 0.0  # the same of images of one group
    # images side by side, of the smaller and the larger
    pair: tuple[int, int] | None = None
    # images of the larger group that clearly are on its side of what is disputed; None
    # counts all of them
    opposed: int | None = None
    agreement: float = 1.0  # share of the smaller group that no similar split disputes

    @property
    def sides(self) -> Tensor:
        """(V,) 1 for images of the smaller group, -1 for the larger, 0 for neither."""
        larger = self.decided & ~self.smaller
        return self.smaller.float() - larger.float()

    @property
    def hesitating(self) -> Tensor:
        """(V,) bool, images that prefer the larger group by less than half of what is
        usual there.
        """
        larger = self.decided & ~self.smaller
        usual = self.scores[larger].median()
        return ~self.smaller & (self.scores > TYPICAL * usual)

    @property
    def strength(self) -> float:
        """What splits are compared by; 0 where images side by side differ no more
        across the groups than within them, as those of gloss do.
        """
        excess = max(self.edge - 1, 0.0)
        clear = max(self.step / (self.spread + SPREAD) - 1, 0.0)
        return excess * clear * self.gain


def split_images(observed: Observations) -> Split | None:
    """The two groups of images that contradict each other most; None if images share
    too few points.
    """
    if observed.seen.shape[1] < LEAST_POINTS:
        return None
    noise = _noise(observed)
    few = _some(observed, FIRST_POINTS)
    even = torch.zeros(few.seen.shape[1])
    found = _distinct(_alternated(few, start, even, False) for start in _starts(few))
    found = _distinct(_alternated(observed, start, noise, True) for start in found)
    near = _neighbourhood(observed)
    found = _distinct(_aligned(observed, start, noise, near) for start in found)
    splits = [_measured(observed, smaller, noise) for smaller in found]
    judged = [split for split in splits if split is not None]
    if not judged:
        return None
    return _chosen(judged)


def beneath(observed: Observations, split: Split) -> Observations:
    """What is left without the way from the colours of one group to those of the other,
    as far as each image has gone on it.
    """
    group = split.scores > 0
    noise = _noise(observed)
    places, _ = _places(observed, group, noise)
    is_known, (first, second) = _medians(observed, group, noise, False)
    way = (first - second) * is_known[:, None]
    change = places[:, None, None] * way
    return dataclasses.replace(observed, colours=observed.colours - change)


def _chosen(judged: list[Split]) -> Split:
    """The strongest split, or one that is nearly as strong and names the other side, if
    that is clearly the smaller part of what all such splits agree on.
    """
    best = max(judged, key=lambda split: (split.strength, split.edge))
    rivals = [split for split in judged if split.strength >= RIVAL * best.strength]
    own = _undisputed(best, rivals)
    turned = [split for split in rivals if float(split.sides @ best.sides) < 0]
    if not turned:
        return own
    strongest = max(turned, key=lambda split: split.strength)
    other = _undisputed(strongest, rivals)
    fewer = FEWER * int(own.smaller.sum())
    is_fewer = 0 < int(other.smaller.sum()) <= fewer
    return other if is_fewer and other.agreement >= own.agreement else own


def _undisputed(best: Split, rivals: list[Split]) -> Split:
    """A split in whose smaller group are only images that all others have there, too,
    whichever group is the smaller one there.
    """
    agreed = best.smaller.clone()
    for other in rivals:
        sides = other.sides
        if float(sides @ best.sides) < 0:
            sides = -sides
        agreed &= sides >= 0
    share = int(agreed.sum()) / int(best.smaller.sum())
    decided = best.decided & (agreed | ~best.smaller)
    return dataclasses.replace(best, smaller=agreed, decided=decided, agreement=share)


def _starts(observed: Observations) -> Iterator[Tensor]:
    """Splits to begin with: by direction, by distance from an image, every other image,
    and by number.
    """
    ways = torch.from_numpy(even_directions(STARTS)).float()
    along = observed.directions @ ways.T
    for share in (0.5, 0.8):
        yield from (along > along.quantile(share, dim=0)).T
    away = observed.separation[_far_apart(observed.separation, CENTRES)]
    for share in (0.25, 0.4):
        yield from away < away.quantile(share, dim=1, keepdim=True)
    numbers = torch.arange(len(along))
    yield numbers % 2 == 0
    yield numbers < len(along) / 2


def _far_apart(separation: Tensor, count: int) -> list[int]:
    """Images, each of which is as far from those before it as any."""
    chosen = [0]
    while len(chosen) < min(count, len(separation)):
        chosen.append(int(separation[chosen].min(0).values.argmax()))
    return chosen


def _distinct(splits: Iterator[Tensor | None]) -> list[Tensor]:
    """Each split once, whichever group is called the smaller one."""
    found: dict[tuple[bool, ...], Tensor] = {}
    for split in splits:
        if split is not None:
            side = split ^ split[0]
            found[tuple(side.tolist())] = side
    return list(found.values())


def _some(observed: Observations, count: int) -> Observations:
    """The observations of some points."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.randperm(observed.seen.shape[1], generator=generator)[:count]
    return dataclasses.replace(
        observed, colours=observed.colours[:, rows], seen=observed.seen[:, rows]
    )


def _noise(observed: Observations) -> Tensor:
    """(P,) median difference of an image to the nearest one that sees a point, too."""
    order = observed.separation.argsort(1)
    differences = torch.full(observed.seen.shape, torch.nan)
    for rank in range(1, min(1 + NEIGHBOURS, len(order))):
        other = order[:, rank]
        both = observed.seen & observed.seen[other] & differences.isnan()
        change = (observed.colours - observed.colours[other]).abs().mean(-1)
        differences = torch.where(both, change, differences)
    return torch.nanmedian(differences, 0).values.nan_to_num(nan=CAP)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Costs:
    """How much V images contradict two groups."""

    first: Tensor  # (V,)
    second: Tensor  # (V,)
    seen: Tensor  # (V,) weight of the points that an image sees
    weights: Tensor  # (P,)

    @property
    def scores(self) -> Tensor:
        """(V,) in [-1, 1], positive where an image belongs to the first group."""
        both = self.first + self.second
        return (self.second - self.first) / both.clamp(min=1e-9)


def _costs(
    observed: Observations, group: Tensor, noise: Tensor, is_weighted: bool
) -> _Costs:
    """The costs of a group, the first, and of all others; weights are larger where the
    groups differ by more than noise.
    """
    weights, medians = _medians(observed, group, noise, is_weighted)
    weight = observed.seen * weights
    costs = [(_departure(observed, median) * weight).sum(1) for median in medians]
    return _Costs(first=costs[0], second=costs[1], seen=weight.sum(1), weights=weights)


def _medians(
    observed: Observations, group: Tensor, noise: Tensor, is_weighted: bool
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """(P,) weights, and the median colours of a group and of all others."""
    weights = torch.ones(observed.seen.shape[1])
    medians = []
    for members in (group, ~group):
        seen = observed.seen[members]
        medians.append(median_of(observed.colours[members], seen).nan_to_num())
        weights = weights * (seen.sum(0) >= LEAST_SEEN)
    if is_weighted:
        gap = (medians[0] - medians[1]).abs().mean(-1)
        weights = weights * gap / (gap + 2 * noise + NOISE)
    return weights, (medians[0], medians[1])


def _departure(observed: Observations, median: Tensor) -> Tensor:
    """(V, P) sRGB by which images depart from the colour of each point, up to a cap."""
    return (observed.colours - median).abs().mean(-1).clamp(max=CAP)


def _alternated(
    observed: Observations, group: Tensor, noise: Tensor, is_weighted: bool
) -> Tensor | None:
    """The split in which every image is in the group that it contradicts less; None
    where a group has run empty.
    """

    def moved(group: Tensor) -> Tensor:
        costs = _costs(observed, group, noise, is_weighted)
        return torch.where(costs.seen > 0, costs.first < costs.second, group)

    return _settled(group, moved, ROUNDS)


def _settled(
    group: Tensor, moved: Callable[[Tensor], Tensor], rounds: int
) -> Tensor | None:
    """A group after moves, until none changes it; None where one of the two has run
    empty.
    """
    for _ in range(rounds):
        after = moved(group)
        if min(int(after.sum()), int((~after).sum())) < LEAST_SEEN:
            return None
        if torch.equal(after, group):
            break
        group = after
    return group


def _neighbourhood(observed: Observations) -> Tensor:
    """(V, V) positive between an image and its nearest ones; rows are as large as those
    of a normalised graph.
    """
    apart = observed.separation + torch.eye(len(observed.separation)) * 1e9
    count = min(AGREEING, len(apart) - 1)
    nearest = apart.topk(count, dim=1, largest=False).indices
    edges = torch.zeros_like(apart).scatter_(1, nearest, 1.0)
    edges = torch.maximum(edges, edges.T)
    scale = edges.sum(1).rsqrt()
    return scale[:, None] * edges * scale


def _aligned(
    observed: Observations, group: Tensor, noise: Tensor, near: Tensor
) -> Tensor | None:
    """The split in which images that show the same points alike, and neighbours, are on
    one side; None where a group has run empty.

    Which images of a part belong together follows from the points that they share. If
    two parts share hardly any, then the larger number of neighbours that agree decides
    which groups of theirs are one.
    """

    def moved(group: Tensor) -> Tensor:
        shown = _shown(observed, group, noise)
        alike = shown @ shown.T
        alike.fill_diagonal_(0.0)
        evidence = alike.abs().sum(1)
        evidence = evidence + LITTLE * evidence.median() + 1e-9
        alike = alike / (evidence[:, None] * evidence).sqrt()
        graph = (alike + AGREEMENT * near).double()
        sides: Tensor = torch.linalg.eigh(graph).eigenvectors[:, -1] > 0
        is_turned = int((sides ^ group).sum()) * 2 > len(group)
        return ~sides if is_turned else sides

    return _settled(group, moved, ALIGNMENTS)


def _shown(observed: Observations, group: Tensor, noise: Tensor) -> Tensor:
    """(V, P) by how much each image shows each point as a group does rather than as all
    others do.
    """
    weights, medians = _medians(observed, group, noise, True)
    first, second = (_departure(observed, median) for median in medians)
    return (second - first) * observed.seen * weights.sqrt()


def _measured(observed: Observations, group: Tensor, noise: Tensor) -> Split | None:
    """What a split is worth; None where too few images are decided."""
    costs = _costs(observed, group, noise, True)
    evidence = costs.seen / costs.seen.median().clamp(min=1e-9)
    scores = costs.scores * evidence.clamp(max=1)
    decided = (evidence > UNDECIDED) & (costs.scores.abs() > UNDECIDED)
    if int((group & decided).sum()) > int((~group & decided).sum()):
        group = ~group
        scores = -scores
    decided &= group == (scores > 0)
    members = group & decided
    if int(members.sum()) < LEAST_SEEN:
        return None
    usual = float(scores[members].median())
    named = members & (scores > TYPICAL * usual)
    own = (costs.first - costs.second).abs()
    split = Split(
        smaller=named,
        decided=named | (decided & ~group),
        scores=scores,
        gain=float(own.sum() / observed.seen.sum()),
    )
    edge = _edge(observed, costs.weights, group, decided)
    if edge is None:
        return split
    named = _reached(observed, named, edge.compared)
    if int(named.sum()) < LEAST_SEEN:
        return None
    is_unclear = split.smaller & ~named
    split = dataclasses.replace(
        split,
        smaller=named,
        decided=named | (decided & ~group),
        scores=torch.where(is_unclear, scores.clamp(max=0), scores),
        edge=edge.ratio,
        difference=edge.difference,
        pair=edge.pair,
    )
    return _stepped(observed, split, group, noise) if edge.ratio > 1 else split


def _reached(observed: Observations, group: Tensor, compared: Tensor) -> Tensor:
    """(V,) the images of a group to which neighbours in it lead from an image that was
    compared with one of the other group.
    """
    near = observed.separation <= SPACINGS * _spacing(observed)
    reached = torch.zeros_like(group)
    reached[compared] = True
    reached &= group
    while True:
        further = group & near[reached].any(0)
        if torch.equal(further, reached):
            return reached
        reached = further


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pairs:
    """Images of the two groups that were taken side by side, and for each pair those of
    one group that are as far apart.
    """

    across: Tensor  # (K, 2)
    within: Tensor  # (K, L, 2)


def _pairs(observed: Observations, group: Tensor, known: Tensor) -> _Pairs | None:
    """The pairs among those that are known, (V, V) bool; None where they are few."""
    once = known & torch.ones_like(known).triu(1)
    is_same = group[:, None] == group[None]
    separation = observed.separation
    across = (once & ~is_same & (separation < _beside(observed))).nonzero()
    within = (once & is_same).nonzero()
    if min(len(across), len(within)) < LEAST_PAIRS:
        return None
    gaps = separation[across[:, 0], across[:, 1]]
    count = min(len(gaps), max(LEAST_PAIRS, round(NEAREST * len(gaps))))
    nearest = gaps.argsort()[:count]
    usual = separation[within[:, 0], within[:, 1]]
    count = min(ALIKE, len(within))
    other = (gaps[nearest, None] - usual[None]).abs().topk(count, 1, largest=False)
    return _Pairs(across=across[nearest], within=within[other.indices])


def _beside(observed: Observations) -> float:
    """Separation up to which two images are side by side: further apart in a set whose
    images are all far apart.
    """
    return max(BESIDE, SPACINGS * _spacing(observed))


def _spacing(observed: Observations) -> float:
    """The median separation of an image and the nearest one."""
    alone = torch.eye(len(observed.separation)) * 1e9
    nearest = (observed.separation + alone).min(1).values
    return float(nearest.median())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Edge:
    """How much images side by side differ across the groups."""

    ratio: float  # `Split.edge`
    difference: float
    pair: tuple[int, int]
    compared: Tensor  # (N,) numbers of images that differ so much


def _edge(
    observed: Observations, weights: Tensor, group: Tensor, decided: Tensor
) -> _Edge | None:
    """What is known of images side by side; None where they are few."""
    apart = _differences(observed, weights)
    known = ~apart.isnan() & decided[:, None] & decided[None]
    pairs = _pairs(observed, group, known)
    if pairs is None:
        return None
    differences = apart[tuple(pairs.across.T)]
    usual = float(apart[tuple(pairs.within.movedim(-1, 0))].mean())
    usually = float(differences.quantile(LOWER))
    best = pairs.across[differences.argmax()].tolist()
    one, other = sorted(best, key=lambda number: not bool(group[number]))
    return _Edge(
        ratio=usually / (usual + FLOOR),
        difference=usually - usual,
        pair=(one, other),
        compared=pairs.across[differences > (usually + usual) / 2].flatten(),
    )


def _stepped(
    observed: Observations, split: Split, group: Tensor, noise: Tensor
) -> Split:
    """A split with `step`, `spread` and `opposed`."""
    places, evidence = _places(observed, group, noise)
    sees = evidence > SEES * evidence[split.smaller].median()
    opposed = int((~group & sees & (places < -CLEAR)).sum())
    evident = evidence > UNDECIDED * evidence.median()
    pairs = _pairs(observed, group, evident[:, None] & evident[None])
    if pairs is None:
        return dataclasses.replace(split, opposed=opposed)
    first, second = places[pairs.across].unbind(-1)
    is_first = group[pairs.across[:, 0]]
    steps = torch.where(is_first, first - second, second - first)
    one, other = places[pairs.within].unbind(-1)
    spread = float((one - other).abs().mean())
    return dataclasses.replace(
        split, step=float(steps.mean()), spread=spread, opposed=opposed
    )


def _places(
    observed: Observations, group: Tensor, noise: Tensor
) -> tuple[Tensor, Tensor]:
    """(V,) where each image lies on the way from the colours of one group, -0.5, to
    those of the other, 0.5, and the weight of the points that say so.

    The colours of its own group are those of its other images, so that no image agrees
    with itself. The mean over all points removes the noise of each.
    """
    own = torch.zeros_like(observed.colours)
    other = torch.zeros_like(own)
    weight = observed.seen.float()
    for members in (group, ~group):
        colours = observed.colours[members]
        seen = observed.seen[members]
        count = seen.sum(0)
        ordered = torch.where(seen[..., None], colours, torch.inf).sort(0).values
        own[members] = _middle_of_others(ordered, count, colours)
        other[~members] = _middle(ordered, count)
        weight *= (count >= LEAST_SEEN).float()
    step = torch.where(group[:, None, None], own - other, other - own)
    step = torch.where(weight[..., None] > 0, step, 0.0)
    departure = torch.where(weight[..., None] > 0, own + other, 0.0) / 2
    squared = step.square().sum(-1)
    along = ((observed.colours - departure) * step).sum(-1)
    along = (along / squared.clamp(min=1e-6)).clamp(-1, 1)
    gap = step.abs().mean(-1)
    weight *= gap / (gap + 2 * noise + NOISE)
    share = weight * squared.sqrt()
    return (along * share).sum(1) / share.sum(1).clamp(min=1e-9), weight.sum(1)


def _ranked(ordered: Tensor, rank: Tensor) -> Tensor:
    """(P, 3) the colours of a rank of each point, of (V, P, 3) that are in order."""
    index = rank.clamp(0, len(ordered) - 1)[None, :, None].expand(1, -1, 3)
    return ordered.gather(0, index)[0]


def _middle(ordered: Tensor, count: Tensor) -> Tensor:
    """(P, 3) the median of the first `count` colours of each point."""
    return (_ranked(ordered, (count - 1) // 2) + _ranked(ordered, count // 2)) / 2


def _middle_of_others(ordered: Tensor, count: Tensor, colours: Tensor) -> Tensor:
    """(V, P, 3) the same, without the colour of each image itself."""
    total = torch.zeros_like(colours)
    for rank in ((count - 2) // 2, (count - 1) // 2):
        here = _ranked(ordered, rank)
        total += torch.where(colours <= here, _ranked(ordered, rank + 1), here)
    return total / 2


def _differences(observed: Observations, weights: Tensor) -> Tensor:
    """(V, V) weighted difference of what two images show of the points that both see,
    above the diagonal; NaN below it, and where these points are few.
    """
    kept = weights > 0.1
    colours = observed.colours[:, kept]
    weight = observed.seen[:, kept] * weights[kept]
    total = weight.sum(1)
    result = torch.full((len(total), len(total)), torch.nan)
    for index in range(len(total) - 1):
        rows = weight[index] > 0
        later = slice(index + 1, None)
        shared = weight[later, rows] * (weight[index, rows] > 0)
        change = (colours[later, rows] - colours[index, rows]).abs().mean(-1)
        both = shared.sum(1)
        enough = both > SHARED * torch.minimum(total[later], total[index])
        mean = (change.clamp(max=2 * CAP) * shared).sum(1) / both.clamp(min=1e-9)
        result[index, later] = torch.where(enough & (both > 0), mean, torch.nan)
    return result
