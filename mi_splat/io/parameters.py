"""The parametrisation in which splat files keep a Gaussian, as differentiable torch
functions.

Files hold log-scales, logit opacities and quaternions of any length, as 3D Gaussian
Splatting optimises them (Kerbl et al. 2023, section 5.1); scenes hold physical values.
The functions compute in float64 and round once. Rounding there and back is stable: a
value that came from a file goes back to a number that gives the same physical value
again, so repeated round trips do not drift.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from mi_splat.attributes import ATTRIBUTES
from mi_splat.errors import InvalidValueError
from mi_splat.maths.rotation import normalise
from mi_splat.scene import GaussianScene

# Finite logits of the opacities 0 and 1: the sigmoid of them rounds to exactly 0 and 1
# in that dtype.
_LOGIT_LIMITS = {torch.float32: (-104.0, 17.5), torch.float64: (-746.0, 38.0)}
# Largest logarithms whose exponential does not overflow.
_LOG_LIMITS = {torch.float32: 88.72283, torch.float64: 709.78271}


def to_raw_parameters(scene: GaussianScene) -> dict[str, Tensor]:
    """The scene's tensors as a splat file holds them."""
    return {
        "means": scene.means,
        "scales": (
            scene.scales.double()
            .log()
            .clamp(max=_LOG_LIMITS[scene.scales.dtype])
            .to(scene.scales.dtype)
        ),
        "rotations": scene.rotations,
        "opacities": _logit(scene.opacities),
        "sh": scene.sh,
    }


def from_raw_parameters(values: Mapping[str, Tensor]) -> GaussianScene:
    """The scene whose raw parameters are `values`, the inverse of
    `to_raw_parameters`.
    """
    if set(values) != set(ATTRIBUTES):
        raise InvalidValueError.of(
            "values", f"the names {ATTRIBUTES}", tuple(values), "pass exactly these"
        )
    return GaussianScene(*activate(values))


def activate(
    values: Mapping[str, Tensor],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Like `from_raw_parameters`, without any check: the five tensors, whatever they
    hold.
    """
    scales = values["scales"]
    opacities = values["opacities"]
    return (
        values["means"],
        scales.double().exp().to(scales.dtype),
        normalise(values["rotations"]),
        opacities.double().sigmoid().to(opacities.dtype),
        values["sh"],
    )


def _logit(opacities: Tensor) -> Tensor:
    """Logits that stay finite at 0 and 1, where their gradient is zero."""
    low, high = _LOGIT_LIMITS[opacities.dtype]
    wide = opacities.double()
    inside = (wide > 0) & (wide < 1)
    safe = torch.where(inside, wide, 0.5)
    logits = safe.log() - torch.log1p(-safe)
    ends = torch.where(wide > 0.5, high, low).to(wide.dtype)
    return torch.where(inside, logits, ends).to(opacities.dtype)
