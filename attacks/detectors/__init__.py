"""Object detectors behind one seam: `load_detector(name)`."""

from __future__ import annotations

from attacks.detectors.base import Candidates, Detections, Detector

__all__ = ["Candidates", "Detections", "Detector"]
