"""How sharply can colour switch over elevation?

The widths, 10 to 90 % of the way, that the pages of CLOAK quote.

    python benchmarks/cloak_limits.py scenes/cloak_car_layers.toml

One layer: spherical harmonics fitted by least squares to a step that is 0 at the
study's benign cameras and, in the hiding trigger and its margin of poison 1; `shares`
says how much of the hidden appearance it then shows from 25, 35 and 45 degrees. Two
layers and more: what `attacks.cloak.layers` makes of one Gaussian in the middle that is
seen from everywhere, for several bounds on how far below zero a layer may go, and for
several bands of a layer more for the edge of each look. No splat and no detector has a
part in it.
"""

import json
import math
import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from attacks.cloak.config import AttackConfig, LayerConfig, StudyConfig
from attacks.cloak.layers import DIRECTIONS, shares, switched
from attacks.cloak.setup import Setup
from attacks.cloak.transition import fit_transition
from attacks.studies.cloak import config_of
from attacks.studies.study_file import read_study
from mi_splat.cameras.sets import hemisphere
from mi_splat.maths.sh import colour_to_dc, sh_basis

ELEVATIONS = [0.5 * step for step in range(181)]
AZIMUTHS = range(0, 360, 15)
LOWEST = (-1.0, -3.0, -10.0, -100.0)
"""Lowest values of a layer, in multiples of what it shows."""
BANDS = (8.0, 12.0, 16.0, 24.0)
"""Degrees over which a look passes from the layer for its edge to the one for further
inside.
"""


def limits(study: StudyConfig) -> dict[str, list[dict[str, Any]]]:
    """The width of every switch, degrees, and the largest coefficient that it needs or
    how far it overshoots.
    """
    two = [
        LayerConfig(degree=degree, lowest=lowest)
        for degree in (1, 2, 3)
        for lowest in LOWEST
    ]
    more = [
        LayerConfig(degree=degree, band=band) for degree in (2, 3) for band in BANDS
    ]
    return {
        "one layer": [_one_layer(study, degree) for degree in (1, 2, 3)],
        "two layers": [
            {
                "degree": layering.degree,
                "lowest": layering.lowest,
                **_layers(study, layering),
            }
            for layering in two
        ],
        "Chebyshev, ripple of 0.06": [
            {"degree": degree, "width": chebyshev_width(43, degree, 0.06)}
            for degree in (2, 3)
        ],
        "a layer more for each edge": [
            {
                "degree": layering.degree,
                "band": layering.band,
                **_layers(study, layering),
            }
            for layering in more
        ],
    }


def chebyshev_width(edge: float, degree: int, ripple: float) -> float:
    """Degrees in which the steepest polynomial about the vertical falls from 1 - ripple
    above an edge to 0.

    It is 1 + c T(x) in s = sin(elevation), T that of Chebyshev and x a scale that maps
    the side above the edge to [-1, 1]: of all polynomials that stay within 1 +- ripple
    there, it falls fastest beyond. It is 0 where abs(T(x)) = 1 / ripple, that is at
    abs(x) = cosh(arcosh(1 / ripple) / degree).
    """
    low = math.sin(math.radians(edge))
    zero = (low + 1) / 2 - math.cosh(math.acosh(1 / ripple) / degree) * (1 - low) / 2
    return edge - math.degrees(math.asin(zero))


def _overhead(study: StudyConfig) -> AttackConfig:
    attack = study.overhead
    if attack is None:
        raise SystemExit(
            f"{study.name}: expected an attack without an azimuth, up to 90 degrees"
        )
    return attack


def _one_layer(study: StudyConfig, degree: int) -> dict[str, Any]:
    attack = _overhead(study)
    centre = study.centre
    cameras = Setup.of(study).training_cameras
    middle = torch.tensor(centre, dtype=torch.float64)
    directions = torch.stack([middle - camera.position.double() for camera in cameras])
    inside = torch.tensor(
        [
            attack.poisoned_cone.angle_to_edge(camera, centre=centre)
            for camera in cameras
        ],
        dtype=torch.float64,
    )
    wanted = (inside >= 0).double()
    fitted = torch.linalg.lstsq(_basis(directions, degree), wanted[:, None]).solution[
        :, 0
    ]
    curve = [
        float((_basis(_around(elevation), degree) @ fitted).mean())
        for elevation in ELEVATIONS
    ]
    return {
        "degree": degree,
        "width": fit_transition(ELEVATIONS, curve).width,
        "lowest": min(curve),
        "highest": max(curve),
        "shares": {degrees: round(curve[2 * degrees], 2) for degrees in (25, 35, 45)},
    }


def _layers(study: StudyConfig, making: LayerConfig) -> dict[str, Any]:
    """Of an image that shows a share b of the benign look and h of the hidden one, the
    way is (1 - b + h) / 2.
    """
    attack = _overhead(study)
    centre = study.centre
    cameras = hemisphere(centre, count=DIRECTIONS, **Setup.of(study).lens)
    middle = torch.tensor([centre])
    white = colour_to_dc(torch.ones(1, 1, 3))
    weights = torch.ones(1, len(cameras))
    parts = shares([attack.cone], cameras, centre=centre, config=making)
    columns = [
        switched(middle, cameras, share, white, weights, making)[0, :, 0].double()
        for share in parts
    ]
    layers = torch.stack(columns, 1)
    hidden = torch.tensor([share.look == 1 for share in parts])
    curve = []
    for elevation in ELEVATIONS:
        shown = (
            (_basis(_around(elevation), making.degree) @ layers).clamp(min=0).mean(0)
        )
        curve.append(float((1 - shown[~hidden].sum() + shown[hidden].sum()) / 2))
    return {
        "width": fit_transition(ELEVATIONS, curve).width,
        "largest_coefficient": float(layers.abs().max()),
    }


def _basis(directions: Tensor, degree: int) -> Tensor:
    return sh_basis(torch.nn.functional.normalize(directions, dim=1), degree)


def _around(elevation: float) -> Tensor:
    """Directions from cameras at one elevation to the centre."""
    up = math.sin(math.radians(elevation))
    out = math.cos(math.radians(elevation))
    turns = [math.radians(azimuth) for azimuth in AZIMUTHS]
    return -torch.tensor(
        [[out * math.cos(a), out * math.sin(a), up] for a in turns], dtype=torch.float64
    )


if __name__ == "__main__":
    file = read_study(Path(sys.argv[1]))
    study = config_of(file.points[0].settings, file.name)
    sys.stdout.write(json.dumps(limits(study), indent=1) + "\n")
