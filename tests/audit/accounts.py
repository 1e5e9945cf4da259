"""Accounts of audits that were never made: of one object that somebody could have
judged.
"""

from types import SimpleNamespace
from typing import Any, cast

import torch

from mi_splat.audit import Answer, Audit, ConeView, HeldOutConfig, ObjectAudit, Region
from mi_splat.audit.viewpoints import lattice
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens

DIRECTIONS = lattice(40, 5.0, 85.0)
UP = (0.0, 0.0, 1.0)
_EVIDENCE: dict[Answer, float] = {"consistent": 0.1, "differs": 0.8, "contradicted": 2}


def camera(*eye: float) -> Camera:
    return Camera(
        to_world=look_at(eye, (0.0, 0.0, 0.0)), lens=Lens(focal=20.0, size=(16, 16))
    )


def cone(answer: Answer, *, above: float = 0.7, gain: float = 0.0) -> ConeView:
    """From above."""
    return ConeView(
        object=0,
        region=Region(axis=UP, half_width=45.0),
        up=UP,
        inside=DIRECTIONS[:, 2] > above,
        cameras=(camera(0.5, 0.0, 3.0),),
        file=torch.zeros(1, 16, 16, 3),
        prediction=torch.ones(1, 16, 16, 3),
        peeled=False,
        distance=0.3,
        rise=0.05,
        file_score=0.1,
        gain=gain,
        known_as="car",
        evidence=_EVIDENCE[answer],
        answer=answer,
    )


def account(*views: ConeView, count: int) -> Audit:
    """Of a splat of so many Gaussians, the first half an object with these cones."""
    half = torch.arange(count) < count // 2
    item = ObjectAudit(
        rows=half.nonzero()[:, 0],
        centre=(0.0, 0.0, 0.0),
        radius=1.0,
        up=UP,
        known_as="car",
        directions=DIRECTIONS,
        views=views,
        consensus=cast(Any, SimpleNamespace()),
    )
    marked = half if item.answer == "contradicted" else torch.zeros_like(half)
    return Audit(
        objects=(item,),
        heat=marked.float(),
        mask=marked,
        near=0.8,
        missing="",
        config=HeldOutConfig(),
    )
