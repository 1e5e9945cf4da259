"""One object of a scene, in the space that perturbations live in: the columns of a
splat file.

SH coefficients and means are as in the scene; scales become logarithms, opacities
logits, and quaternions are free of the unit sphere (they are normalised on the way
back).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from attacks.search.parameters import Parameters
from attacks.threats import THREATS
from mi_splat.attributes import ATTRIBUTES
from mi_splat.errors import InvalidValueError
from mi_splat.io.parameters import activate, to_raw_parameters
from mi_splat.scene import GaussianScene

Mask: TypeAlias = (
    Tensor
    | slice
    | Sequence[bool]
    | Sequence[int]
    | NDArray[np.bool_]
    | NDArray[np.integer[Any]]
)
"""What selects the Gaussians of an object: (N,) bool, row numbers, or a slice; a
tensor, an array or a list.
"""


@dataclass(frozen=True, slots=True, eq=False)
class GaussianSubset:
    """One object of a scene: the rows that an attack may change."""

    scene: GaussianScene  # the whole scene
    rows: Tensor  # (M,) int64 indices of the object's Gaussians, ascending
    clean: Parameters  # the object's rows of all five attributes, as a file holds them
    # highest degree of the SH coefficients that may change; None for all
    sh_degree: int | None = None

    @classmethod
    def of(
        cls, scene: GaussianScene, mask: Mask, *, sh_degree: int | None = None
    ) -> GaussianSubset:
        """The object that a mask (see `Mask`) selects."""
        rows = _rows_of(mask, len(scene.means)).to(scene.means.device)
        return cls(
            scene, rows, to_raw_parameters(scene.select(rows).detach()), sh_degree
        )

    def parameters(self, attributes: Sequence[str]) -> Parameters:
        """What may change: the object's rows of attributes, as the file holds them, and
        the clean values of threats.
        """
        values = {
            name: (
                self.clean[name]
                if name in ATTRIBUTES
                else THREATS[name].start(self.clean)
            )
            for name in attributes
        }
        if "sh" in values and self.sh_degree is not None:
            values["sh"] = values["sh"][:, : (self.sh_degree + 1) ** 2]
        return values

    def complete(self, parameters: Parameters) -> Parameters:
        """The parameters with those SH coefficients, too, that may not change."""
        sh = parameters.get("sh")
        clean = self.clean["sh"]
        if sh is None or sh.shape[1] == clean.shape[1]:
            return parameters
        return {**parameters, "sh": torch.cat([sh, clean[:, sh.shape[1] :]], 1)}

    def moved(self, parameters: Parameters) -> Parameters:
        """The object's rows of every attribute that the parameters change, as the file
        holds them: attributes first, and then what threats make of them.
        """
        rows = self.complete(
            {name: value for name, value in parameters.items() if name in ATTRIBUTES}
        )
        for name, value in parameters.items():
            if name not in ATTRIBUTES:
                rows = {**rows, **THREATS[name].apply(value, {**self.clean, **rows})}
        return rows

    def scene_with(self, parameters: Parameters) -> GaussianScene:
        """The whole scene with the object's rows exchanged, differentiable in the
        parameters, other rows untouched.
        """
        rows = self.moved(parameters)
        moved: dict[str, Tensor] = dict(
            zip(ATTRIBUTES, activate({**self.clean, **rows}), strict=True)
        )
        tensors: dict[str, Tensor] = dict(
            zip(ATTRIBUTES, self.scene.tensors(), strict=True)
        )
        for name in rows:
            tensors[name] = tensors[name].detach().index_put((self.rows,), moved[name])
        return GaussianScene.unchecked(**tensors)

    def applied(self, parameters: Parameters) -> GaussianScene:
        """The attacked scene as a checked value; what did not move keeps the very bits
        it had.
        """
        attacked = self.scene_with(parameters).detach()
        tensors = {}
        for name, value in self.moved(parameters).items():
            before = getattr(self.scene, name).detach()
            after = getattr(attacked, name)
            still = value.detach() == self.clean[name]
            if name == "rotations":  # normalisation mixes the four numbers of a row
                still = still.all(-1, keepdim=True).expand_as(still)
            after[self.rows] = torch.where(still, before[self.rows], after[self.rows])
            tensors[name] = after
        return self.scene.replace(**tensors)

    def changed(self, attacked: GaussianScene) -> int:
        """Number of Gaussians of the whole scene that are not bit for bit what they
        were.
        """
        differs = torch.zeros(
            len(self.scene.means), dtype=torch.bool, device=self.scene.means.device
        )
        for name in ATTRIBUTES:
            before = getattr(self.scene, name)
            after = getattr(attacked, name)
            differs |= (before != after).reshape(len(before), -1).any(-1)
        return int(differs.sum())


def _rows_of(mask: Mask, count: int) -> Tensor:
    """Ascending row numbers of the Gaussians that a mask selects out of `count`."""
    everything = torch.arange(count)
    rows: Tensor = torch.unique(
        everything[mask if isinstance(mask, slice) else _checked_mask(mask, count)]
    )
    if not len(rows):
        raise InvalidValueError.of(
            "mask", "at least one Gaussian", "none", "name an object of the scene"
        )
    return rows


def _checked_mask(mask: object, count: int) -> Tensor:
    """A mask or row numbers as a tensor on the CPU that fits `count` Gaussians."""
    expected = f"bool values or indices in 0..{count - 1}"
    try:
        rows = torch.as_tensor(mask).detach().cpu()
    except (TypeError, ValueError, RuntimeError):
        raise InvalidValueError.of(
            "mask", expected, f"{mask!r:.80}", "pass a mask or row numbers"
        ) from None
    if not rows.numel():
        return rows.long()
    if rows.dtype == torch.bool and rows.shape != (count,):
        raise InvalidValueError.of(
            "mask",
            f"shape ({count},)",
            tuple(rows.shape),
            "pass one value per Gaussian",
        )
    if rows.dtype == torch.bool:
        return rows
    if (
        rows.is_floating_point()
        or rows.is_complex()
        or bool(((rows < 0) | (rows >= count)).any())
    ):
        raise InvalidValueError.of(
            "mask", expected, rows.dtype, "pass a mask or row numbers"
        )
    return rows.long()
