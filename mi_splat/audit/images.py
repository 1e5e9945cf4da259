"""Images before any training: do they fall into two groups that contradict each other?

Points are looked up in all images, and the images are split into the two groups that
contradict each other most. Honest images fall into two
groups, too, because gloss and light change with the direction. Their colours then
change gradually, whereas poisoned images differ from honest ones right beside them.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from mi_splat.audit.image_splits import LEAST_POINTS, Split, beneath, split_images
from mi_splat.audit.observations import Observations, observe
from mi_splat.cameras.framing import near_plane
from mi_splat.datasets import Dataset
from mi_splat.errors import InvalidValueError
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
LEAST_IMAGES = 12
SIDE = 400  # pixels of the longer side of images that are compared, twice at most
MOST_POINTS = 20_000  # of the cloud
OBSERVED = 1_000_000  # points in images, so that memory is bounded
SURFACE_STEPS = 600
SURFACE_GAUSSIANS = 8000
SURFACE_SIDE = 96  # pixels
SOLID = 0.3  # opacity of a Gaussian on a surface
CALLED = 0.005  # strength from which two groups contradict each other
FEW = 4  # images, and
FEW_SHARE = 0.125  # share of all, below which a group has to contradict the others more
FEW_CALLED = 0.015  # strength from which it does
AGREED = 0.75
"""Share of a group that similar splits have to agree on, below which none is named."""
LEAST_FURTHER = 4  # images of a group that is found without the first one
FURTHER_CALLED = 0.015  # strength from which a group is, found without the first one
FOUND_AGAIN = 0.5  # share of such a group that has to be found a second time
SEVERAL = 10  # images, from which a group is compared with all images of the other
OPPOSED = 0.5  # of the images that oppose a group with fewer, what it has at most
MORE = 2  # images by which the larger group has to be larger
EQUAL = 0.95  # share of the larger group from which the smaller is as large


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
        if not is_called(self.split):
            return "nothing found"
        if self.split.agreement < AGREED:
            return "not judged"
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
        """Whether neither group is larger than the other by much. Next to a group of a
        few, images that hardly see what is disputed belong to the larger one by chance,
        and do not count.
        """
        larger, smaller = (int(group.sum()) for group in self.groups)
        if self.split is not None and 0 < smaller < SEVERAL:
            return not _is_smaller(self.groups[1], self.split)
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
    return ImageAudit(count=len(views), points=points, split=called_groups(observed))


def called_groups(observed: Observations) -> Split | None:
    """The two groups that contradict each other most; as long as they contradict each
    other clearly, group B is joined by the one that is found without it.

    Cameras in front of an object and behind it share few points. Images that were
    poisoned on one side are then found first, and those of the other side next.
    """
    found = split_images(observed)
    if found is not None and not is_called(found):
        # light that differs between two parts of a set hides what is smaller
        observed = beneath(observed, found)
        deeper = split_images(observed)
        if deeper is not None and deeper.strength > found.strength:
            found = deeper
    if found is None or not is_called(found) or found.agreement < AGREED:
        return found
    rest = ~found.smaller
    while int(rest.sum()) >= LEAST_IMAGES:
        further = split_images(observed.of(rest))
        if further is None or not _is_further(further):
            break
        if not _is_found_again(observed, rest, further):
            break
        found = _joined(found, rest, further)
        rest = ~found.smaller
    return found


def _is_further(split: Split) -> bool:
    """Whether the smaller group of a split of what is left joins group B."""
    return (
        int(split.smaller.sum()) >= LEAST_FURTHER
        and split.strength >= FURTHER_CALLED
        and split.agreement >= AGREED
        and _is_smaller(split.smaller, split)
    )


def _is_found_again(observed: Observations, rest: Tensor, further: Split) -> bool:
    """Whether most of a further group is found without the images that hesitate.

    Where a few poisoned images remain among honest ones, those beside them would be
    named in their place.
    """
    hesitating = further.hesitating
    kept = rest.clone()
    kept[rest] = ~hesitating
    again = split_images(observed.of(kept))
    if again is None or not _is_further(again):
        return False
    both = again.smaller & further.smaller[~hesitating]
    return int(both.sum()) > FOUND_AGAIN * int(further.smaller.sum())


def is_called(split: Split) -> bool:
    """Whether the two groups contradict each other clearly. A few images may contradict
    all others because their cameras are wrong, or because a screen mirrors what is in
    front of it, so that a group of a few has to do so more.
    """
    named = int(split.smaller.sum())
    is_few = named < max(FEW, FEW_SHARE * len(split.smaller))
    return split.strength >= (FEW_CALLED if is_few else CALLED)


def _is_smaller(smaller: Tensor, split: Split) -> bool:
    """Whether clearly more images oppose a smaller group than it has."""
    named = int(smaller.sum())
    larger = int((split.decided & ~split.smaller).sum())
    if split.opposed is not None:
        larger = min(larger, split.opposed)
    most = min(EQUAL * larger, larger - MORE)
    if named < SEVERAL:
        most = OPPOSED * larger
    return named <= most


def _joined(found: Split, rest: Tensor, further: Split) -> Split:
    """A split whose smaller group also holds that of a split of the rest."""
    named = found.smaller.clone()
    named[rest] = further.smaller
    more = named & rest
    scores = found.scores.clone()
    scores[more] = further.scores[further.smaller]
    opposed = None
    if found.opposed is not None and further.opposed is not None:
        opposed = found.opposed + further.opposed
    return dataclasses.replace(
        found,
        smaller=named,
        decided=found.decided | more,
        scores=scores,
        opposed=opposed,
    )


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
