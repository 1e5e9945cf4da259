"""Changes that a defender makes to a splat before looking at it."""

import torch
from torch import Tensor

from mi_splat.errors import InvalidValueError
from mi_splat.maths.neighbours import nearest_neighbours
from mi_splat.scene import GaussianScene


def median_of_neighbours(scene: GaussianScene, count: int) -> GaussianScene:
    """The splat with the colour that each Gaussian has from everywhere smoothed.

    The SH coefficients of degree 0 become the median, channel by channel, of those of
    the Gaussian itself and of its nearest neighbours. A change of colours that jumps
    from Gaussian to Gaussian is lost; so is fine texture. Differentiable, so that an
    attacker can anticipate it.

    Args:
        scene: N Gaussians.
        count: Neighbours of each, at most N - 1.

    Returns:
        The splat; all other attributes are what they were.

    Raises:
        InvalidValueError: There are not as many Gaussians.
    """
    return with_medians(scene, with_itself(scene.means, count))


def with_itself(means: Tensor, count: int) -> Tensor:
    """(N, count + 1) rows of each Gaussian and its nearest neighbours.

    Args:
        means: (N, 3) world units.
        count: Neighbours of each, at most N - 1.

    Returns:
        Row numbers, on the CPU.

    Raises:
        InvalidValueError: There are not as many Gaussians.
    """
    if not 1 <= count < len(means):
        do = "ask for fewer neighbours"
        raise InvalidValueError.of("count", f"1 to {len(means) - 1}", count, do)
    _, others = nearest_neighbours(means, count)
    return torch.cat([torch.arange(len(means))[:, None], others], dim=1)


def with_medians(scene: GaussianScene, rows: Tensor) -> GaussianScene:
    """The splat whose SH coefficients of degree 0 are medians over some rows.

    Args:
        scene: N Gaussians.
        rows: (N, K) Gaussians over which each median is taken, as of `with_itself`.

    Returns:
        The splat; all other attributes are what they were.
    """
    constant = scene.sh[:, 0][rows.to(scene.sh.device)].median(dim=1).values
    return scene.replace(sh=torch.cat([constant[:, None], scene.sh[:, 1:]], dim=1))
