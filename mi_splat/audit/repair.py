"""Repairs a splat: its Gaussians get the colours that believed directions show, by
least squares.

Towards believed directions a Gaussian keeps its colours, and towards the others it gets
their mean; one that is hardly seen from there takes part of its mean from its
neighbours. No file can tell which appearance is the true one.
"""

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.explanations import angles_between
from mi_splat.audit.results import Audit, ObjectAudit
from mi_splat.audit.thresholds import LIMITS
from mi_splat.cameras.framing import near_plane
from mi_splat.maths.neighbours import nearest_neighbours
from mi_splat.maths.sh import sh_basis
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.selection.visibility import contributions

Keep = Literal["outside", "inside"]
"""The directions whose colours are believed: those outside of a look, or those
inside.
"""
_MOST_WEIGHTS = 10**8
_CHUNK = 2048


class Repair(NamedTuple):
    """A repaired splat, and how many of its Gaussians were changed or removed."""

    # the splat itself where nothing was found that could be repaired
    scene: GaussianScene
    coloured: int  # Gaussians that have other colours
    left_out: int  # Gaussians that are no longer there


def repaired(
    scene: GaussianScene, judged: Audit, *, keep: Keep = "outside"
) -> GaussianScene:
    """The splat without what was found in it; see `repair`."""
    return repair(scene, judged, keep=keep).scene


def repair(scene: GaussianScene, judged: Audit, *, keep: Keep = "outside") -> Repair:
    """Give a splat the colours that believed directions show, and remove what covers
    objects in the air.
    """
    plain = scene.detach().to("cpu", torch.float32)
    sh = plain.sh.clone()
    stays = torch.ones(len(scene), dtype=torch.bool)
    for item in judged.objects:
        if item.look.evidence >= LIMITS.suspicion:
            colour_anew(plain, sh, item, believed(item, keep))
        if (
            item.occluder is not None
            and item.covered
            and item.occluder.transparent >= LIMITS.seen_through
        ):
            stays &= ~(judged.mask & in_the_air(plain, item))
    coloured = int((sh != plain.sh).flatten(1).any(1)[stays].sum())
    left_out = int((~stays).sum())
    if not coloured and not left_out:
        return Repair(scene, 0, 0)
    return Repair(scene.replace(sh=sh.to(scene.sh)).select(stays), coloured, left_out)


def in_the_air(scene: GaussianScene, item: ObjectAudit) -> Tensor:
    """(N,) bool, which Gaussians lie where something that covers an object would: off
    it, and above its ground.
    """
    offsets = scene.means.double() - torch.tensor(item.centre, dtype=torch.float64)
    off: Tensor = offsets.norm(dim=1) > LIMITS.air * item.radius
    if item.up is None:
        return off
    heights = offsets @ torch.tensor(item.up, dtype=torch.float64)
    off &= heights > heights[item.rows].quantile(0.02) + LIMITS.floor * item.radius
    return off


def believed(item: ObjectAudit, keep: Keep) -> Tensor:
    """(K,) float32 weight of each camera: 1 where it is believed, 0 where not, and
    little near the others.
    """
    looks = [
        look.shown
        for look in item.looks
        if look is item.look or look.evidence >= LIMITS.suspicion
    ]
    other = torch.stack(looks).any(0) if keep == "outside" else ~item.look.shown
    gap = angles_between(item.directions, item.directions[other]).amin(1)
    least = max(LIMITS.believed_cameras, LIMITS.believed_share * len(gap))
    margin = next(
        (margin for margin in LIMITS.margins if int((gap > margin).sum()) >= least), 0.0
    )
    return torch.where(
        ~other & (gap > margin), 1.0, torch.where(other, 0.0, LIMITS.margin_weight)
    )


