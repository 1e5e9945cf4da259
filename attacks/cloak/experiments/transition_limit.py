"""How sharply colour alone can switch over elevation.

Spherical harmonics of each degree are fitted by least squares to a step that is 0 at the study's benign cameras and, in
the hiding trigger, 1 or what the study's emphasis makes of it, not clipped. The limit is that of one Gaussian that is
seen from everywhere. What a splat does besides (geometry, clipped colours, Gaussians that are seen from few sides) is
not in it.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from attacks.cloak.study import setup
from attacks.cloak.study.config import StudyConfig
from attacks.cloak.study.observations import overhead
from attacks.cloak.transition import fit_transition
from mi_splat.errors import InvalidValueError, message
from mi_splat.sh import sh_basis

ELEVATIONS = [0.5 * step for step in range(181)]
AZIMUTHS = range(0, 360, 15)


def measure_transition_limit(study: StudyConfig) -> list[dict[str, Any]]:
    """For each SH degree, with and without emphasis: the transition of the best fit, and how far it overshoots.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around.
    """
    attack = overhead(study)
    if attack is None:
        do = "add an attack without an azimuth, up to 90 degrees"
        raise InvalidValueError(message("study", "an appearance that is seen from all around", "none", do))
    centre = setup.centre_of(study)
    cameras = setup.training_cameras(study, setup.target_of(study.scene))
    middle = torch.tensor(centre, dtype=torch.float64)
    directions = torch.stack([middle - camera.position.double() for camera in cameras])
    depths = torch.tensor([attack.cone.angle_to_edge(camera, centre=centre) for camera in cameras], dtype=torch.float64)
    step = (depths >= 0).double()
    gain = 1 + (attack.emphasis - 1) * (1 - depths / attack.emphasis_depth).clamp(0, 1)
    return [
        {"sh_degree": degree, "emphasis": name, **_limit(directions, wanted, degree)}
        for name, wanted in ((1.0, step), (attack.emphasis, step * gain))
        for degree in range(1, 4)
    ]


def _limit(directions: Tensor, wanted: Tensor, degree: int) -> dict[str, float | None]:
    """Band and extremes of the least-squares fit, as means over azimuths."""
    fitted = torch.linalg.lstsq(_basis(directions, degree), wanted[:, None]).solution[:, 0]
    means = [float((_basis(_around(elevation), degree) @ fitted).mean()) for elevation in ELEVATIONS]
    band = fit_transition(ELEVATIONS, means)
    return {"from": band.start, "to": band.end, "width": band.width, "lowest": min(means), "highest": max(means)}


def _basis(directions: Tensor, degree: int) -> Tensor:
    return sh_basis(torch.nn.functional.normalize(directions, dim=1), degree)


def _around(elevation: float) -> Tensor:
    """Directions from cameras at one elevation to the centre."""
    up, out = math.sin(math.radians(elevation)), math.cos(math.radians(elevation))
    turns = [math.radians(azimuth) for azimuth in AZIMUTHS]
    return -torch.tensor([[out * math.cos(a), out * math.sin(a), up] for a in turns], dtype=torch.float64)
