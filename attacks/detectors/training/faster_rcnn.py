"""How `fasterrcnn_small` is trained by the loop of `attacks.detectors.training.loop`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torch import Generator, Tensor, nn
from torchvision.models.detection import FasterRCNN
from torchvision.models.detection._utils import BalancedPositiveNegativeSampler

from attacks.detectors import small
from attacks.detectors.base import Detector
from attacks.detectors.torchvision import RCNNDetector
from attacks.detectors.training.loop import Targets, TrainConfig
from attacks.detectors.training.pictures import Sample
from attacks.detectors.training.pretraining import pretrain

_EAGER, _SETTLED = (32, 0.5), (96, 0.25)
"""Boxes a picture that the box head learns from, and the largest fraction of them with an object."""


class RCNNTrainee:
    """The small Faster R-CNN; its calmer epochs have more boxes a picture, and fewer of them with an object."""

    name = "fasterrcnn_small"

    def build(self) -> nn.Module:
        """See `Trainee`."""
        model: nn.Module = small.build()
        return model

    def begin_epoch(self, model: nn.Module, *, side: int | None, settled: bool) -> None:
        """See `Trainee`."""
        assert isinstance(model, FasterRCNN)
        model.transform.min_size = (side or small.SIZE,)
        model.roi_heads.fg_bg_sampler = BalancedPositiveNegativeSampler(*(_SETTLED if settled else _EAGER))

    def losses(
        self, model: nn.Module, pictures: list[Tensor], targets: Targets, generator: Generator
    ) -> dict[str, Tensor]:
        """The library's own."""
        losses: dict[str, Tensor] = model(pictures, targets)
        return losses

    def pretrain(
        self,
        model: nn.Module,
        samples: Sequence[Sample],
        config: TrainConfig,
        on_step: Callable[[int, int, float], None] | None,
    ) -> float | None:
        """Name cut-outs; see `attacks.detectors.training.pretraining`."""
        assert isinstance(model, FasterRCNN)
        return pretrain(
            model.backbone,
            samples,
            steps=config.pretraining,
            seed=config.seed,
            mixed=config.mixed,
            on_step=on_step,
        )

    def detector(self, model: nn.Module) -> Detector:
        """See `Trainee`."""
        assert isinstance(model, FasterRCNN)
        return RCNNDetector(self.name, model, ("__background__", *small.CLASSES))