def colour_anew(
    scene: GaussianScene, sh: Tensor, item: ObjectAudit, trust: Tensor
) -> None:
    """Put new coefficients of the Gaussians of an object into a tensor."""
    offsets = scene.means.double() - torch.tensor(item.centre, dtype=torch.float64)
    rows = (offsets.norm(dim=1) < LIMITS.around * item.radius).nonzero()[:, 0]
    every = math.ceil(len(rows) * len(trust) / _MOST_WEIGHTS)
    cameras = item.cameras[::every]
    trust = trust[::every]
    render = Renderer(RenderSettings(near=near_plane(scene, cameras)))
    shows = contributions(scene, cameras, render=render, rows=rows)
    known = shows @ trust
    rows, shows, known = (
        values[known > LIMITS.repaired_pixels] for values in (rows, shows, known)
    )
    eyes = torch.stack([camera.position for camera in cameras]).float()
    parts = [
        (rows[part], shows[part])
        for part in torch.split(torch.arange(len(rows)), _CHUNK)
    ]
    means = torch.cat(
        [_mean(scene.select(part), weights, eyes, trust) for part, weights in parts]
    )
    wanted = _with_neighbours(
        scene.means[rows], means, known, shows @ (trust < 1).float()
    )
    for (part, weights), colours in zip(
        parts, torch.split(wanted, _CHUNK), strict=True
    ):
        sh[part] = _fitted(scene.select(part), weights, eyes, trust, colours)


def _views(part: GaussianScene, eyes: Tensor) -> tuple[Tensor, Tensor]:
    """(M, K, C) basis of the directions from K eyes to M Gaussians, and (M, K, 3) their
    colours there.
    """
    basis = sh_basis(
        functional.normalize(part.means[:, None] - eyes, dim=-1), part.degree
    )
    return basis, (basis @ part.sh + 0.5).clamp(min=0)


def _mean(part: GaussianScene, shows: Tensor, eyes: Tensor, trust: Tensor) -> Tensor:
    """(M, 3) mean colour of Gaussians towards what is believed; 0 of one that shows
    nothing there.
    """
    weights = shows * trust
    return torch.einsum("mk,mkc->mc", weights, _views(part, eyes)[1]) / weights.sum(
        1, keepdim=True
    ).clamp(min=1e-9)


def _with_neighbours(
    points: Tensor, colours: Tensor, known: Tensor, unknown: Tensor
) -> Tensor:
    """(M, 3) colours, the less known a colour the more of it from its neighbours."""
    distances, neighbours = nearest_neighbours(
        points, min(LIMITS.lending, max(len(points) - 1, 1))
    )
    exists = distances.isfinite()
    if not bool(exists.any()):
        return colours
    weights = (
        known[neighbours]
        * exists
        / (1 + (distances / distances[exists].median().clamp(min=1e-12)).float())
    )
    lent = torch.einsum("mn,mnc->mc", weights.nan_to_num(0.0), colours[neighbours])
    lent = lent / weights.nan_to_num(0.0).sum(1, keepdim=True).clamp(min=1e-9)
    borrowed = (LIMITS.borrowed * unknown)[:, None]
    return (known[:, None] * colours + borrowed * lent) / (
        known[:, None] + borrowed
    ).clamp(min=1e-9)


def _fitted(
    part: GaussianScene, shows: Tensor, eyes: Tensor, trust: Tensor, wanted: Tensor
) -> Tensor:
    """(M, C, 3) coefficients by least squares: own colours towards what is believed,
    the wanted ones elsewhere.
    """
    basis, colours = _views(part, eyes)
    kept = trust == 1
    target = torch.where(kept[:, None], colours, wanted[:, None]) - 0.5
    weights = (shows * torch.where(kept, 1.0, LIMITS.strict)).double()
    ridge = (
        LIMITS.ridge
        * weights.sum(1, keepdim=True)
        * (torch.arange(basis.shape[-1]) > 0)
    )
    basis = basis.double()
    target = target.double()
    left = torch.einsum("mk,mki,mkj->mij", weights, basis, basis) + torch.diag_embed(
        ridge
    )
    solution: Tensor = torch.linalg.solve(
        left, torch.einsum("mk,mki,mkc->mic", weights, basis, target)
    )
    return solution.to(part.sh)
