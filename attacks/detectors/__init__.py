"""Object detectors behind one interface: `load_detector(name)`.

Importing this package is light; torchvision is imported when a detector is loaded, and ultralytics
(the extra `yolo`, AGPL-3.0) when it is one of YOLO's.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from functools import partial
from pathlib import Path

from attacks.detectors.base import Candidates, Detections, Detector
from attacks.detectors.weights import DetectorError
from mi_splat.errors import message

__all__ = ["DETECTORS", "Candidates", "Detections", "Detector", "DetectorError", "load_detector"]


def _small(weights: Path | None) -> Detector:
    from attacks.detectors.torchvision import load_small

    return load_small(weights)


def _published(name: str, weights: Path | None) -> Detector:
    from attacks.detectors.torchvision import load_published

    return load_published(name, weights)


def _small_yolo(weights: Path | None) -> Detector:
    from attacks.detectors.ultralytics import load_small

    return load_small(weights)


def _published_yolo(name: str, weights: Path | None) -> Detector:
    from attacks.detectors.ultralytics import load_published

    return load_published(name, weights)


DETECTORS: dict[str, Callable[[Path | None], Detector]] = {
    "fasterrcnn_small": _small,
    **{
        name: partial(_published, name)
        for name in (
            "fasterrcnn_resnet50_fpn",
            "fasterrcnn_resnet50_fpn_v2",
            "fasterrcnn_mobilenet_v3_large_fpn",
            "fasterrcnn_mobilenet_v3_large_320_fpn",
        )
    },
    "yolov8n_small": _small_yolo,
    **{name: partial(_published_yolo, name) for name in ("yolov8n", "yolov8s", "yolov8m", "yolov8l", "yolov8x")},
}
"""Name to loader; a loader takes the weights' path, or None for what is shipped or published."""


def load_detector(name: str, *, weights: Path | None = None) -> Detector:
    """Load a detector in evaluation mode.

    Args:
        name: Key of `DETECTORS`.
        weights: .safetensors or .pth file. None: the weights shipped with this package (`fasterrcnn_small`), or the
            library's own download.

    Raises:
        DetectorError: there is no such detector, or its weights are missing or do not fit.
    """
    if name not in DETECTORS:
        near = difflib.get_close_matches(name, DETECTORS, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]}?" if near else "choose one of them"
        raise DetectorError(message("detector", " or ".join(DETECTORS), repr(name), hint))
    return DETECTORS[name](weights)
