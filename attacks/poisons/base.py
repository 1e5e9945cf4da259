"""What every attack on training images is: images in, images out, and the victim
trains as ever.

A poison is a function. It takes views and a seed, and gives the same cameras with some
images replaced, together with a manifest that says which and how. CLOAK
(`attacks.cloak.poisoning.poison`), Poison-splat and M-IFGSM (beside this module) are
three of them. Training and judging, which come after, are shared.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol, overload

import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera, View, ViewSet, cameras_of
from mi_splat.errors import InvalidValueError, one_line
from mi_splat.training.evaluation import loss_mask_of

OnStep = Callable[[int, int], None]
"""Called after each image, or each step, with the number finished and the number
wanted.
"""

Masks = Sequence[Tensor] | Callable[[Camera], Tensor]
"""(H, W) bool masks of the target: one for each view, or a function of the camera (such
as `MeshScene.mask`).
"""

_ROUNDING = 1e-3
"""By how much of a step of 1/255 an image of 8 bits may differ from whole steps in
float32.
"""
MANIFEST = "poison.json"
"""What was changed in a poisoned set; it stands beside the set, of which a victim knows
nothing more.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """What was done to one view."""

    index: int  # position of the view
    pixels: int  # pixels in the image
    pixels_changed: int  # pixels of which a channel has another value
    largest: float  # largest difference of a channel, sRGB in [0, 1]
    # of the untouched image: its float32 values, little-endian, row by row
    sha256_before: str
    sha256_after: str  # of the new image

    @classmethod
    def between(cls, index: int, before: View, after: View, **more: Any) -> Change:
        """The change of a view, and what else a kind of poison says of it."""
        difference = (before.image - after.image).abs().amax(-1)
        return cls(
            index=index,
            pixels=difference.numel(),
            pixels_changed=int((difference > 0).sum()),
            largest=float(difference.max()),
            sha256_before=_digest(before.image),
            sha256_after=_digest(after.image),
            **more,
        )


