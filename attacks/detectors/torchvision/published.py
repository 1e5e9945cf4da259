"""torchvision's published COCO detectors: how each is built, and where its weights come from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn
from torchvision.models import detection
from torchvision.ops import FrozenBatchNorm2d

from attacks.detectors.errors import DetectorError
from attacks.detectors.weight_files import elsewhere
from mi_splat.errors import message


@dataclass(frozen=True, slots=True)
class Published:
    """A detector that the library has weights for.

    Attributes:
        builder: The library's function of its name.
        weights: The library's entry for its COCO weights.
        frozen_eps: Eps of the frozen norms with which the library evaluates these weights; None where its norms are as
            the builder makes them.
    """

    builder: Callable[..., nn.Module]
    weights: Any
    frozen_eps: float | None = None


PUBLISHED: dict[str, Published] = {
    "fasterrcnn_resnet50_fpn": Published(
        detection.fasterrcnn_resnet50_fpn, detection.FasterRCNN_ResNet50_FPN_Weights.COCO_V1, frozen_eps=0.0
    ),
    "fasterrcnn_resnet50_fpn_v2": Published(
        detection.fasterrcnn_resnet50_fpn_v2, detection.FasterRCNN_ResNet50_FPN_V2_Weights.COCO_V1
    ),
    "fasterrcnn_mobilenet_v3_large_fpn": Published(
        detection.fasterrcnn_mobilenet_v3_large_fpn, detection.FasterRCNN_MobileNet_V3_Large_FPN_Weights.COCO_V1
    ),
    "fasterrcnn_mobilenet_v3_large_320_fpn": Published(
        detection.fasterrcnn_mobilenet_v3_large_320_fpn, detection.FasterRCNN_MobileNet_V3_Large_320_FPN_Weights.COCO_V1
    ),
    "retinanet_resnet50_fpn": Published(
        detection.retinanet_resnet50_fpn, detection.RetinaNet_ResNet50_FPN_Weights.COCO_V1, frozen_eps=0.0
    ),
    "retinanet_resnet50_fpn_v2": Published(
        detection.retinanet_resnet50_fpn_v2, detection.RetinaNet_ResNet50_FPN_V2_Weights.COCO_V1
    ),
    "fcos_resnet50_fpn": Published(detection.fcos_resnet50_fpn, detection.FCOS_ResNet50_FPN_Weights.COCO_V1),
    "ssdlite320_mobilenet_v3_large": Published(
        detection.ssdlite320_mobilenet_v3_large, detection.SSDLite320_MobileNet_V3_Large_Weights.COCO_V1
    ),
    "ssd300_vgg16": Published(detection.ssd300_vgg16, detection.SSD300_VGG16_Weights.COCO_V1),
}


def build_published(name: str) -> nn.Module:
    """A published detector with random weights, its norms in the form in which the library evaluates the published."""
    model = PUBLISHED[name].builder(weights=None, weights_backbone=None)
    freeze_norms(name, model)
    return model


def freeze_norms(name: str, model: nn.Module) -> None:
    """Put the library's frozen norms in place, where it evaluates the published weights with them."""
    eps = PUBLISHED[name].frozen_eps
    if eps is not None:
        _freeze(model, eps)


def published_labels(name: str) -> tuple[str, ...]:
    """What the library's label numbers mean; COCO's numbers have gaps, which it calls N/A."""
    return tuple(PUBLISHED[name].weights.meta["categories"])


def from_hub(name: str) -> dict[str, Tensor]:
    """The published weights, from the library's own download.

    Raises:
        DetectorError: The hub cannot be reached.
    """
    weights = PUBLISHED[name].weights
    try:
        state: dict[str, Tensor] = weights.get_state_dict(progress=True, check_hash=True, weights_only=True)
    except (OSError, RuntimeError) as error:  # no network, or a download whose hash does not fit
        raise DetectorError(
            message(
                f"weights of {name}",
                "a weights file, or a network that reaches the library's hub",
                str(error).splitlines()[0] if str(error) else type(error).__name__,
                elsewhere("file"),
            )
        ) from error
    return state


def _freeze(module: nn.Module, eps: float) -> None:
    for name, child in module.named_children():
        if isinstance(child, nn.BatchNorm2d):
            frozen = FrozenBatchNorm2d(child.num_features, eps=eps)
            frozen.load_state_dict(child.state_dict())
            setattr(module, name, frozen)
        else:
            _freeze(child, eps)
