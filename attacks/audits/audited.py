"""What `mi_splat.audit` and its baselines say of a splat, and how near that is to what is known of its attack."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
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
from mi_splat.audit.surfaces import cameras_around, elements, frame_of, sight, targets
from mi_splat.audit.thresholds import LIMITS
from mi_splat.cameras import Camera
from mi_splat.io.documents import save_json
from mi_splat.io.images import save_picture
from mi_splat.scene import GaussianScene
from mi_splat.scene_files import open_scene
from mi_splat.selection.select import box_mask
from mi_splat.sh import degree_of

if TYPE_CHECKING:
    from mi_splat.ledger import Out

# Other ways to find a hidden look: baselines from a splat to a score, higher where it is more suspicious.

_ENDS = 0.1, 0.9
"""Quantiles over cameras between which a colour ranges: single cameras at an edge do not count."""

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


BASELINES: Mapping[str, Baseline] = {
    "colour range": colour_range,
    "band 1": band_share(1),
    "band 2": band_share(2),
    "band 3": band_share(3),
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
    save_json({"scores": scores}, out / SCORES)
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
