"""GaussianScene: the one value that every part of the library passes around."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from mi_splat.errors import InvalidValueError, message

ATTRIBUTES = ("means", "scales", "rotations", "opacities", "sh")
"""The five tensors of a scene, in the order in which renderers take them."""


@dataclass(frozen=True, slots=True, eq=False)
class GaussianScene:
    """N Gaussians in physical values: never logits, never logarithms.

    Attributes:
        means: (N, 3) float32, world units.
        scales: (N, 3) float32, standard deviations along the Gaussian's own axes, > 0, world units.
        rotations: (N, 4) float32 unit quaternions (w, x, y, z), local to world.
        opacities: (N,) float32 in [0, 1].
        sh: (N, K, 3) float32, K = (degree + 1)^2 with degree 0 to 3; real spherical harmonics of the sRGB colour in the
            order and sign convention of 3D Gaussian Splatting (Kerbl et al. 2023); colour = 0.5 + sum.
    """

    means: Tensor
    scales: Tensor
    rotations: Tensor
    opacities: Tensor
    sh: Tensor
