"""A splat without parts, as a trainer writes it: two shipped objects on a ground, rows
shuffled.
"""

import torch
from torch import Tensor

from mi_splat.io import load_splat
from mi_splat.maths.sh import colour_to_dc
from mi_splat.scene import GaussianScene, Similarity, merge
from tests.project.layers import ROOT

CAR = 0
SIGN = 1
GROUND = 2


def ground(count: int, *, half: float, seed: int = 0) -> GaussianScene:
    """Flat grey discs on z = 0, a little rough, over a square of so many world units to
    each side.
    """
    generator = torch.Generator().manual_seed(seed)
    positions = half * (2 * torch.rand(count, 2, generator=generator) - 1)
    heights = 0.01 * torch.randn(count, 1, generator=generator)
    greys = 0.35 + 0.04 * torch.randn(count, 1, 1, generator=generator).expand(
        count, 1, 3
    )
    size = half / count**0.5
    return GaussianScene(
        means=torch.cat([positions, heights], 1),
        scales=torch.tensor([size, size, 0.004]).expand(count, 3).contiguous(),
        rotations=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4).contiguous(),
        opacities=torch.full((count,), 0.95),
        sh=colour_to_dc(greys),
    )


def bare_scene() -> tuple[GaussianScene, Tensor]:
    """A car and a stop sign that stands a little over the ground, and the owner of each
    Gaussian.

    Every third Gaussian of the shipped files, to be quick: 3,359 of the car, 2,056 of
    the sign, 3,000 of the ground.
    """
    files = [
        ROOT / "scenes" / name
        for name in ("car_street_car.ply", "stop_sign_stop_sign.ply")
    ]
    car, sign = (load_splat(file).select(slice(None, None, 3)) for file in files)
    shift = Similarity(torch.eye(3), torch.tensor([0.3, 2.6, -1.5]))
    parts = (car, sign.transform(shift), ground(3000, half=6.0))
    owner = torch.cat(
        [torch.full((len(part),), number) for number, part in enumerate(parts)]
    )
    order = torch.randperm(len(owner), generator=torch.Generator().manual_seed(1))
    return merge(*parts).select(order), owner[order]


def iou(mask: Tensor, truth: Tensor) -> float:
    """Intersection over union of two masks."""
    return int((mask & truth).sum()) / int((mask | truth).sum())
