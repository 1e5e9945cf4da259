"""Adapter to torchvision's Faster R-CNN family: the published COCO detectors and our own small one."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torchvision.models import detection
from torchvision.models.detection import FasterRCNN
from torchvision.models.detection.transform import resize_boxes
from torchvision.ops import FrozenBatchNorm2d
from torchvision.ops.boxes import clip_boxes_to_image

from attacks.detectors import small
from attacks.detectors.base import Candidates, Detections, check_images
from attacks.detectors.classes import SMALL_CLASSES
from attacks.detectors.errors import DetectorError
from attacks.detectors.weight_files import SMALL_RCNN_WEIGHTS
from attacks.detectors.weights import apply_weights, fingerprint, read_weights
from mi_splat.errors import message

_PUBLISHED = {
    "fasterrcnn_resnet50_fpn": detection.FasterRCNN_ResNet50_FPN_Weights.COCO_V1,
    "fasterrcnn_resnet50_fpn_v2": detection.FasterRCNN_ResNet50_FPN_V2_Weights.COCO_V1,
    "fasterrcnn_mobilenet_v3_large_fpn": detection.FasterRCNN_MobileNet_V3_Large_FPN_Weights.COCO_V1,
    "fasterrcnn_mobilenet_v3_large_320_fpn": detection.FasterRCNN_MobileNet_V3_Large_320_FPN_Weights.COCO_V1,
}
_BUILDERS: dict[str, Callable[..., FasterRCNN]] = {
    "fasterrcnn_resnet50_fpn": detection.fasterrcnn_resnet50_fpn,
    "fasterrcnn_resnet50_fpn_v2": detection.fasterrcnn_resnet50_fpn_v2,
    "fasterrcnn_mobilenet_v3_large_fpn": detection.fasterrcnn_mobilenet_v3_large_fpn,
    "fasterrcnn_mobilenet_v3_large_320_fpn": detection.fasterrcnn_mobilenet_v3_large_320_fpn,
}
_FROZEN_EPS = {"fasterrcnn_resnet50_fpn": 0.0}  # the library evaluates these weights with eps 0 in its frozen norms
_BACKGROUND, _UNUSED = "__background__", "N/A"


class RCNNDetector:
    """A frozen torchvision Faster R-CNN behind the `Detector` interface.

    Attributes:
        name: Name in `attacks.detectors.DETECTORS`.
        classes: Foreground classes; COCO's unused numbers ("N/A") are left out of them.
        model: The library's model, in evaluation mode, its weights without gradients.
    """

    name: str
    classes: tuple[str, ...]

    def __init__(self, name: str, model: FasterRCNN, labels: Sequence[str]) -> None:
        """Wrap `model`, whose label number i means labels[i]; labels[0] is the background."""
        self.name = name
        self.model = model.eval().requires_grad_(False)
        self._labels = tuple(labels)
        self._columns = [i for i, label in enumerate(labels) if label not in (_BACKGROUND, _UNUSED)]
        self.classes = tuple(labels[i] for i in self._columns)

    @property
    def fingerprint(self) -> str:
        """See `Detector`."""
        return fingerprint(self.model.state_dict())

    @property
    def min_confidence(self) -> float:
        """See `Detector`; 0.05 unless the model was built otherwise."""
        return float(self.model.roi_heads.score_thresh)

    def to(self, device: torch.device | str) -> RCNNDetector:
        """Move the weights to a device, in place."""
        self.model.to(device)
        return self

    def candidates(self, images: Tensor) -> list[Candidates]:
        """Every proposal as every class, before score threshold and non-maximum suppression.

        The choice of proposals is constant for the gradient, as in the library's own training; scores and boxes are
        differentiable in the images through the features.

        Args:
            images: (B, H, W, 3) sRGB in [0, 1].

        Raises:
            InvalidValueError: The images have another shape, or values outside [0, 1].
        """
        pictures = _channels_first(images)
        size = (images.shape[1], images.shape[2])
        batch, _ = self.model.transform(pictures)
        features = self.model.backbone(batch.tensors)
        with torch.no_grad():
            proposals, _ = self.model.rpn(batch, OrderedDict((k, v.detach()) for k, v in features.items()))
        heads = self.model.roi_heads
        logits, deltas = heads.box_predictor(heads.box_head(heads.box_roi_pool(features, proposals, batch.image_sizes)))
        counts = [len(p) for p in proposals]
        boxes = torch.split(heads.box_coder.decode(deltas, proposals), counts)
        scores = torch.split(torch.softmax(logits, -1), counts)
        return [
            self._in_pixels(b, s, inner, size) for b, s, inner in zip(boxes, scores, batch.image_sizes, strict=True)
        ]

    def detect(self, images: Tensor) -> list[Detections]:
        """The library's own forward pass.

        Args:
            images: (B, H, W, 3) sRGB in [0, 1].

        Raises:
            InvalidValueError: The images have another shape, or values outside [0, 1].
        """
        with torch.no_grad():
            results = self.model(_channels_first(images))
        return [
            Detections(r["boxes"], r["scores"], tuple(self._labels[i] for i in r["labels"].tolist())) for r in results
        ]

    def _in_pixels(self, boxes: Tensor, scores: Tensor, inner: tuple[int, int], size: tuple[int, int]) -> Candidates:
        """Clip to the network's (height, width), keep the named classes, and scale to the input picture's."""
        boxes = clip_boxes_to_image(boxes, inner)[:, self._columns]
        pixels = resize_boxes(boxes.reshape(-1, 4), inner, size).reshape(boxes.shape)
        return Candidates(pixels, scores[:, self._columns])


def load_small(weights: Path | None = None) -> RCNNDetector:
    """The project's own small detector, with the shipped weights unless told otherwise."""
    model = small.build()
    path = SMALL_RCNN_WEIGHTS if weights is None else Path(weights)
    apply_weights(model, read_weights(path), path)
    return RCNNDetector("fasterrcnn_small", model, (_BACKGROUND, *SMALL_CLASSES))


