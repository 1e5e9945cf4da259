"""Changes that a defender makes to a splat before looking at it."""

import torch
from scipy.spatial import cKDTree

from mi_splat.errors import InvalidValueError
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
    if not 1 <= count < len(scene):
        do = "ask for fewer neighbours"
        raise InvalidValueError.of("count", f"1 to {len(scene) - 1}", count, do)
    means = scene.means.detach().cpu().double().numpy()
    _, nearest = cKDTree(means).query(means, k=count + 1)
    indices = torch.from_numpy(nearest).to(scene.sh.device)
    constant = scene.sh[:, 0][indices].median(dim=1).values
    return scene.replace(sh=torch.cat([constant[:, None], scene.sh[:, 1:]], dim=1))
