"""What a detector reports on the pictures of a page."""

from __future__ import annotations

from dataclasses import dataclass

from PIL import ImageDraw
from torch import Tensor

from attacks.detectors.base import Detections, Detector
from attacks.observe.drawing import draw_detections
from mi_splat.viewer.exhibit import Inspector

MIN_CONFIDENCE = 0.3
"""Confidence from which a detection is shown."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class DetectorInspection:
    """What a detector reports on one picture.

    Attributes:
        detections: All of it.
        min_confidence: Confidence from which a detection is shown.
    """

    detections: Detections
    min_confidence: float = MIN_CONFIDENCE

    @property
    def text(self) -> str:
        """Classes and confidences, best first."""
        rows = zip(self.detections.labels, self.detections.scores.tolist(), strict=True)
        shown = [f"{label} {score:.1%}" for label, score in rows if score >= self.min_confidence]
        return ", ".join(shown) or f"nothing at {self.min_confidence:.0%} or more"

    def draw(self, draw: ImageDraw.ImageDraw, scale: float) -> None:
        """As in `mi_splat.viewer.exhibit.Inspection`."""
        draw_detections(draw, self.detections, scale=scale, min_confidence=self.min_confidence)


def detector_inspector(detector: Detector, *, min_confidence: float = MIN_CONFIDENCE) -> Inspector:
    """Lets a detector look at the pictures of a page, as it looks at those of an evaluation."""

    def inspect(picture: Tensor) -> DetectorInspection:
        (found,) = detector.detect(picture[None])
        return DetectorInspection(detections=found, min_confidence=min_confidence)

    return inspect