def footprint_of(manifest: Mapping[str, Any]) -> tuple[int, int, float]:
    """What a manifest says of the size of a poison, for images of one size.

    Args:
        manifest: As `Poisoned.manifest`, or read from `MANIFEST`.

    Returns:
        Number of images of which a pixel is changed, number of all images, and the
        fraction of all their pixels that is changed.
    """
    changes = [change for change in manifest["changes"] if change["pixels_changed"]]
    count = int(manifest["views"])
    shares = [change["pixels_changed"] / change["pixels"] for change in changes]
    return len(changes), count, sum(shares) / max(1, count)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PoisonedViews(ViewSet):
    """A set of views with some replaced; the others are the very objects that the set
    gives, read when asked for.
    """

    untouched: Sequence[View]  # the set
    replaced: Mapping[int, View]  # new views by position

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The camera of each view; poisoning leaves them as they are."""
        return cameras_of(self.untouched)

    def loss_mask(self, index: int) -> Tensor | None:
        """(H, W) in [0, 1], 1 where the image of a view counts; as in the set."""
        return loss_mask_of(self.untouched, index)

    def __len__(self) -> int:
        """Number of views."""
        return len(self.untouched)

    @overload
    def __getitem__(self, index: int) -> View: ...

    @overload
    def __getitem__(self, index: slice) -> list[View]: ...

    def __getitem__(self, index: int | slice) -> View | list[View]:
        """A view, or a list of some."""
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        index = range(len(self))[index]
        if index in self.replaced:
            return self.replaced[index]
        return self.untouched[index]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Poisoned:
    """A poisoned set."""

    views: PoisonedViews  # as many as the untouched set has, in its order
    # every view that was replaced, in the order of positions
    changes: tuple[Change, ...]
    # what was asked for, as JSON can hold it, with its `kind`
    poison: Mapping[str, Any]

    def __repr__(self) -> str:
        kind = one_line(str(self.poison.get("kind", "")), 40)
        return (
            f"Poisoned({kind}: {len(self.changes)} of {len(self.views)} views changed)"
        )

    @property
    def manifest(self) -> dict[str, Any]:
        """Everything that was done, as JSON can hold it."""
        changes = [asdict(change) for change in self.changes]
        return {
            "views": len(self.views),
            "changed": len(changes),
            **self.poison,
            "changes": changes,
        }


class ImagePoison(Protocol):
    """An attack on training images."""

    def __call__(
        self, views: Sequence[View], *, seed: int = 0, on_step: OnStep | None = None
    ) -> Poisoned:
        """The poisoned set; the untouched one stays as it is.

        Args:
            views: The untouched set; images are (H, W, 3) sRGB in [0, 1].
            seed: Of everything random.
            on_step: Told of the progress.
        """
        ...


def poisoned(
    views: Sequence[View], pictures: Mapping[int, Tensor], poison: Mapping[str, Any]
) -> Poisoned:
    """A set in which some images are replaced."""
    replaced = {}
    changes = []
    for index in sorted(pictures):
        before = views[index]
        replaced[index] = View(
            before.camera,
            checked_picture(pictures[index], before, f"image for view {index}"),
        )
        changes.append(Change.between(index, before, replaced[index]))
    return Poisoned(
        views=PoisonedViews(views, replaced), changes=tuple(changes), poison=poison
    )


def checked_picture(picture: Tensor, before: View, what: str) -> Tensor:
    """A copy of a new image, of the kind of the one that it takes the place of."""
    image = picture.detach().to(before.image).clone()
    if image.shape != before.image.shape:
        expected = f"shape {tuple(before.image.shape)}"
        got = tuple(image.shape)
        raise InvalidValueError.of(
            what, expected, got, "return an image of the view's size"
        )
    low = float(image.min())
    high = float(image.max())
    if not (low >= 0 and high <= 1):  # nor NaN
        raise InvalidValueError.of(
            what, "sRGB in [0, 1]", f"{low:.4g} to {high:.4g}", "clip it"
        )
    return image


def within_ball(image: Tensor, clean: Tensor, eps: int | None) -> Tensor:
    """An image of 8 bits that is nowhere further from the clean one than the ball
    allows.

    It is clipped in whole steps of 1/255: a file of 8 bits holds it exactly, and it
    stays in the ball there, too, even where the clean image lies between two steps.
    """
    steps = (image.detach().clamp(0, 1) * 255).round()
    middle = clean.to(image) * 255
    eps = 255 if eps is None else eps
    steps = steps.clamp(
        (middle - eps - _ROUNDING).ceil(), (middle + eps + _ROUNDING).floor()
    )
    return steps.clamp(0, 255) / 255


def ball(clean: Tensor, eps: int | None) -> tuple[Tensor, Tensor]:
    """The lowest and the highest image that a ball of so many steps of 1/255 allows;
    None is no ball.
    """
    radius = 1.0 if eps is None else eps / 255
    return (clean - radius).clamp(min=0), (clean + radius).clamp(max=1)


def sign_steps(
    start: Tensor,
    within: tuple[Tensor, Tensor],
    loss: Callable[[Tensor], Tensor],
    *,
    steps: int,
    step: Tensor | float,
) -> Tensor:
    """An image after steps along the sign of the gradient of a loss, each clipped to
    what is allowed.
    """
    (low, high), picture = within, start.detach()
    for _ in range(steps):
        picture = picture.detach().requires_grad_(True)
        (gradient,) = torch.autograd.grad(loss(picture), picture)
        picture = torch.minimum(
            torch.maximum(picture.detach() + step * gradient.sign(), low), high
        )
    return picture.detach()


def chosen_views(views: Sequence[View], share: float, seed: int) -> list[int]:
    """Positions of the images to change, rising; those of a smaller share are among
    those of a larger.
    """
    if not len(views):
        raise InvalidValueError.of(
            "views", "at least one", "none", "capture views first"
        )
    order = torch.randperm(
        len(views), generator=torch.Generator().manual_seed(seed)
    ).tolist()
    return sorted(order[: round(share * len(views))])


def check_masks(masks: Masks | None, views: int) -> None:
    """Raise unless there is a mask for each view."""
    if masks is not None and not callable(masks) and len(masks) != views:
        raise InvalidValueError.of(
            "masks", f"one for each of {views} views", len(masks), "pass them all"
        )


def mask_of(masks: Masks | None, index: int, camera: Camera) -> Tensor:
    """(H, W) bool mask of one view; None masks everything."""
    size = (camera.height, camera.width)
    if masks is None:
        return torch.ones(size, dtype=torch.bool)
    mask = masks(camera) if callable(masks) else masks[index]
    if tuple(mask.shape) != size or mask.dtype != torch.bool:
        got = f"{mask.dtype} of shape {tuple(mask.shape)}"
        raise InvalidValueError.of(
            f"mask of view {index}",
            f"bool of shape {size}",
            got,
            "make it fit the view",
        )
    return mask


def _digest(image: Tensor) -> str:
    values = image.detach().to("cpu").float().contiguous().numpy().astype("<f4")
    return hashlib.sha256(values.tobytes()).hexdigest()
