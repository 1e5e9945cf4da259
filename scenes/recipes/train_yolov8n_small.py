"""Trains `yolov8n_small`, with the losses of ultralytics:
`python -m scenes.recipes.train_yolov8n_small`.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Generator, Tensor, nn

from attacks.detectors.base import Detector
from attacks.detectors.catalogue import SMALL_CLASSES, SMALL_SIDE
from attacks.detectors.ultralytics import YOLODetector, build
from scenes.recipes.detector_pictures import LabelledPicture
from scenes.recipes.detector_training import Targets, TrainConfig, main

_MIN_CONFIDENCE = 0.001
"""Confidence of detections that count in an average precision."""
_MOSAIC_FRACTION = 0.5
"""Fraction of a batch that is made of four images each, but for the last epochs."""


class YOLOTrainer:
    """The small YOLOv8.

    A cell learns from every image, so four images in one teach four times as much.
    """

    def __init__(self) -> None:
        self._side: int | None = None
        self._mosaic_fraction = _MOSAIC_FRACTION

    def build(self) -> nn.Module:
        """The network with random weights."""
        return build("n", len(SMALL_CLASSES))

    def begin_epoch(self, model: nn.Module, *, side: int | None, final: bool) -> None:
        """Set the image side; the last epochs have no mosaics."""
        self._side = side
        self._mosaic_fraction = 0.0 if final else _MOSAIC_FRACTION

    def pretrain(
        self, model: nn.Module, pictures: Sequence[LabelledPicture], config: TrainConfig
    ) -> None:
        """Nothing is done."""

    def losses(
        self,
        model: nn.Module,
        pictures: list[Tensor],
        targets: Targets,
        generator: Generator,
    ) -> dict[str, Tensor]:
        """The library's three, per image."""
        pictures, targets = with_mosaics(
            pictures, targets, self._mosaic_fraction, generator
        )
        planes = torch.stack(pictures)
        height, width = planes.shape[2:]
        if self._side is not None:
            planes = F.interpolate(
                planes, size=(self._side, self._side), mode="bilinear", antialias=True
            )
        predictions = model(planes.contiguous(memory_format=torch.channels_last))
        corners = torch.cat([t["boxes"] for t in targets]) / torch.tensor(
            [width, height, width, height]
        )
        batch = {
            "img": planes,
            "batch_idx": torch.cat(
                [
                    torch.full((len(t["labels"]),), float(i))
                    for i, t in enumerate(targets)
                ]
            ),
            "cls": torch.cat([t["labels"] for t in targets]).float()[:, None] - 1,
            "bboxes": torch.cat(
                [
                    (corners[:, :2] + corners[:, 2:]) / 2,
                    corners[:, 2:] - corners[:, :2],
                ],
                1,
            ),
        }
        with torch.autocast("cpu", enabled=False):
            single = {
                key: (
                    [part.float() for part in value]
                    if isinstance(value, list)
                    else value.float()
                )
                for key, value in predictions.items()
            }
            total, parts = model.loss(batch, single)  # type: ignore[operator]
        return dict(zip(parts, total / len(pictures), strict=True))

    def detector(self, model: nn.Module) -> Detector:
        """The network behind the `Detector` interface."""
        return YOLODetector(
            "yolov8n_small",
            model,
            SMALL_CLASSES,
            side=SMALL_SIDE,
            min_confidence=_MIN_CONFIDENCE,
        )


def with_mosaics(
    pictures: list[Tensor], targets: Targets, fraction: float, generator: Generator
) -> tuple[list[Tensor], Targets]:
    """A batch of which a fraction is replaced by mosaics of its images."""
    count = len(pictures)
    made = list(pictures)
    inside = list(targets)
    for i in range(int(fraction * count)):
        four = torch.randint(count, (4,), generator=generator).tolist()
        made[i], inside[i] = mosaic(
            [pictures[j] for j in four], [targets[j] for j in four]
        )
    return made, inside


def mosaic(
    pictures: Sequence[Tensor], targets: Targets
) -> tuple[Tensor, dict[str, Tensor]]:
    """Four images at half their size in one of the same size, and what is in it."""
    height, width = pictures[0].shape[1:]
    half = (height // 2, width // 2)
    whole = torch.zeros_like(pictures[0])
    boxes = []
    labels = []
    for quarter, (picture, target) in enumerate(zip(pictures, targets, strict=True)):
        top = (quarter // 2) * half[0]
        left = (quarter % 2) * half[1]
        small = F.interpolate(
            picture[None], size=half, mode="bilinear", antialias=True
        )[0]
        whole[:, top : top + half[0], left : left + half[1]] = small
        scale = torch.tensor([half[1] / width, half[0] / height] * 2)
        boxes.append(target["boxes"] * scale + torch.tensor([left, top, left, top]))
        labels.append(target["labels"])
    return whole, {"boxes": torch.cat(boxes), "labels": torch.cat(labels)}


if __name__ == "__main__":
    usual = TrainConfig(
        pretraining=0,
        epochs=24,
        batch=16,
        low_resolution_fraction=0.54,
        final_fraction=0.13,
    )
    main(YOLOTrainer(), usual, __doc__)
