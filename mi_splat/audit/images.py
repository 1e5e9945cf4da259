"""Images before any training: do they fall into two groups that contradict each other?

Points are looked up in all images. From many starting splits of the images into two
groups, the median colour of each point in each group and the group that each image
contradicts less are found in turn, until nothing changes. Honest images fall into two
groups, too, because gloss and light change with the direction. Their colours then
change gradually, whereas poisoned images differ from honest ones right beside them.
"""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from mi_splat.audit.observations import Observations, median_of, observe
from mi_splat.cameras.framing import near_plane
from mi_splat.datasets import Dataset
from mi_splat.errors import InvalidValueError
from mi_splat.maths.sh import even_directions
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.training.config import FitConfig
from mi_splat.training.initialization import random_points, thinned
from mi_splat.training.loop import Progress, fit
from mi_splat.training.strategies import FixedConfig

# called after each step of a training with its number and the number of all
OnStep = Callable[[int, int], None]
ImageVerdict = Literal["two groups", "nothing found", "not judged"]
Group = Literal["A", "B"]

POINTS = 2500  # compared
FIRST_POINTS = 800  # of which the starting splits see
STARTS = 16  # directions from which images are split in two ways each
CAP = 0.15  # sRGB above which a larger difference counts no more
ROUNDS = 20
LEAST_SEEN = 2  # images of a group that have to see a point
NOISE = 0.02  # sRGB by which honest images differ
NEIGHBOURS = 8  # nearest images in which the noise of a point is looked for
UNDECIDED = 0.15
"""Share of the usual evidence, and difference of the two costs in their sum, below
which an image belongs to neither group.
"""
LEAST_IMAGES = 12
SIDE = 400  # pixels of the longer side of images that are compared, twice at most
MOST_POINTS = 20_000  # of the cloud
OBSERVED = 1_000_000  # points in images, so that memory is bounded
SURFACE_STEPS = 600
SURFACE_GAUSSIANS = 8000
SURFACE_SIDE = 96  # pixels
SOLID = 0.3  # opacity of a Gaussian on a surface
CALLED = 0.03  # strength from which two groups contradict each other
EQUAL = 0.95  # share of the larger group from which the smaller is as large
LEAST_POINTS = 50
BESIDE = 0.5  # separation up to which two images are side by side
NEAREST = 0.15  # share of these pairs, the nearest, that say how sharp the edge is
LEAST_PAIRS = 4
ALIKE = 15  # pairs of one group as far apart, with which each is compared
FLOOR = 0.01  # sRGB that images of one group differ by at least
SHARED = 0.3  # of what an image sees, that another has to see to be compared with it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Split:
    """Two groups of V images, and how much they contradict each other."""

    smaller: Tensor  # (V,) bool, images of the smaller group; the others are the larger
    decided: Tensor  # (V,) bool, images that see enough to belong to one of the two
    # (V,) in [-1, 1], by how much less an image contradicts the smaller group
    scores: Tensor
    # 20 % quantile over the smaller group of its images' scores
    sharpness: float
    # sRGB by which an image differs less from its own group than from the other, in the
    # mean over all points that it sees
    gain: float
    # difference of images of the two groups that were taken side by side, by that of
    # images of one group that are as far apart
    edge: float
    difference: float  # sRGB of the former less that of the latter
    pair: tuple[int, int] | None  # images side by side, of the smaller and the larger

    @property
    def strength(self) -> float:
        """What splits are compared by."""
        return self.edge * self.sharpness * self.gain


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageAudit:
    """Whether the images of a set contradict each other, and which contradict which.

    Which of the two groups shows the truth, the images cannot tell.

    Attributes:
        count: Number of images, V.
        points: Number of points that were compared, each side of one by itself.
        split: The two groups that contradict each other most; None where images share
            too little.
    """

    count: int
    points: int
    split: Split | None

    @property
    def verdict(self) -> ImageVerdict:
        """Whether two groups contradict each other."""
        if self.split is None:
            return "not judged"
        if self.split.strength < CALLED:
            return "nothing found"
        return "two groups"

    @property
    def groups(self) -> tuple[Tensor, Tensor]:
        """(V,) bool each, the larger group A and the smaller group B; empty unless two
        contradict each other. An image may belong to neither.
        """
        nobody = torch.zeros(self.count, dtype=torch.bool)
        if self.split is None or self.verdict != "two groups":
            return nobody, nobody
        smaller = self.split.smaller
        return self.split.decided & ~smaller, smaller

    @property
    def is_nearly_equal(self) -> bool:
        """Whether neither group is larger than the other by much."""
        larger, smaller = (int(group.sum()) for group in self.groups)
        return smaller > EQUAL * larger

    def left_out(self, trusted: Group) -> Tensor:
        """(V,) bool, the images of the group that is not trusted."""
        larger, smaller = self.groups
        if trusted == "A":
            return smaller
        return larger


