"""How `fcos_small` is trained by the loop of `attacks.detectors.training.loop`."""

from __future__ import annotations

from torch import Generator, Tensor, nn
from torchvision.models.detection import FCOS

from attacks.detectors import small_fcos
from attacks.detectors.base import Detector
from attacks.detectors.classes import BACKGROUND, SMALL_CLASSES, SMALL_SIDE
from attacks.detectors.torchvision import wrap
from attacks.detectors.training.loop import Targets
from attacks.detectors.training.pretraining import CutOutTrainer


class FCOSTrainer(CutOutTrainer):
    """The small FCOS; every cell learns from every picture, so its last epochs are like the others."""

    name = "fcos_small"

    def build(self) -> nn.Module:
        """See `DetectorTrainer`."""
        model: nn.Module = small_fcos.build()
        return model

    def begin_epoch(self, model: nn.Module, *, side: int | None, final: bool) -> None:
        """See `DetectorTrainer`."""
        assert isinstance(model, FCOS)
        model.transform.min_size = (side or SMALL_SIDE,)

    def losses(
        self, model: nn.Module, pictures: list[Tensor], targets: Targets, generator: Generator
    ) -> dict[str, Tensor]:
        """As in `DetectorTrainer`: the library's own."""
        losses: dict[str, Tensor] = model(pictures, targets)
        return losses

    def detector(self, model: nn.Module) -> Detector:
        """See `DetectorTrainer`."""
        return wrap(self.name, model, (BACKGROUND, *SMALL_CLASSES))
