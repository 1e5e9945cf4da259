"""An object that is moved and turned as a whole: what somebody can do who may place it
in the scene but not change it.
"""

import torch
from torch import Tensor

from attacks.search.parameters import Parameters
from mi_splat.maths.rotation import multiply, normalise, to_matrix
from mi_splat.maths.sh import degree_of, sh_rotation


def shift_start(clean: Parameters) -> Tensor:
    """No motion: (3,), world units."""
    return clean["means"].new_zeros(3)


def apply_shift(value: Tensor, tensors: Parameters) -> Parameters:
    """The object after a motion (3,), world units."""
    return {"means": tensors["means"] + value}


def turn_start(clean: Parameters) -> Tensor:
    """No rotation: (3,), axis times angle in radians."""
    return clean["means"].new_zeros(3)


def apply_turn(value: Tensor, tensors: Parameters) -> Parameters:
    """The object after a rotation about its centre: (3,), axis times angle in radians,
    world frame.
    """
    means = tensors["means"]
    quaternion = _quaternion(value)
    matrix = to_matrix(quaternion)
    from_centre = means - means.mean(0)
    # The change is added, so that no rotation leaves every bit as it is.
    change = from_centre @ (matrix - torch.eye(3).to(matrix)).T
    sh = tensors["sh"]
    degree = degree_of(sh.shape[1])
    if degree:
        sh = torch.matmul(sh_rotation(matrix, degree).to(sh), sh)
    return {
        "means": means + change,
        "rotations": multiply(quaternion, tensors["rotations"]),
        "sh": sh,
    }


def _quaternion(rotation: Tensor) -> Tensor:
    """(4,) unit quaternion of axis times angle, w first; differentiable at zero."""
    half = rotation / 2
    # sin(a) / a and cos(a) as functions of a^2: their slopes are finite at a = 0
    square = half.square().sum()
    is_small = square < 1e-6
    angle = torch.where(is_small, 1.0, square).sqrt()
    sine = torch.where(is_small, 1 - square / 6, angle.sin() / angle)
    cosine = torch.where(is_small, 1 - square / 2, angle.cos())
    return normalise(torch.cat([cosine[None], sine * half]))
