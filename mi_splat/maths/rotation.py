"""Unit quaternions (w, x, y, z) and rotation matrices: pure torch functions,
differentiable, any leading dimensions.
"""

import math

import numpy as np
import torch
from torch import Tensor

from mi_splat.errors import InvalidValueError

UNIT_SLACK = 1e-6
"""A quaternion whose norm is this close to one keeps its bits, so that normalising
twice changes nothing.
"""


def normalise(quaternions: Tensor) -> Tensor:
    """Quaternions scaled to unit length.

    The norm is taken in float64. A quaternion that is already a unit one (norm within
    1e-6 of one) keeps its bits, which makes the function idempotent; its gradient is
    that of the normalisation all the same.
    """
    wide = quaternions.double()
    factor: Tensor = torch.linalg.vector_norm(wide, dim=-1, keepdim=True).reciprocal()
    near = (factor.detach() - 1).abs() <= UNIT_SLACK
    # The added constant makes the factor exactly one and leaves its derivative alone.
    factor = factor + torch.where(near, 1 - factor.detach(), 0.0)
    return (wide * factor).to(quaternions.dtype)


def multiply(left: Tensor, right: Tensor) -> Tensor:
    """Hamilton product: the rotation `right` followed by the rotation `left`."""
    a, b, c, d = left.unbind(-1)
    w, x, y, z = right.unbind(-1)
    return torch.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        dim=-1,
    )


def to_matrix(quaternions: Tensor) -> Tensor:
    """Rotation matrices of unit quaternions."""
    w, x, y, z = quaternions.unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(entries, dim=-1).reshape(*quaternions.shape[:-1], 3, 3)


def from_matrix(matrices: Tensor) -> Tensor:
    """Unit quaternions of rotation matrices, with w >= 0.

    All four of the equivalent formulas are evaluated and the one with the largest
    divisor is taken (Shepperd 1978), so that half turns lose no precision.
    """
    if matrices.shape[-2:] != (3, 3):
        raise InvalidValueError.of(
            "matrices",
            "shape (..., 3, 3)",
            tuple(matrices.shape),
            "pass rotation matrices",
        )
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrices.unbind(-2))
    candidates = torch.stack(
        [
            torch.stack([1 + a + e + i, h - f, c - g, d - b], dim=-1),
            torch.stack([h - f, 1 + a - e - i, d + b, g + c], dim=-1),
            torch.stack([c - g, d + b, 1 - a + e - i, h + f], dim=-1),
            torch.stack([d - b, g + c, h + f, 1 - a - e + i], dim=-1),
        ],
        dim=-2,
    )
    best = candidates.diagonal(dim1=-2, dim2=-1).argmax(-1)
    chosen = candidates.gather(
        -2, best[..., None, None].expand(*best.shape, 1, 4)
    ).squeeze(-2)
    chosen = normalise(chosen)
    return torch.where(chosen[..., :1] < 0, -chosen, chosen)


def is_rotation(matrix: Tensor, tolerance: float = 1e-4) -> bool:
    """Whether `matrix` (3, 3) is finite, orthonormal within `tolerance`, and no
    reflection.
    """
    # whose small matrices take a fraction of torch's time
    value = matrix.detach().cpu().double().numpy()
    if value.shape != (3, 3) or not np.isfinite(value).all():
        return False
    return bool(
        np.abs(value @ value.T - np.eye(3)).max() <= tolerance
        and np.linalg.det(value) > 0
    )


def from_z(direction: Tensor) -> Tensor:
    """(3, 3) float64, shortest rotation from z to a direction; about x where it is
    straight down (Rodrigues).
    """
    length = float(direction.norm())
    if not (math.isfinite(length) and length > 0):
        raise InvalidValueError.of(
            "up", "a direction", direction.tolist(), "for instance 0 0 1"
        )
    x, y, z = (direction.double() / length).tolist()
    if z < -1 + 1e-12:
        return torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    k = 1 / (1 + z)
    rows = [[1 - k * x * x, -k * x * y, x], [-k * x * y, 1 - k * y * y, y], [-x, -y, z]]
    turn = torch.tensor(rows, dtype=torch.float64)
    assert is_rotation(turn)
    return turn
