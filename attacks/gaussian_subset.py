"""One object of a scene, in the space that perturbations live in: the columns of a splat file.

SH coefficients and means are as in the scene; scales become logarithms, opacities logits, and quaternions are free of
the unit sphere (they are normalised on the way back).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from attacks.pgd import Parameters
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.parameters import activate, to_raw_parameters
from mi_splat.scene import ATTRIBUTES, GaussianScene


@dataclass(frozen=True, slots=True, eq=False)
class GaussianSubset:
    """One object of a scene: the rows that an attack may change.

    Attributes:
        scene: The whole scene.
        rows: (M,) int64 indices of the object's Gaussians, ascending.
        clean: The object's rows of all five attributes, as a file holds them.
    """

    scene: GaussianScene
    rows: Tensor
    clean: Parameters

    @classmethod
    def of(cls, scene: GaussianScene, mask: Tensor | slice) -> GaussianSubset:
        """The object that `mask` (a bool tensor, integer indices or a slice) selects.

        Raises:
            InvalidValueError: The mask does not fit the scene or selects nothing.
        """
        count = len(scene.means)
        if isinstance(mask, Tensor) and mask.dtype == torch.bool and mask.shape != (count,):
            raise InvalidValueError(
                message("mask", f"shape ({count},)", tuple(mask.shape), "pass one value per Gaussian")
            )
        everything = torch.arange(count)
        if isinstance(mask, Tensor) and mask.dtype != torch.bool:
            outside = mask.dtype.is_floating_point or bool(((mask < 0) | (mask >= count)).any())
            if outside:
                raise InvalidValueError(
                    message(
                        "mask", f"bool values or indices in 0..{count - 1}", mask.dtype, "pass a mask or row numbers"
                    )
                )
        rows = torch.unique(everything[mask if isinstance(mask, slice) else mask.detach().cpu()])
        if not len(rows):
            raise InvalidValueError(message("mask", "at least one Gaussian", "none", "name an object of the scene"))
        rows = rows.to(scene.means.device)
        return cls(scene, rows, to_raw_parameters(scene.select(rows).detach()))

    def parameters(self, attributes: Sequence[str]) -> Parameters:
        """The object's rows of the attributes, as the file holds them."""
        return {name: self.clean[name] for name in attributes}

    def scene_with(self, parameters: Parameters) -> GaussianScene:
        """The whole scene with the object's rows exchanged, differentiable in the parameters, other rows untouched."""
        moved: dict[str, Tensor] = dict(zip(ATTRIBUTES, activate({**self.clean, **parameters}), strict=True))
        tensors: dict[str, Tensor] = dict(zip(ATTRIBUTES, self.scene.tensors(), strict=True))
        for name in parameters:
            tensors[name] = tensors[name].detach().index_put((self.rows,), moved[name])
        return GaussianScene.unchecked(**tensors)

    def applied(self, parameters: Parameters) -> GaussianScene:
        """The attacked scene as a checked value; what did not move keeps the very bits it had."""
        attacked, tensors = self.scene_with(parameters).detach(), {}
        for name, value in parameters.items():
            before, after = getattr(self.scene, name).detach(), getattr(attacked, name)
            still = value.detach() == self.clean[name]
            if name == "rotations":  # normalisation mixes the four numbers of a row
                still = still.all(-1, keepdim=True).expand_as(still)
            after[self.rows] = torch.where(still, before[self.rows], after[self.rows])
            tensors[name] = after
        return self.scene.replace(**tensors)

    def changed(self, attacked: GaussianScene) -> int:
        """Number of Gaussians of the whole scene that are not bit for bit what they were."""
        differs = torch.zeros(len(self.scene.means), dtype=torch.bool, device=self.scene.means.device)
        for name in ATTRIBUTES:
            before, after = getattr(self.scene, name), getattr(attacked, name)
            differs |= (before != after).reshape(len(before), -1).any(-1)
        return int(differs.sum())
