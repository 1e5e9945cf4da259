"""Object detectors behind one interface: `load_detector(name)`, and
`wrap_detector(module, ...)` for one of your own.

Importing this package is light: torch comes with the first detector that is loaded, and
ultralytics (the extra `yolo`, AGPL-3.0) with the first one of YOLO's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mi_splat import _lazy

if TYPE_CHECKING:
    from attacks.detectors.base import Candidates, Detections, Detector
    from attacks.detectors.catalogue import DetectorError
    from attacks.detectors.registry import (
        DETECTORS,
        DetectorSpec,
        load_detector,
        register_detector,
    )
    from attacks.detectors.wrapping import wrap_detector

__all__ = [
    "DETECTORS",
    "Candidates",
    "Detections",
    "Detector",
    "DetectorError",
    "DetectorSpec",
    "load_detector",
    "register_detector",
    "wrap_detector",
]

__getattr__, __dir__ = _lazy.attach(
    __name__,
    {
        "attacks.detectors.base": ("Candidates", "Detections", "Detector"),
        "attacks.detectors.catalogue": ("DetectorError",),
        "attacks.detectors.registry": (
            "DETECTORS",
            "DetectorSpec",
            "load_detector",
            "register_detector",
        ),
        "attacks.detectors.wrapping": ("wrap_detector",),
    },
)
