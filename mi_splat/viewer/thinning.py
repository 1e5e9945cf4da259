"""Fewer and larger Gaussians in the place of many, for pictures that have to be made quickly."""

import torch

from mi_splat.io.formats.compressed_ply import morton_order
from mi_splat.scene import GaussianScene

DENSITY = 1
"""Gaussians for each pixel beyond which a coarse picture gets no better for its time."""
MOST = 64
"""Of so many Gaussians one stays at least."""


def thinning(count: int, pixels: int) -> int:
    """One in how many Gaussians is drawn in a picture of so many pixels; a power of two."""
    every = 1
    while every < MOST and count > DENSITY * pixels * every:
        every *= 2
    return every


class Thinned:
    """A scene with fewer Gaussians, made when they are first asked for.

    Args:
        scene: All of them.
    """

    def __init__(self, scene: GaussianScene) -> None:
        self._scenes = {1: scene}
        self._order: torch.Tensor | None = None

    def __call__(self, every: int) -> GaussianScene:
        """One of `every` neighbours along a Morton curve, with the area of all of them, so that surfaces stay closed.

        Their colours in every direction and their opacities are their own.
        """
        if every not in self._scenes:
            scene = self._scenes[1]
            if self._order is None:
                self._order = torch.as_tensor(morton_order(scene.means.detach().cpu().numpy()))
            rows = self._order[every // 2 :: every].to(scene.means.device)
            means, scales, *rest = (tensor[rows] for tensor in scene.tensors())
            self._scenes[every] = GaussianScene.unchecked(means, scales * every**0.5, *rest)
        return self._scenes[every]
