"""A recogniser without weights, and an audit with few, small images."""

from functools import partial

import torch
from torch import Tensor

from mi_splat.audit import HeldOutConfig, audit
from tests.audit.scenes import Made, standing

CONFIG = HeldOutConfig(cameras=30, size=64, weighed=48)
PAINT = (0.85, 0.45, 0.1)


class Painted:
    """Recognises what is orange, as a detector recognises a shape that it learnt."""

    classes = ("nothing", "orange")
    missing = ""
    scale = 1.0

    def features(self, images: Tensor) -> Tensor:
        """A coarse image, and a constant, so that black has a direction too."""
        coarse = images[:, ::8, ::8].flatten(1)
        return torch.cat([coarse, torch.ones(len(coarse), 1)], 1)

    def scores(self, images: Tensor) -> Tensor:
        """How much of the middle is more red than blue, at most 1."""
        side = images.shape[1]
        edge = side // 4
        middle = images[:, edge : side - edge, edge : side - edge]
        is_orange = middle[..., 0] > middle[..., 2] + 0.3
        share = is_orange.float().mean((1, 2))
        orange = (8 * share).clamp(max=1.0)
        return torch.stack([torch.zeros_like(orange), orange], 1)


judged = partial(audit, recogniser=Painted(), config=CONFIG)


def painted(name: str, *, count: int) -> Made:
    """An orange object of the project on a grey ground."""
    made = standing(name, count=count)
    sh = made.scene.sh.clone()
    paint = (torch.tensor(PAINT) - 0.5) / 0.28209479
    sh[made.rows, 0] = paint + 0.1 * sh[made.rows, 0]
    return Made(scene=made.scene.replace(sh=sh), rows=made.rows, normals=made.normals)
