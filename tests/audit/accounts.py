"""Accounts of audits that were never made: of one object that somebody could have
judged.
"""

import torch

from mi_splat.audit import Audit, Look, ObjectAudit, Occluder, Pair, Region
from mi_splat.audit.thresholds import LIMITS
from mi_splat.audit.viewpoints import lattice
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens

DIRECTIONS = lattice(40, 5.0, 85.0)


def camera(*eye: float) -> Camera:
    return Camera(
        to_world=look_at(eye, (0.0, 0.0, 0.0)), lens=Lens(focal=20.0, size=(16, 16))
    )


def look(score: float = 0.05, *, above: float = 0.7) -> Look:
    """From above; hidden from a score of 0.01 on."""
    return Look(
        region=Region(axis=(0.0, 0.0, 1.0), half_width=45.0),
        shown=DIRECTIONS[:, 2] > above,
        amounts=(DIRECTIONS[:, 2] > above).float(),
        direction=score / 10,
        incidence=score / 80,
        mirror=score / 40,
        net=100 * score * LIMITS.net,
        threshold=LIMITS.net,
        lost=0.0,
        air=1.0,
        changed=0.5,
        given=False,
        pair=Pair(
            inside=camera(0.5, 0.0, 3.0),
            outside=camera(3.0, 0.0, 0.5),
            change=0.2,
            numbers=(39, 0),
        ),
    )


def account(*looks: Look, count: int, covered: float = 0.0) -> Audit:
    """Of a splat of so many Gaussians, the first half an object with these looks,
    covered from above or not.
    """
    half = torch.arange(count) < count // 2
    item = ObjectAudit(
        rows=half.nonzero()[:, 0],
        centre=(0.0, 0.0, 0.0),
        radius=1.0,
        up=(0.0, 0.0, 1.0),
        directions=DIRECTIONS,
        pieces=100,
        area=4.0,
        uncontradicted=1.0,
        cameras=tuple(camera(*position) for position in (3 * DIRECTIONS).tolist()),
        looks=looks,
        occluder=Occluder(
            axis=(0.0, 0.0, 1.0),
            blocked=(DIRECTIONS[:, 2] > 0.5).double(),
            transparent=0.8,
            score=covered,
        ),
    )
    marked = half if item.evidence >= LIMITS.suspicion else torch.zeros_like(half)
    return Audit(objects=(item,), heat=marked.float(), mask=marked, near=0.8)
