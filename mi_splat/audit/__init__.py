"""Audit of a splat: does it show something from some directions only, from where, and
which Gaussians carry it?

A *look* is an appearance that an object shows from some directions only, such as what
CLOAK hides. A *piece* is surface in one voxel that faces along one axis. *Gloss* is
what an honest surface shows as the camera moves: it follows the angle of incidence or a
mirrored direction. *Heat* says how much of a look each Gaussian carries.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mi_splat import _lazy

if TYPE_CHECKING:
    from mi_splat.audit.auditing import audit
    from mi_splat.audit.bound import Bounded, bounded, colour_bound
    from mi_splat.audit.held_out import HeldOut, held_out
    from mi_splat.audit.images import ImageAudit, audit_images
    from mi_splat.audit.repair import repaired
    from mi_splat.audit.results import Audit, Look, ObjectAudit, Occluder, Pair, Region

__all__ = [
    "Audit",
    "Bounded",
    "HeldOut",
    "ImageAudit",
    "Look",
    "ObjectAudit",
    "Occluder",
    "Pair",
    "Region",
    "audit",
    "audit_images",
    "bounded",
    "colour_bound",
    "held_out",
    "repaired",
]

__getattr__, __dir__ = _lazy.attach(
    __name__,
    {
        "mi_splat.audit.auditing": ("audit",),
        "mi_splat.audit.bound": ("Bounded", "bounded", "colour_bound"),
        "mi_splat.audit.held_out": ("HeldOut", "held_out"),
        "mi_splat.audit.images": ("ImageAudit", "audit_images"),
        "mi_splat.audit.repair": ("repaired",),
        "mi_splat.audit.results": (
            "Audit",
            "Look",
            "ObjectAudit",
            "Occluder",
            "Pair",
            "Region",
        ),
    },
)
