"""Other ways to find a hidden look: baselines from a splat to a score, higher where it is more suspicious.

- *colour range*: how far the colour of a piece of surface changes over directions, the usual signal;
- *band 1 to 3*: share of the energy of the spherical harmonics in each band, as histograms of coefficients show it;
- *contributions*: share of what is seen that Gaussians make up which few cameras see, next to others that many see;
  after GSPure (arXiv:2511.22262), which takes such clusters for a watermark. This is its idea, not its code;
- a classifier of attributes, after Fake3DGS (arXiv:2604.27590), which trains a point transformer on 41,000 splats. Here
  are few, so it is a logistic regression on statistics of the same attributes. What counts is how it does on kinds of
  attack and objects that it was not trained on.

Not done: votes of a network that others trained on edits, as in GS-Checker, for none is at hand.
"""

import time
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from mi_splat.audit.surfaces import Frame, Target, cameras_around, elements, frame_of, near_of, sight, targets
from mi_splat.audit.thresholds import LIMITS
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.selection.clusters import nearest_neighbours
from mi_splat.selection.visibility import contributions
from mi_splat.sh import dc_to_colour, degree_of, even_directions, sh_to_colour

_ENDS = 0.1, 0.9
"""Quantiles over cameras between which a colour ranges: single cameras at an edge do not count."""
_EVERY, _COMPARED = 5, 8
"""Of so many cameras one counts contributions; Gaussians that are compared with each."""
_LEAST = 0.5
"""Pixels of all pictures together from which a Gaussian counts as seen."""

Baseline = Callable[[GaussianScene], float]


def colour_range(scene: GaussianScene) -> float:
    """Mean range of the colours of a piece of surface over the cameras that see it (sRGB), of the object with most."""
    frame, highest = frame_of(scene), 0.0
    for target in targets(frame.scene):
        view = sight(frame.scene, target, cameras_around(target))
        pieces = elements(view, target)
        moments = pieces.moments[pieces.judged]
        if len(moments):
            colours = moments[..., 1:4].masked_fill(moments[..., :1] == 0, torch.nan)
            low, high = (colours.nanquantile(end, dim=1) for end in _ENDS)
            highest = max(highest, float((high - low).mean()))
    return highest


def band_share(band: int) -> Baseline:
    """Share of the energy of all coefficients that one band has, of the solid Gaussians; colours count from grey."""

    def score(scene: GaussianScene) -> float:
        sh = scene.sh[scene.opacities > LIMITS.solid].double()
        if degree_of(scene.sh.shape[1]) < band or not len(sh):
            return 0.0
        energy = sh.square().sum((0, 2))
        return float(energy[band**2 : (band + 1) ** 2].sum() / energy.sum().clamp(min=1e-12))

    return score


def contribution_clusters(scene: GaussianScene) -> float:
    """Share of what is seen that Gaussians make up which fewer cameras see than their neighbours, in the mean."""
    frame, highest = frame_of(scene), 0.0
    for target in targets(frame.scene):
        highest = max(highest, _clusters(frame, target))
    return highest


def _clusters(frame: Frame, target: Target) -> float:
    """Mean shortfall of the cameras that see each Gaussian of one object, weighted by what it makes up."""
    cameras = cameras_around(target)[::_EVERY]
    render = Renderer(RenderSettings(near=near_of(target, cameras)))
    seen = contributions(frame.scene, cameras, render=render, rows=target.rows)
    total = seen.sum(1)
    camera_counts = seen.sum(1).square() / seen.square().sum(1).clamp(min=1e-9)
    visible = total > _LEAST
    if int(visible.sum()) <= _COMPARED:
        return 0.0
    others = nearest_neighbours(frame.scene.means[target.rows][visible].double(), _COMPARED)[1]
    around = camera_counts[visible][others].median(1).values
    few = (1 - camera_counts[visible] / around.clamp(min=1e-9)).clamp(min=0)
    return float((few * total[visible]).sum() / total[visible].sum())


BASELINES: Mapping[str, Baseline] = {
    "colour range": colour_range,
    "band 1": band_share(1),
    "band 2": band_share(2),
    "band 3": band_share(3),
    "contributions": contribution_clusters,
}
"""Name to what gives the score of a splat."""


def measured(scene: GaussianScene) -> dict[str, tuple[float, float]]:
    """The score of a splat by each baseline, and the CPU seconds that it took."""
    scores = {}
    for name, score in BASELINES.items():
        begun = time.process_time()
        with torch.no_grad():
            scores[name] = score(scene), time.process_time() - begun
    return scores


_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
_SAMPLE, _DIRECTIONS, _NEIGHBOURS = 4000, 32, 4
"""Gaussians that are looked at, evenly taken of all; directions of their colours; neighbours of each."""
_RIDGE, _STEPS = 0.06, 12
"""How far weights are held back, and steps of Newton's method."""


def attributes(scene: GaussianScene) -> Tensor:
    """(F,) float64 statistics of a splat's attributes that do not depend on its axes, unit or order of rows."""
    rows = (scene.opacities > LIMITS.solid).nonzero()[:, 0]
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


def fit_attributes(values: Tensor, labels: Sequence[bool]) -> Callable[[Tensor], Tensor]:
    """A logistic regression on `attributes`, trained on splats of which it is known whether they hide something.

    It gives (N,) log odds that splats of (N, F) attributes hide something.
    """
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
    return lambda of: ((of - middle) / spread) @ weights[:-1] + weights[-1]
