"""Repairs a splat: what the believed directions predict becomes what it shows.

Towards believed directions a Gaussian keeps its colours, and towards the others it gets
their median, by least squares over its spherical harmonics; what shows almost only from
the others and hides the object is removed. What is left behind it may be see-through,
because a training never needed more; then a second candidate is made solid, and the
audit's detector decides between the two. No file can tell which appearance is the true
one.
"""

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from mi_splat.audit.held_out import Prediction
from mi_splat.audit.results import Audit, ConeView, ObjectAudit
from mi_splat.maths.sh import colour_to_dc
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
_THICKER = 10.0  # times the optical depth of what is made solid, at first
_STEPS = 150  # in which it gets its colours and opacities,
_RATE = 0.02  # the learning rate of these colours,
_RATE_OF_LOGITS = 0.05  # and of logits of opacities
# weight of the mean opacity against the error of the images
_OPAQUE = 0.03
_EVEN = 1e-4  # opacity by which a logit stays finite
# degrees beside a cone that are not believed then, as SH of degree 3 set in gradually
_SETS_IN = 20.0


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
        made = _candidate(current, judged, keep)
        changed = (made.scene.sh != current.sh).flatten(1).any(1)
        if not bool(changed.any()) and bool(made.stays.all()):
            break
        after = again(made.left)
        if not bool(made.stays.all()):
            solid = _candidate(current, judged, keep, is_solid=True)
            known = again(solid.left)
            if _surer(judged, known) > _surer(judged, after):
                made, after = solid, known
                changed = (made.scene.sh != current.sh).flatten(1).any(1)
        coloured[present[changed & made.stays]] = True
        present = present[made.stays]
        current = made.left
        judged = after
    left_out = len(scene) - len(present)
    is_same = len(present) == len(scene) and not bool(coloured.any())
    return Repair(
        scene if is_same else current, int(coloured[present].sum()), left_out, judged
    )


class _Candidate(NamedTuple):
    """A splat after a round, and (N,) bool which of its Gaussians stay."""

    scene: GaussianScene
    stays: Tensor

    @property
    def left(self) -> GaussianScene:
        """Those that stay."""
        return self.scene.select(self.stays.nonzero()[:, 0])


def _surer(before: Audit, after: Audit) -> tuple[bool, float]:
    """How well a candidate shows what was known before: not contradicted, and by the
    mean confidence in its class over all cones.
    """
    names = {item.known_as for item in before.objects if item.known_as is not None}
    scores = [
        view.file_score if view.known_as in names else 0.0 for view in after.views
    ]
    return after.answer != "contradicted", sum(scores) / max(len(scores), 1)


def _candidate(
    scene: GaussianScene, judged: Audit, keep: Keep, *, is_solid: bool = False
) -> _Candidate:
    """The splat after the clearest cone of each object was repaired."""
    sh = scene.sh.clone()
    opacities = scene.opacities.clone()
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
        if worst.peeled and is_solid and keep == "outside":
            _make_solid(sh, opacities, item, worst, predicted)
    return _Candidate(scene.replace(sh=sh, opacities=opacities), stays)


def _make_solid(
    sh: Tensor,
    opacities: Tensor,
    item: ObjectAudit,
    cone: ConeView,
    predicted: Prediction,
) -> None:
    """Make what a lid leaves of an object opaque, in colours that are the same from
    everywhere and keep what the believed directions see.
    """
    consensus = item.consensus
    left = consensus.scene.select((~predicted.lid).nonzero()[:, 0])
    own = consensus.own[~predicted.lid]
    through = (1 - left.opacities[own]).clamp(min=1e-6)
    solid = (1 - through**_THICKER).clamp(_EVEN, 1 - _EVEN)
    logits = solid.logit().requires_grad_()
    dc = colour_to_dc(predicted.colours[~predicted.lid][own]).requires_grad_()
    optimiser = torch.optim.Adam(
        [{"params": [dc], "lr": _RATE}, {"params": [logits], "lr": _RATE_OF_LOGITS}]
    )
    numbers = _believed(item, cone).nonzero()[:, 0].tolist()
    wanted = consensus.images(consensus.scene, numbers)
    for step in range(_STEPS):
        at = step % len(numbers)
        scene = _with_own(left, own, dc, logits.sigmoid())
        shown = consensus.rendered(scene, numbers[at : at + 1])[0]
        error = (shown - wanted[at]).abs().mean()
        loss = error - _OPAQUE * logits.sigmoid().mean()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    rows = consensus.rows[~predicted.lid][own]
    opacities[rows] = logits.detach().sigmoid()
    sh[rows] = 0
    sh[rows, 0] = dc.detach()


def _with_own(
    scene: GaussianScene, own: Tensor, dc: Tensor, opacities: Tensor
) -> GaussianScene:
    """A splat some of whose Gaussians have other opacities, and one colour each."""
    constant = torch.zeros_like(scene.sh)
    constant[own, 0] = dc
    sh = torch.where(own[:, None, None], constant, scene.sh)
    changed = scene.opacities.clone()
    changed[own] = opacities
    return GaussianScene.unchecked(*scene.tensors()[:3], changed, sh)


def _believed(item: ObjectAudit, cone: ConeView) -> Tensor:
    """(K,) bool, the directions outside of a cone in which nothing of it sets in; all
    of those outside where these are too few.
    """
    axis = item.directions.new_tensor(cone.region.axis)
    edge = math.radians(min(cone.region.half_width + _SETS_IN, 180.0))
    far = ~cone.inside & (item.directions @ axis < math.cos(edge))
    is_enough = int(far.sum()) >= item.consensus.config.least_outside
    return far if is_enough else ~cone.inside


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
