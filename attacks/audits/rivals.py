"""Other ways to find a hidden look, under one interface: from a splat to a score, higher where it is more suspicious.

- *colour range*: how far the colour of a piece of surface changes over directions, the usual signal;
- *band 1 to 3*: share of the energy of the spherical harmonics in each band, as histograms of coefficients show it;
- *contributions*: share of what is seen that Gaussians make up which few cameras see, next to others that many see;
  after GSPure (arXiv:2511.22262), which takes such clusters for a watermark. This is its idea, not its code.

What has to be trained is in `attacks.audits.learnt`. Not done: votes of a network that others trained on edits, as in
GS-Checker, for none is at hand.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from attacks.audits.learnt import attributes
from mi_splat.audit.frames import Frame, Target, frame_of, targets
from mi_splat.audit.surfaces import cameras_around, elements, near_of, sight
from mi_splat.audit.thresholds import LIMITS
from mi_splat.io.documents import save_json
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene, check_scene
from mi_splat.scene_files import open_scene
from mi_splat.selection.clusters import nearest_neighbours
from mi_splat.selection.visibility import contributions
from mi_splat.sh import degree_of

if TYPE_CHECKING:
    from mi_splat.ledger import Out

_ENDS = 0.1, 0.9
"""Quantiles over cameras between which a colour ranges: single cameras at an edge do not count."""
_EVERY, _NEIGHBOURS = 5, 8
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
    if int(visible.sum()) <= _NEIGHBOURS:
        return 0.0
    others = nearest_neighbours(frame.scene.means[target.rows][visible].double(), _NEIGHBOURS)[1]
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
    check_scene("scene", scene)
    scores = {}
    for name, score in BASELINES.items():
        begun = time.process_time()
        with torch.no_grad():
            scores[name] = score(scene), time.process_time() - begun
    return scores


RIVALS, COST = "rivals.json", "cost.json"
VARIES = (COST,)


@dataclass(frozen=True, slots=True, kw_only=True)
class RivalsConfig:
    """Nothing: they have no settings."""


def run(config: RivalsConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Write the score of each, and the attributes that a classifier reads."""
    scene = open_scene(inputs["splat"]).scene
    scores = measured(scene)
    save_json({"seconds": {name: seconds for name, (_, seconds) in scores.items()}}, out / COST)
    told = {name: score for name, (score, _) in scores.items()}
    save_json({"scores": told, "attributes": attributes(scene).tolist()}, out / RIVALS)
