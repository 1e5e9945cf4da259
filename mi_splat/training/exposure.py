"""Pictures whose exposure and white balance differ: an affine map of colours for each, trained along with the splat."""

from __future__ import annotations

import math

import torch
from torch import Tensor

_FIRST, _LAST = 1e-2, 1e-3
"""Learning rates, as published (code of 3D Gaussian Splatting of October 2024); it decays exponentially."""
MOMENTS = ("exp_avg", "exp_avg_sq", "step")
"""What Adam keeps of each map, by torch's names."""


class Exposures:
    """A (3, 4) map for each picture of a set: a matrix and what is added, from the splat's sRGB to the picture's.

    Nothing says which exposure is the right one. So the mean of the maps is kept the identity, and the splat has the
    mean exposure; left free, all maps and the splat drift together.

    Attributes:
        values: (V, 3, 4) maps.
        maps: The same, a picture at a time, as Adam knows them.
        optimiser: Adam.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self.values = torch.eye(3, 4, device=device).repeat(count, 1, 1)
        self.maps = [exposure_map.requires_grad_(True) for exposure_map in self.values.unbind()]
        self.optimiser = torch.optim.Adam(self.maps, lr=_FIRST, eps=1e-15)

    def applied(self, image: Tensor, index: int) -> Tensor:
        """(H, W, 3) colours as a picture has them."""
        return image[..., :3] @ self.maps[index][:, :3].T + self.maps[index][:, 3]

    def step(self, progress: float) -> None:
        """A step of Adam on the map that has a gradient, which is cleared; then all are moved to their mean."""
        for group in self.optimiser.param_groups:
            group["lr"] = math.exp((1 - progress) * math.log(_FIRST) + progress * math.log(_LAST))
        self.optimiser.step()
        self.optimiser.zero_grad(set_to_none=True)
        self.values -= self.values.mean(0) - torch.eye(3, 4, device=self.values.device)

    def tensors(self) -> dict[str, Tensor]:
        """All of it in four tensors, the maps and what Adam keeps of them."""
        kept = [self.optimiser.state.get(exposure_map, {}) for exposure_map in self.maps]
        zeros = {"exp_avg": torch.zeros(3, 4), "exp_avg_sq": torch.zeros(3, 4), "step": torch.zeros(())}
        moments = {key: torch.stack([adam.get(key, zeros[key]).cpu() for adam in kept]) for key in MOMENTS}
        return {"maps": self.values.cpu().clone(), **moments}

    @classmethod
    def of(cls, tensors: dict[str, Tensor], device: torch.device) -> Exposures:
        """The inverse of `tensors`."""
        made = cls(len(tensors["maps"]), device)
        made.values.copy_(tensors["maps"])
        for index, exposure_map in enumerate(made.maps):
            if tensors["step"][index] > 0:
                made.optimiser.state[exposure_map] = {
                    key: tensors[key][index].clone().to("cpu" if key == "step" else device) for key in MOMENTS
                }
        return made