def audit_images(views: Dataset, *, on_step: OnStep | None = None) -> ImageAudit:
    """Find the two groups of images that contradict each other most.

    What the images show of the same points is compared: the points of the set, or where
    it has none, those of a small splat that is trained on it. Nothing but the set is
    used, so it stays unknown which group is true.

    Args:
        views: The set; every image is compared.
        on_step: Called after each step of the training of a small splat.

    Returns:
        The groups, and how much they contradict each other.

    Raises:
        InvalidValueError: There are fewer images than `LEAST_IMAGES`.
    """
    if len(views) < LEAST_IMAGES:
        do = "take more images of the scene, or audit a splat that was trained on them"
        raise InvalidValueError.of("images", f"at least {LEAST_IMAGES}", len(views), do)
    if views.points is None or len(views.points) < LEAST_POINTS:
        cloud = surface_points(views, on_step=on_step)
    else:
        cloud = thinned(views.points, MOST_POINTS).points
    small = smaller_images(views, SIDE)
    most = max(LEAST_POINTS, min(POINTS, OBSERVED // len(views)))
    observed = observe(small, cloud, most=most)
    points = observed.seen.shape[1]
    return ImageAudit(count=len(views), points=points, split=split_images(observed))


def smaller_images(views: Dataset, side: int) -> Dataset:
    """The set with images reduced as far as their longer side keeps so many pixels."""
    longer = max(max(camera.width, camera.height) for camera in views.cameras)
    factor = views.downscale * max(1, longer // side)
    return dataclasses.replace(views, downscale=factor)


def surface_points(views: Dataset, *, on_step: OnStep | None = None) -> Tensor:
    """(N, 3) where the surface is, by a small splat that is trained on the images."""
    small = smaller_images(views, SURFACE_SIDE)
    start = random_points(small, SURFACE_GAUSSIANS)
    schedule = FitConfig(
        iterations=SURFACE_STEPS,
        sh_degree_interval=SURFACE_STEPS // 6,
        lr_sh_divisor=20,
        eval_interval=0,
    )
    config = dataclasses.replace(schedule, strategy=FixedConfig(), lambda_dssim=0.0)
    near = near_plane(start, small.cameras)
    render = Renderer(RenderSettings(background=small.background, near=near))
    report = None
    if on_step is not None:
        tell = on_step

        def report(line: Progress) -> None:
            tell(line.iteration, SURFACE_STEPS)

    scene = fit(small, start, render=render, config=config, on_step=report).scene
    return scene.means[scene.opacities > SOLID]


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
    splits = [_measured(observed, smaller, noise) for smaller in found]
    judged = [split for split in splits if split is not None]
    return max(judged, key=lambda split: split.strength, default=None)


def _starts(observed: Observations) -> Iterator[Tensor]:
    """Splits to begin with: by direction, every other image, and by number."""
    ways = torch.from_numpy(even_directions(STARTS)).float()
    along = observed.directions @ ways.T
    for share in (0.5, 0.8):
        yield from (along > along.quantile(share, dim=0)).T
    numbers = torch.arange(len(along))
    yield numbers % 2 == 0
    yield numbers < len(along) / 2


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
    weights = torch.ones(observed.seen.shape[1])
    medians = []
    for members in (group, ~group):
        seen = observed.seen[members]
        medians.append(median_of(observed.colours[members], seen).nan_to_num())
        weights = weights * (seen.sum(0) >= LEAST_SEEN)
    if is_weighted:
        gap = (medians[0] - medians[1]).abs().mean(-1)
        weights = weights * gap / (gap + 2 * noise + NOISE)
    weight = observed.seen * weights
    costs = [
        ((observed.colours - median).abs().mean(-1).clamp(max=CAP) * weight).sum(1)
        for median in medians
    ]
    return _Costs(first=costs[0], second=costs[1], seen=weight.sum(1), weights=weights)


def _alternated(
    observed: Observations, group: Tensor, noise: Tensor, is_weighted: bool
) -> Tensor | None:
    """The split in which every image is in the group that it contradicts less; None
    where a group has run empty.
    """
    for _ in range(ROUNDS):
        costs = _costs(observed, group, noise, is_weighted)
        moved = torch.where(costs.seen > 0, costs.first < costs.second, group)
        if min(int(moved.sum()), int((~moved).sum())) < LEAST_SEEN:
            return None
        if torch.equal(moved, group):
            break
        group = moved
    return group


def _measured(observed: Observations, group: Tensor, noise: Tensor) -> Split | None:
    """What a split is worth; None where too few images are decided."""
    costs = _costs(observed, group, noise, True)
    evidence = costs.seen / costs.seen.median().clamp(min=1e-9)
    scores = costs.scores * evidence.clamp(max=1)
    decided = (evidence > UNDECIDED) & (costs.scores.abs() > UNDECIDED)
    if int((group & decided).sum()) > int((~group & decided).sum()):
        group = ~group
        scores = -scores
    named = group & decided
    if int(named.sum()) < LEAST_SEEN:
        return None
    own = (costs.first - costs.second).abs()
    edge = _edge(observed, costs.weights, group, decided)
    return Split(
        smaller=named,
        decided=decided,
        scores=scores,
        sharpness=float(costs.scores.abs()[named].quantile(0.2)),
        gain=float(own.sum() / observed.seen.sum()),
        edge=edge[0],
        difference=edge[1],
        pair=edge[2],
    )


def _edge(
    observed: Observations, weights: Tensor, group: Tensor, decided: Tensor
) -> tuple[float, float, tuple[int, int] | None]:
    """`Split.edge`, `difference` and `pair`."""
    apart = _differences(observed, weights)
    known = ~apart.isnan() & decided[:, None] & decided[None]
    known &= torch.ones_like(known).triu(1)
    is_same = group[:, None] == group[None]
    across = (known & ~is_same & (observed.separation < BESIDE)).nonzero()
    within = (known & is_same).nonzero()
    if min(len(across), len(within)) < LEAST_PAIRS:
        return 0.0, 0.0, None
    gaps = observed.separation[across[:, 0], across[:, 1]]
    count = min(len(gaps), max(LEAST_PAIRS, round(NEAREST * len(gaps))))
    across = across[gaps.argsort()[:count]]
    gaps = observed.separation[across[:, 0], across[:, 1]]
    usual_gaps = observed.separation[within[:, 0], within[:, 1]]
    count = min(ALIKE, len(within))
    alike = (gaps[:, None] - usual_gaps[None]).abs().topk(count, 1, largest=False)
    differences = apart[across[:, 0], across[:, 1]]
    usual = apart[within[:, 0], within[:, 1]][alike.indices].mean()
    best = across[differences.argmax()].tolist()
    one, other = sorted(best, key=lambda number: not bool(group[number]))
    mean = float(differences.mean())
    return mean / (float(usual) + FLOOR), mean - float(usual), (one, other)


def _differences(observed: Observations, weights: Tensor) -> Tensor:
    """(V, V) weighted difference of what two images show of the points that both see;
    NaN where these are few.
    """
    kept = weights > 0.1
    colours = observed.colours[:, kept]
    weight = observed.seen[:, kept] * weights[kept]
    total = weight.sum(1)
    result = torch.full((len(total), len(total)), torch.nan)
    for index in range(len(total)):
        rows = weight[index] > 0
        shared = weight[:, rows] * (weight[index, rows] > 0)
        change = (colours[:, rows] - colours[index, rows]).abs().mean(-1)
        both = shared.sum(1)
        enough = both > SHARED * torch.minimum(total, total[index])
        mean = (change.clamp(max=2 * CAP) * shared).sum(1) / both.clamp(min=1e-9)
        result[index] = torch.where(enough & (both > 0), mean, torch.nan)
    return result
