"""A detector of edited splats that is trained: a classifier on the attributes of Gaussians, after Fake3DGS.

Fake3DGS (arXiv:2604.27590) trains a point transformer on 41,000 splats. Here are few, so it is a logistic regression on
statistics of the same attributes. What counts is how it does on kinds of attack and objects that it was not trained on.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mi_splat.audit.thresholds import LIMITS
from mi_splat.errors import InvalidValueError
from mi_splat.scene import GaussianScene, check_scene
from mi_splat.selection.clusters import nearest_neighbours
from mi_splat.sh import dc_to_colour, even_directions, sh_to_colour

_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
_SAMPLE, _DIRECTIONS, _NEIGHBOURS = 4000, 32, 4
"""Gaussians that are looked at, evenly taken of all; directions of their colours; neighbours of each."""
_RIDGE, _STEPS = 0.06, 12
"""How far weights are held back, and steps of Newton's method."""


def attributes(scene: GaussianScene) -> Tensor:
    """(F,) float64 statistics of a splat's attributes that do not depend on its axes, unit or order of rows."""
    check_scene("scene", scene)
    rows = (scene.opacities > LIMITS.solid).nonzero()[:, 0]
    if len(rows) <= _NEIGHBOURS:
        do = "pass a splat that shows something"
        raise InvalidValueError.of("scene", f"over {_NEIGHBOURS} Gaussians that show", len(rows), do)
    order = scene.opacities[rows].argsort(stable=True)
    part = scene.select(rows[order[torch.linspace(0, len(rows) - 1, min(len(rows), _SAMPLE)).round().long()]])
    part = part.with_degree(3)
    scales = part.scales.log().sort(dim=1).values
    directions = torch.from_numpy(even_directions(_DIRECTIONS)).float()
    linear = sh_to_colour(part.sh[:, None], directions)
    darkest, brightest = linear.amin(1).mean(1), linear.amax(1).mean(1)
    gaps, others = nearest_neighbours(part.means.double(), _NEIGHBOURS)
    colours = dc_to_colour(part.sh[:, 0])
    bands = [part.sh[:, band**2 : (band + 1) ** 2].square().sum((1, 2)).sqrt() for band in (1, 2, 3)]
    spread = gaps[:, -1].clamp(min=1e-9).log()
    columns = [
        part.opacities,
        scales[:, 2] - scales[:, 0],
        scales[:, 2] - scales[:, 1],
        scales[:, 2] - spread.float(),
        (gaps[:, 0] / gaps[:, -1].clamp(min=1e-12)).float(),
        *colours.unbind(1),
        (colours - colours[others].mean(1)).norm(dim=1),
        darkest,
        brightest,
        *bands,
    ]
    quantiles = torch.quantile(torch.stack(columns, 1).double(), torch.tensor(_QUANTILES, dtype=torch.float64), dim=0)
    return quantiles.T.flatten()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AttributeClassifier:
    """A logistic regression on `attributes`."""

    middle: Tensor  # (F,) mean of the training set
    spread: Tensor  # (F,) its standard deviation, 1 where that is 0
    weights: Tensor  # (F,)
    bias: float  # what is added

    def odds(self, values: Tensor) -> Tensor:
        """(N,) log odds that splats of (N, F) attributes hide something."""
        return ((values - self.middle) / self.spread) @ self.weights + self.bias


def fit_attributes(values: Tensor, labels: Sequence[bool]) -> AttributeClassifier:
    """Train a classifier on splats of which it is known whether they hide something."""
    if len(values) != len(labels) or len(set(labels)) != 2:
        got = f"{len(labels)} for {len(values)} splats, {sum(labels)} of them hiding"
        raise InvalidValueError.of("labels", "one for each splat, and both kinds", got, "add what is missing")
    wanted = torch.tensor(labels).double()
    middle, spread = values.mean(0), values.std(0)
    spread = torch.where(spread > 1e-9, spread, 1.0)
    values = (values - middle) / spread
    balance = torch.where(wanted > 0, 0.5 / wanted.mean(), 0.5 / (1 - wanted.mean()))
    weights = torch.zeros(values.shape[1] + 1, dtype=torch.float64)
    design = torch.cat([values, torch.ones(len(values), 1, dtype=torch.float64)], 1)
    held = _RIDGE * torch.eye(design.shape[1], dtype=torch.float64)
    held[-1, -1] = 1e-9
    for _ in range(_STEPS):
        odds = (design @ weights).sigmoid()
        curvature = (balance * odds * (1 - odds) / len(design))[:, None]
        slope = design.T @ (balance * (odds - wanted)) / len(design) + held @ weights
        weights = weights - torch.linalg.solve(design.T @ (curvature * design) + held, slope)
    return AttributeClassifier(middle=middle, spread=spread, weights=weights[:-1], bias=float(weights[-1]))
