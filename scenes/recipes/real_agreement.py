"""How often detectors report on a splat's renderings what they report on photographs.

    python -m scenes.recipes.real_agreement SET SPLAT --classes "teddy bear"

From every camera of a set, each detector looks at the photograph and at the rendering.
It agrees with itself where it detects the object in both, with boxes that overlap by
half, or in neither; at its operating threshold.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from attacks.detectors import load_detector
from attacks.detectors.base import Detections, Detector
from attacks.detectors.registry import operating_threshold
from attacks.objectives.base import overlap
from mi_splat.cameras.framing import near_plane
from mi_splat.datasets import load_dataset
from mi_splat.io import load_splat
from mi_splat.render.renderer import Renderer, RenderSettings

LEAST_OVERLAP = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """What one detector reports, counted over the cameras of one split."""

    detector: str
    split: str
    cameras: int
    in_photographs: int  # images in which the object is detected
    in_renderings: int
    agree: int  # cameras with the same answer in both

    def line(self) -> str:
        """A row of the table."""
        return (
            f"{self.detector:16} {self.split:5} photographs"
            f" {self.in_photographs}/{self.cameras}, renderings"
            f" {self.in_renderings}/{self.cameras}, agreement"
            f" {self.agree}/{self.cameras}"
        )


def best_box(found: Detections, classes: Sequence[str], least: float) -> Tensor | None:
    """(4,) the most confident box of some classes at or above a threshold."""
    best = None
    highest = least
    for box, score, label in zip(
        found.boxes, found.scores.tolist(), found.labels, strict=True
    ):
        if label in classes and score >= highest:
            best = box
            highest = score
    return best


def is_same(first: Tensor | None, second: Tensor | None) -> bool:
    """Whether two answers agree: neither, or boxes that overlap by half."""
    if first is None or second is None:
        return first is None and second is None
    return float(overlap(first[None].float(), second.float())[0]) >= LEAST_OVERLAP


def agreement(
    detector: Detector,
    photographs: Sequence[Tensor],
    renderings: Sequence[Tensor],
    *,
    classes: Sequence[str],
    split: str,
) -> Agreement:
    """Count over images (H, W, 3) in [0, 1], photographs beside renderings."""
    least = operating_threshold(detector)
    in_photographs = 0
    in_renderings = 0
    agree = 0
    for photograph, rendering in zip(photographs, renderings, strict=True):
        real = best_box(detector.detect(photograph[None])[0], classes, least)
        rendered = best_box(detector.detect(rendering[None])[0], classes, least)
        in_photographs += real is not None
        in_renderings += rendered is not None
        agree += is_same(real, rendered)
    return Agreement(
        detector=detector.name,
        split=split,
        cameras=len(photographs),
        in_photographs=in_photographs,
        in_renderings=in_renderings,
        agree=agree,
    )


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("set", type=Path)
    parser.add_argument("splat", type=Path)
    parser.add_argument("--classes", nargs="+", required=True)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument(
        "--detectors", nargs="+", default=["nanodet_coco", "centernet_coco"]
    )
    asked = parser.parse_args()
    scene = load_splat(asked.splat)
    for split in ("train", "test"):
        views = load_dataset(asked.set, split=split, downscale=asked.downscale)
        near = near_plane(scene, views.cameras)
        render = Renderer(RenderSettings(near=near))
        photographs = [view.image for view in views]
        with torch.no_grad():
            renderings = [render(scene, camera).clamp(0, 1) for camera in views.cameras]
        for name in asked.detectors:
            counted = agreement(
                load_detector(name),
                photographs,
                renderings,
                classes=asked.classes,
                split=split,
            )
            sys.stdout.write(counted.line() + "\n")


if __name__ == "__main__":
    main()
