"""What `mi_splat.audit` and its baselines say of a splat, and how near that is to what is known of its attack."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from attacks.cloak.config import StudyConfig
from attacks.cloak.setup import Setup
from mi_splat.audit.auditing import audit
from mi_splat.audit.files import PAIR, pair_picture
from mi_splat.audit.results import ObjectAudit
from mi_splat.audit.surfaces import Frame, Target, cameras_around, elements, frame_of, near_of, sight, targets
from mi_splat.audit.thresholds import LIMITS
from mi_splat.cameras import Camera
from mi_splat.io.documents import save_json
from mi_splat.io.images import save_picture
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.scene_files import open_scene
from mi_splat.selection.clusters import nearest_neighbours
from mi_splat.selection.select import box_mask
from mi_splat.selection.visibility import contributions
from mi_splat.sh import dc_to_colour, degree_of, even_directions, sh_to_colour

if TYPE_CHECKING:
    from mi_splat.ledger import Out

# Other ways to find a hidden look: baselines from a splat to a score, higher where it is more suspicious. Contributions
# follow the idea of GSPure (arXiv:2511.22262), which takes clusters that few cameras see for a watermark. Attributes
# are after Fake3DGS (arXiv:2604.27590), whose point transformer has 41,000 splats; few take a logistic regression.

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
        moments = pieces.moments[:, pieces.judged]
        if moments.shape[1]:
            colours = moments[..., 1:4].masked_fill(moments[..., :1] == 0, torch.nan)
            low, high = (colours.nanquantile(end, dim=0) for end in _ENDS)
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


SCORES, COST = "baselines.json", "cost.json"
VARIES = (COST,)
_MARGIN, _OCCLUDER = 0.05, 0.8
"""Metres around the object's box, and share of an occluder's radius from which Gaussians are its own."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditedConfig:
    """Whose splat is audited.

    If it is one that a study cloaked with its one attack, directions and Gaussians are compared with this `truth`. A
    mesh file is not known here: the object has to be an asset.
    """

    truth: StudyConfig | None = None


def run(config: AuditedConfig, inputs: Mapping[str, Path], out: Out) -> list[dict[str, Any]]:
    """Audit the splat of a job, and compare what the audit says with the truth."""
    scene = open_scene(inputs["splat"]).scene
    begun = time.process_time()
    judged = audit(scene)
    seconds = time.process_time() - begun
    others = measured(scene)
    scores = {name: score for name, (score, _) in others.items()}
    save_json({"scores": scores, "attributes": attributes(scene).tolist()}, out / SCORES)
    save_json({"the audit": seconds, **{name: spent for name, (_, spent) in others.items()}}, out / COST)
    item = judged.strongest
    if item.evidence >= LIMITS.suspicion and item.look.pair is not None:
        save_picture(pair_picture(scene, item.look.pair), out / PAIR)
    row: dict[str, Any] = {
        "verdict": judged.verdict,
        "evidence": item.evidence,
        "excess": item.look.excess,
        "occluder": item.occluder.score if item.occluder is not None else 0.0,
        "gaussians": len(scene),
    }
    if config.truth is not None:
        rows = carriers(config.truth, scene)
        row |= {"directions": direction_overlap(config.truth, item)}
        if bool(judged.heat.any()):
            row |= {
                "heat": rank_of(judged.heat, rows),
                "mask": float((judged.mask & rows).sum() / (judged.mask | rows).sum()),
            }
    return [row]


def carriers(study: StudyConfig, scene: GaussianScene) -> Tensor:
    """(N,) bool, the Gaussians that an attack has changed: those in the object's box, or those of the occluder."""
    setup, attack = Setup.of(study), study.attack[0]
    if attack.appearance != "occluder":
        (x0, y0, z0), (x1, y1, z1) = setup.target.bounds.tolist()
        return box_mask(scene, (x0 - _MARGIN, y0 - _MARGIN, z0, x1 + _MARGIN, y1 + _MARGIN, z1 + _MARGIN))
    radius = attack.occluder_radius or 0.6 * float(setup.lens["distance"])
    offset = scene.means.double() - torch.tensor(study.centre, dtype=torch.float64)
    far: Tensor = offset.norm(dim=1) > _OCCLUDER * radius
    return far & (scene.means[:, 2] > 0.1 * radius)


def direction_overlap(study: StudyConfig, item: ObjectAudit) -> float:
    """Intersection over union of the cameras that are said to see a look with those in the attack's region."""
    poses = torch.eye(4, dtype=torch.float64).repeat(len(item.directions), 1, 1)
    poses[:, :3, 3] = item.directions
    cameras = [Camera(to_world=pose, focal=1.0, width=1, height=1) for pose in poses]
    truth = study.attack[0].cone.holds(cameras, centre=(0.0, 0.0, 0.0))
    return float((item.look.shown & truth).sum() / (item.look.shown | truth).sum())


def rank_of(heat: Tensor, rows: Tensor) -> float:
    """Area under the ROC curve of (N,) heat, for some Gaussians against all others; ties count half."""
    _, inverse, counts = torch.unique(heat.double(), return_inverse=True, return_counts=True)
    ranks = (counts.cumsum(0) - (counts - 1) / 2)[inverse]
    count = int(rows.sum())
    others = len(rows) - count
    if not count or not others:
        return 0.5
    return float((ranks[rows].sum() - count * (count + 1) / 2) / (count * others))
