"""Audit of a splat: does it show something from some directions that contradicts all
others, from where, and which Gaussians carry it?

`audit` predicts what each cone of directions shows from the other directions, and
compares that with the file. `audit_images` compares the images of a set before any
training, `bounded` writes a copy whose colours depend on the direction by no more than
a bound.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mi_splat import _lazy

if TYPE_CHECKING:
    from mi_splat.audit.auditing import audit
    from mi_splat.audit.bound import Bounded, bounded, colour_bound
    from mi_splat.audit.held_out import HeldOutConfig, Recogniser
    from mi_splat.audit.images import ImageAudit, audit_images
    from mi_splat.audit.repair import Repair, repaired
    from mi_splat.audit.results import Answer, Audit, ConeView, ObjectAudit, Region

__all__ = [
    "Answer",
    "Audit",
    "Bounded",
    "ConeView",
    "HeldOutConfig",
    "ImageAudit",
    "ObjectAudit",
    "Recogniser",
    "Region",
    "Repair",
    "audit",
    "audit_images",
    "bounded",
    "colour_bound",
    "repaired",
]

__getattr__, __dir__ = _lazy.attach(
    __name__,
    {
        "mi_splat.audit.auditing": ("audit",),
        "mi_splat.audit.bound": ("Bounded", "bounded", "colour_bound"),
        "mi_splat.audit.held_out": ("HeldOutConfig", "Recogniser"),
        "mi_splat.audit.images": ("ImageAudit", "audit_images"),
        "mi_splat.audit.repair": ("Repair", "repaired"),
        "mi_splat.audit.results": (
            "Answer",
            "Audit",
            "ConeView",
            "ObjectAudit",
            "Region",
        ),
    },
)
