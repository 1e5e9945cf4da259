"""Appearances that retouch a picture: two controls, and the attack of who has nothing but pictures and masks.

A control damages the object without hiding it. If detectors miss a half faded or a blurred object as often as one that
was removed, it is damage that they fail on, and not the appearance that the attacker wants.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph, linalg
from torch import Tensor

from mi_splat.cameras import View
from mi_splat.errors import InvalidValueError

Doubles = NDArray[np.float64]
Indices = NDArray[np.int64]

BLUR_WIDTH = 0.04
"""Standard deviation of a blur, in longer sides of the object's box in the picture."""
HOLE_MARGIN = 3
"""Pixels by which the hole that is filled is wider than the mask: pixels at an outline show some of the object."""
TEXTURE = 0.3
"""Largest range of sRGB in 3 x 3 pixels that is taken for texture; where the sky ends, for instance, it is larger."""


def grown(mask: Tensor, pixels: int) -> Tensor:
    """(H, W) bool, a mask and everything within so many pixels of it, along rows and columns."""
    planes = mask[None, None].to(torch.float32)
    return torch.nn.functional.max_pool2d(planes, 2 * pixels + 1, stride=1, padding=pixels)[0, 0] > 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fade:
    """The object half transparent: the mean of the picture and of the one without it."""

    removed: Callable[[View, Tensor], Tensor]
    reach: int = 1
    name: str = "half transparent"

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The mean within reach of the object, the old picture elsewhere."""
        mean = (view.image + self.removed(view, mask)) / 2
        return torch.where(grown(mask, self.reach)[..., None], mean, view.image)


@dataclass(frozen=True, slots=True, kw_only=True)
class Blur:
    """The object out of focus, and what is near it less and less: no edge is left, not even that of the blur."""

    width: float = BLUR_WIDTH

    @property
    def name(self) -> str:
        """For manifests."""
        return f"blurred by {self.width:g} of its box"

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The picture; it stays as it is farther from the mask than `reach` pixels."""
        if not bool(mask.any()):
            return view.image
        sigma, near = self._sigma(mask), self._near(mask)
        soft = ndimage.gaussian_filter(grown(mask, near).double().cpu().numpy(), sigma, radius=near)
        colours = view.image.double().cpu().numpy()
        blurred = ndimage.gaussian_filter(colours, sigma, axes=(0, 1), mode="nearest")
        return torch.from_numpy(colours + soft[..., None] * (blurred - colours)).to(view.image).clamp(0, 1)

    def reach(self, mask: Tensor) -> int:
        """Pixels around a mask that change."""
        return 2 * self._near(mask)

    def _sigma(self, mask: Tensor) -> float:
        rows, columns = mask.nonzero().unbind(1)
        return self.width * (1 + max(int(axis.max() - axis.min()) for axis in (rows, columns)))

    def _near(self, mask: Tensor) -> int:
        """Two standard deviations: within them of the object, the picture is all but the blurred one."""
        return max(1, round(2 * self._sigma(mask)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Inpaint:
    """The object gone, by whoever has nothing but the picture and a mask: its place is `inpainted`."""

    reach: int = HOLE_MARGIN
    name: str = "inpainted"

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The picture with its hole filled."""
        return inpainted(view.image, grown(mask, self.reach))


def inpainted(picture: Tensor, hole: Tensor) -> Tensor:
    """(H, W, 3) with a hole filled from what is around it; nothing in the hole is read.

    "Poisson Image Editing" (Perez, Gangnet, Blake 2003), equation (7): the fill's differences between neighbours are
    those of the picture mirrored at the hole's edge, and its rim goes on with what is outside. Where the mirrored
    picture is torn, is no texture, or lies in the hole itself, the fill is as smooth as it can be. It knows nothing of
    shadows, and makes up nothing.
    """
    inside = hole.cpu().numpy()
    if inside.all():
        raise InvalidValueError.of(
            "hole to fill", "something around it", "the whole picture", "take it from farther away"
        )
    if not inside.any():
        return picture
    edge = ndimage.distance_transform_edt(inside, return_distances=False, return_indices=True)
    colours: Doubles = picture.double().cpu().numpy()[edge[0], edge[1]]  # the hole has those of its rim
    pairs, wanted = _guidance(colours, inside, edge)
    count, unknown, values = inside.size, inside.ravel(), colours.reshape(-1, 3)
    links = sparse.coo_array((np.ones(len(wanted)), pairs), shape=(count, count))
    rows = csgraph.laplacian(links + links.T).tocsr()[unknown]
    pull = np.stack([np.bincount(pairs[0], w, count) - np.bincount(pairs[1], w, count) for w in wanted.T], -1)
    known = rows[:, ~unknown] @ values[~unknown]
    values[unknown] = linalg.spsolve(rows[:, unknown].tocsc(), pull[unknown] - known)
    return torch.from_numpy(values.reshape(picture.shape)).to(picture).clamp(0, 1)


def _guidance(colours: Doubles, hole: NDArray[np.bool_], edge: Indices) -> tuple[Indices, Doubles]:
    """(2, N) numbers of pixels that lie side by side, and the (N, 3) difference that is wanted between them.

    Colours (H, W, 3) may be anything in the hole (H, W); `edge` is (2, H, W) row and column of the pixel outside of the
    hole that is nearest to each.
    """
    size = np.array(hole.shape)[:, None, None]
    mirror = 2 * edge - np.indices(hole.shape)
    taken = ((mirror >= 0) & (mirror < size)).all(0)
    mirror = mirror.clip(0, size - 1)
    padded = np.pad(colours, ((1, 1), (1, 1), (0, 0)), "edge")
    texture = np.ptp(sliding_window_view(padded, (3, 3), (0, 1)), (3, 4)).max(-1) < TEXTURE
    taken &= (texture & ~hole)[mirror[0], mirror[1]]

    number = np.arange(hole.size).reshape(hole.shape)
    beside, below = (number[:, :-1], number[:, 1:]), (number[:-1], number[1:])
    pairs = np.stack([np.concatenate([first.ravel(), two.ravel()]) for first, two in zip(beside, below, strict=True)])
    pixels, mirrored = mirror.reshape(2, -1)[:, pairs], colours[mirror[0], mirror[1]].reshape(-1, 3)[pairs]
    is_whole = taken.ravel()[pairs].all(0) & (np.abs(pixels[:, 0] - pixels[:, 1]).max(0) <= 2)
    return pairs, np.where(is_whole[:, None], mirrored[0] - mirrored[1], 0.0)
