"""How `fasterrcnn_small` is trained by the loop of `attacks.detectors.training.loop`."""

from __future__ import annotations

from torch import Generator, Tensor, nn
from torchvision.models.detection import FasterRCNN
from torchvision.models.detection._utils import BalancedPositiveNegativeSampler

from attacks.detectors import fasterrcnn_small
from attacks.detectors.base import Detector
from attacks.detectors.catalogue import SMALL_CLASSES, SMALL_SIDE
from attacks.detectors.torchvision import RCNNDetector
from attacks.detectors.training.loop import Targets
from attacks.detectors.training.pretraining import CutOutTrainer

_USUAL_SAMPLER, _FINAL_SAMPLER = (32, 0.5), (96, 0.25)
"""Boxes a picture that the box head learns from, and the largest fraction of them with an object."""


class FasterRCNNTrainer(CutOutTrainer):
    """The small Faster R-CNN; in its last epochs the box head learns from more boxes, fewer of them with an object."""

    name = "fasterrcnn_small"

    def build(self) -> nn.Module:
        """See `DetectorTrainer`."""
        model: nn.Module = fasterrcnn_small.build()
        return model

    def begin_epoch(self, model: nn.Module, *, side: int | None, final: bool) -> None:
        """See `DetectorTrainer`."""
        assert isinstance(model, FasterRCNN)
        model.transform.min_size = (side or SMALL_SIDE,)
        model.roi_heads.fg_bg_sampler = BalancedPositiveNegativeSampler(*(_FINAL_SAMPLER if final else _USUAL_SAMPLER))

    def losses(
        self, model: nn.Module, pictures: list[Tensor], targets: Targets, generator: Generator
    ) -> dict[str, Tensor]:
        """As in `DetectorTrainer`: the library's own."""
        losses: dict[str, Tensor] = model(pictures, targets)
        return losses

    def detector(self, model: nn.Module) -> Detector:
        """See `DetectorTrainer`."""
        assert isinstance(model, FasterRCNN)
        return RCNNDetector(self.name, model, ("__background__", *SMALL_CLASSES))
