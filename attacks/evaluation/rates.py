"""Scoring of finished scenes, apart from any attack: which scene, in which view, by which detector, sees what.

The same object is looked at in a clean scene and in any number of others (attacked, noisy, defended). A rate is given
in both forms that reviewers ask for: over all views, and over those where the clean object was found in the first
place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from attacks.detectors.base import Detections, Detector
from attacks.evaluation.visibility import visible_box, visible_weight
from attacks.gaussian_subset import GaussianSubset
from attacks.objectives import confidence
from mi_splat.cameras import Camera, RenderFn
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.images import through_png
from mi_splat.scene import GaussianScene

CLEAN = "clean"
"""Name of the scene that benign detection is judged on."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ViewDetections:
    """One scene in one view as one detector sees it.

    Attributes:
        scene: Name of the scene.
        detector: Name of the detector.
        view: Index of the camera.
        box: (4,) pixels, where the object is visible in the clean scene; None when it is not.
        detections: What the detector reports on the 8-bit picture.
    """

    scene: str
    detector: str
    view: int
    box: torch.Tensor | None
    detections: Detections

    def confidence(self, label: str | None = None, *, iou: float = 0.5) -> float:
        """Highest score of `label` (any class if None) on the object; 0 when the object is not visible."""
        if self.box is None:
            return 0.0
        return confidence(self.detections, self.box, labels=None if label is None else [label], iou=iou)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """A fraction of views with its 95 % Wilson interval; `fraction` is 0 when there are no views."""

    successes: int
    total: int

    @property
    def fraction(self) -> float:
        """Successes over total."""
        return self.successes / self.total if self.total else 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson score interval (Wilson 1927); (0, 1) when there are no views."""
        if not self.total:
            return 0.0, 1.0
        z, n, p = 1.959963984540054, self.total, self.fraction
        centre = (p + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
        return max(0.0, centre - half), min(1.0, centre + half)


def evaluate(
    scenes: Mapping[str, GaussianScene],
    mask: torch.Tensor | slice,
    cameras: Sequence[Camera],
    detectors: Sequence[Detector],
    *,
    render: RenderFn,
) -> list[ViewDetections]:
    """Look at every scene from every camera with every detector.

    Args:
        scenes: Scenes by name, with the same Gaussians in the same order; one must be called "clean".
        mask: The object's Gaussians.
        cameras: Views; better others than those that were attacked.
        detectors: Any number; the picture is rendered once for all.
        render: The renderer.

    Raises:
        InvalidValueError: No scene is called "clean".
    """
    if CLEAN not in scenes:
        raise InvalidValueError(message("scenes", f"one of the name {CLEAN}", list(scenes), "add the unattacked scene"))
    subset, frames = GaussianSubset.of(scenes[CLEAN], mask), []
    for view, camera in enumerate(cameras):
        box = visible_box(visible_weight(subset, camera, render))
        for name, scene in scenes.items():
            with torch.no_grad():
                picture = through_png(render(scene, camera))
                for detector in detectors:
                    seen = detector.detect(picture[None])[0]
                    frames.append(
                        ViewDetections(scene=name, detector=detector.name, view=view, box=box, detections=seen)
                    )
    return frames


def rates(
    frames: Sequence[ViewDetections],
    scene: str,
    detector: str,
    *,
    original: str,
    wanted: str | None,
    least: float = 0.5,
) -> dict[str, Rate]:
    """How often an attack reaches its aim.

    Args:
        frames: From `evaluate`.
        scene: Name of the attacked scene.
        detector: Name of the detector.
        original: What the object is.
        wanted: What the attacker wants it to be; None counts a view as a success when `original` is gone.
        least: Score from which a detection counts.

    Returns:
        `all`: over all views in which the object is visible; `given_found`: over those where the clean object is found.
    """
    table = {(f.scene, f.view): f for f in frames if f.detector == detector and f.box is not None}
    views = sorted(view for name, view in table if name == scene)
    found = [view for view in views if table[CLEAN, view].confidence(original) >= least]

    def reaches(view: int) -> bool:
        if wanted is None:
            return table[scene, view].confidence(original) < least
        return table[scene, view].confidence(wanted) >= least

    return {
        "all": Rate(successes=sum(map(reaches, views)), total=len(views)),
        "given_found": Rate(successes=sum(map(reaches, found)), total=len(found)),
    }
