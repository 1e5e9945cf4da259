"""Repairs a splat: what the believed directions predict becomes what it shows.

Towards believed directions a Gaussian keeps its colours, and towards the others it gets
their median, by least squares over its spherical harmonics; what shows almost only from
the others and hides the object is removed. No file can tell which appearance is the
true one.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from mi_splat.audit.held_out import Prediction
from mi_splat.audit.results import Audit, ObjectAudit
from mi_splat.scene import GaussianScene

Keep = Literal["outside", "inside"]
"""The directions whose colours are believed: those outside of a contradicted cone, or
those inside.
"""
_ROUNDS = 4  # a trigger may be wider than one cone
_AGREED = 0.6  # share of the directions that has to agree
_LEAST = 1e-2  # pixels times sRGB by which a Gaussian departs that is coloured anew
_UNSEEN = 0.1  # weight of a direction in which a Gaussian hardly shows
_STRICT = 3.0  # weight of predicted colours by that of the kept ones
_RIDGE = 1e-2  # weight of coefficients above degree 0 against all colours


class Repair(NamedTuple):
    """A repaired splat, and how many of its Gaussians were changed or removed."""

    # the splat itself where nothing was found that could be repaired
    scene: GaussianScene
    coloured: int  # Gaussians that have other colours
    left_out: int  # Gaussians that are no longer there
    audit: Audit  # of that splat


def repaired(
    scene: GaussianScene,
    judged: Audit,
    again: Callable[[GaussianScene], Audit],
    *,
    keep: Keep = "outside",
) -> Repair:
    """Write what the believed directions predict into the splat, cone by cone.

    Args:
        scene: The splat.
        judged: Its audit.
        again: Audits what was repaired, as the splat was audited.
        keep: The directions that are believed.

    Returns:
        The splat without what its audit found, as far as four rounds reach.
    """
    present = torch.arange(len(scene))  # rows of the splat that are left
    coloured = torch.zeros(len(scene), dtype=torch.bool)
    current = scene
    for _ in range(_ROUNDS):
        if judged.answer != "contradicted":
            break
        sh, stays = _repaired_once(current, judged, keep)
        changed = (sh != current.sh).flatten(1).any(1)
        if not bool(changed.any()) and bool(stays.all()):
            break
        coloured[present[changed & stays]] = True
        present = present[stays]
        current = current.replace(sh=sh).select(stays.nonzero()[:, 0])
        judged = again(current)
    left_out = len(scene) - len(present)
    is_same = len(present) == len(scene) and not bool(coloured.any())
    return Repair(
        scene if is_same else current, int(coloured[present].sum()), left_out, judged
    )


def _repaired_once(
    scene: GaussianScene, judged: Audit, keep: Keep
) -> tuple[Tensor, Tensor]:
    """(N, C, 3) coefficients, and (N,) bool which Gaussians stay, after the clearest
    cone of each object was repaired.
    """
    sh = scene.sh.clone()
    stays = torch.ones(len(scene), dtype=torch.bool)
    for item in judged.objects:
        worst = item.clearest
        if worst is None:
            continue
        replaced = worst.inside if keep == "outside" else ~worst.inside
        if keep == "outside" and float((~replaced).double().mean()) < _AGREED:
            continue
        predicted = item.consensus.predicted(replaced)
        found = item.consensus.departures(predicted, replaced, peeled=False)
        departs = found > _LEAST
        if worst.peeled:
            # what shows again below a lid departs though nothing of it was seen
            departs |= item.consensus.own
            stays[item.consensus.rows[predicted.lid]] = False
        _colour_anew(sh, item, predicted, replaced, departs)
    return sh, stays


def _colour_anew(
    sh: Tensor,
    item: ObjectAudit,
    predicted: Prediction,
    replaced: Tensor,
    departs: Tensor,
) -> None:
    """Put new coefficients of the Gaussians of an object that depart into a tensor."""
    everywhere = torch.ones_like(replaced)
    for part in item.consensus.parts():
        chosen = part[departs[part]]
        if not len(chosen):
            continue
        basis = item.consensus.towards(chosen, everywhere).double()
        kept = item.consensus.colours(chosen, everywhere)
        wanted = predicted.colours[chosen][:, None]
        colours = torch.where(replaced[:, None], wanted, kept) - 0.5
        seen = torch.where(item.consensus.seen[chosen], 1.0, _UNSEEN)
        weights = torch.where(replaced, _STRICT, seen).double()
        solution = _fitted(basis, colours.double(), weights)
        turned = item.consensus.world_sh(solution)
        sh[item.consensus.rows[chosen]] = turned.to(sh)


def _fitted(basis: Tensor, colours: Tensor, weights: Tensor) -> Tensor:
    """(P, C, 3) coefficients of (P, K, C) basis values that fit (P, K, 3) colours."""
    is_high = torch.arange(basis.shape[-1]) > 0
    ridge = _RIDGE * weights.sum(1, keepdim=True) * is_high
    left = torch.einsum("mk,mki,mkj->mij", weights, basis, basis)
    right = torch.einsum("mk,mki,mkc->mic", weights, basis, colours)
    solution: Tensor = torch.linalg.solve(left + torch.diag_embed(ridge), right)
    return solution
