"""A scene turned by half a turn about an axis of the world, without any rounding.

The formats differ in where their axes point. Between the axes of the 3DGS PLY (x right, y down, z forward) and those of
SPZ or glTF lies half a turn, which only changes signs.
"""

import torch

from mi_splat.scene import GaussianScene
from mi_splat.sh import sh_basis

NONE, X, Y, Z = (1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0)
"""Signs of the coordinates after no turn, and after half a turn about each axis."""

_PROBE = torch.tensor([0.36, 0.48, 0.8], dtype=torch.float64)


def turned(scene: GaussianScene, signs: tuple[float, float, float]) -> GaussianScene:
    """The scene after half a turn; the second turn undoes the first to the bit.

    With D = diag(signs), a covariance R S^2 R^T becomes (D R D) S^2 (D R D)^T, whose quaternion is the old one with the
    signs on its vector part. Every basis function of SH is even or odd in each pair of coordinates, so that its
    coefficient keeps its size too.
    """
    if signs == NONE:
        return scene
    flip = torch.tensor(signs, dtype=torch.float64)
    parity = (sh_basis(_PROBE * flip, scene.degree) / sh_basis(_PROBE, scene.degree)).round()
    axes = flip.to(scene.means)
    whole = torch.cat([axes.new_ones(1), axes])
    return GaussianScene.unchecked(
        scene.means * axes,
        scene.scales,
        scene.rotations * whole,
        scene.opacities,
        scene.sh * parity.to(scene.sh)[:, None],
    )