def load_published(name: str, weights: Path | None = None) -> RCNNDetector:
    """One of torchvision's COCO detectors.

    Args:
        name: torchvision's name of it.
        weights: File in the form of the library's published checkpoint; None asks the library's own hub.

    Raises:
        DetectorError: the file does not fit, or the hub cannot be reached.
    """
    model = _BUILDERS[name](weights=None, weights_backbone=None)
    if name in _FROZEN_EPS:
        _freeze_norms(model, _FROZEN_EPS[name])
    state = _from_hub(name) if weights is None else read_weights(Path(weights))
    apply_weights(model, state, name if weights is None else weights)
    return RCNNDetector(name, model, published_labels(name))


def published_labels(name: str) -> tuple[str, ...]:
    """What the library's label numbers mean; COCO's numbers have gaps, which it calls N/A."""
    return tuple(_PUBLISHED[name].meta["categories"])


def random_detector(name: str, *, seed: int = 0) -> RCNNDetector:
    """A detector of random weights for tests of plumbing; it finds nothing, but its image gradients are not zero.

    Without the warm-up of the BatchNorm statistics, the signal of a random network dies on the way.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        is_small = name == "fasterrcnn_small"
        model = small.build() if is_small else _BUILDERS[name](weights=None, weights_backbone=None)
        _warm_up(model.eval())
    return RCNNDetector(name, model, (_BACKGROUND, *SMALL_CLASSES) if is_small else published_labels(name))


def _warm_up(model: FasterRCNN, *, batches: int = 8, side: int = 64) -> None:
    """Let every BatchNorm average the statistics of a few batches of noise."""
    norms = [m for m in model.modules() if isinstance(m, nn.BatchNorm2d)]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # a cumulative average
        norm.train()
    heads, transform = model.roi_heads, model.transform
    usual = transform.min_size, heads.score_thresh
    transform.min_size, heads.score_thresh = (side,), 1.0  # small, and nothing to suppress
    with torch.no_grad():
        for _ in range(batches):
            model(list(torch.rand(2, 3, side, side)))
    transform.min_size, heads.score_thresh = usual


def _from_hub(name: str) -> dict[str, Tensor]:
    try:
        state: dict[str, Tensor] = _PUBLISHED[name].get_state_dict(progress=True, check_hash=True, weights_only=True)
    except (OSError, RuntimeError) as error:  # no network, or a download whose hash does not fit
        raise DetectorError(
            message(
                f"weights of {name}",
                "a weights file, or a network that reaches the library's hub",
                str(error).splitlines()[0] if str(error) else type(error).__name__,
                "download the file elsewhere and pass its path",
            )
        ) from error
    return state


def _freeze_norms(module: nn.Module, eps: float) -> None:
    """Replace every BatchNorm by the library's frozen form with this eps, as its builder does for published weights."""
    for name, child in module.named_children():
        if isinstance(child, nn.BatchNorm2d):
            setattr(module, name, FrozenBatchNorm2d(child.num_features, eps=eps))
        else:
            _freeze_norms(child, eps)


def _channels_first(images: Tensor) -> list[Tensor]:
    check_images(images)
    return list(images.permute(0, 3, 1, 2))
