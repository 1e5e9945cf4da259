"""Adapters to torchvision's detectors: the published COCO ones, our own small one, and
any that a user has trained.

Faster R-CNN proposes regions, whose choice is constant for the gradient as in the
library's own training; RetinaNet, FCOS, SSD and SSDlite have one stage, of anchors.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from attacks.detectors import fasterrcnn_small
from attacks.detectors.base import Candidates, Detections, check_images
from attacks.detectors.catalogue import (
    BACKGROUND,
    SMALL_CLASSES,
    SMALL_WEIGHTS,
    UNUSED,
    DetectorError,
    download_advice,
)
from attacks.detectors.vision import torchvision
from attacks.detectors.weights import FrozenModel, apply_weights, one_line, read_weights

models = torchvision.models
ops = torchvision.ops

SMALL = "fasterrcnn_small"
"""Name of the project's own detector."""
_FROZEN = ("fasterrcnn_resnet50_fpn", "retinanet_resnet50_fpn")
"""Detectors whose published weights the library evaluates with frozen norms of eps
0.
"""

Outputs = Mapping[str, Tensor]
"""What a head gives: "cls_logits" (B, A, L), "bbox_regression" (B, A, 4), and FCOS
"bbox_ctrness" (B, A, 1).
"""


def _with_centreness(outputs: Outputs) -> Tensor:
    """FCOS' scores: the geometric mean of class and centreness.

    In logarithms, for the library's square root has no finite gradient where the
    product rounds to zero.
    """
    return torch.exp(
        (F.logsigmoid(outputs["cls_logits"]) + F.logsigmoid(outputs["bbox_ctrness"]))
        / 2
    )


_SCORES: Mapping[type[nn.Module], Callable[[Outputs], Tensor]] = {
    models.detection.RetinaNet: lambda outputs: torch.sigmoid(outputs["cls_logits"]),
    models.detection.FCOS: _with_centreness,
    models.detection.ssd.SSD: lambda outputs: torch.softmax(outputs["cls_logits"], -1),
}
"""How a one-stage model computes (B, A, L) scores: each class for itself, or one of
them or the background.
"""


class TorchvisionDetector(FrozenModel, ABC):
    """A frozen detector of torchvision behind the `Detector` interface."""

    def __init__(self, name: str, model: nn.Module, labels: Sequence[str]) -> None:
        """Wrap `model`, whose label number i means labels[i]; labels[0] is the
        background.
        """
        self._labels = tuple(labels)
        self._columns = [
            i for i, label in enumerate(labels) if label not in (BACKGROUND, UNUSED)
        ]
        super().__init__(name, model, [labels[i] for i in self._columns])

    @property
    def min_confidence(self) -> float:
        """See `Detector`; what the model was built with."""
        return float(_threshold_holder(self.model).score_thresh)

    @abstractmethod
    def candidates(self, images: Tensor) -> list[Candidates]:
        """Boxes and scores before thresholds, differentiable in the images."""

    def pooled(self, images: Tensor) -> Tensor:
        """(B, F) mean over (B, H, W, 3) sRGB images of the finest features, of which
        images of similar things have similar ones.
        """
        transform = self.model.transform
        mean = images.new_tensor(transform.image_mean)
        deviation = images.new_tensor(transform.image_std)
        normalized = ((images - mean) / deviation).movedim(-1, 1)
        features = self.model.backbone(normalized)
        finest: Tensor = next(iter(features.values()))
        return finest.mean((2, 3))

    def detect(self, images: Tensor) -> list[Detections]:
        """The library's own forward pass."""
        with torch.no_grad():
            results = self.model(_channels_first(images))
        return [
            Detections(
                r["boxes"],
                r["scores"],
                tuple(self._labels[i] for i in r["labels"].tolist()),
            )
            for r in results
        ]

    def _in_pixels(
        self,
        boxes: Tensor,
        scores: Tensor,
        inner: tuple[int, int],
        size: tuple[int, int],
    ) -> Candidates:
        """Boxes in the network's image, clipped to it, in pixels of the input.

        They are (A, C, 4) for each class, or (A, 1, 4) for all. Height and width are
        `inner` in the network's image, and `size` in the input.
        """
        inside = ops.clip_boxes_to_image(boxes, inner)
        pixels = models.detection.transform.resize_boxes(
            inside.reshape(-1, 4), inner, size
        ).reshape(boxes.shape)
        return Candidates(pixels.expand(-1, len(self.classes), -1), scores)


class RCNNDetector(TorchvisionDetector):
    """A frozen Faster R-CNN behind the `Detector` interface; see `TorchvisionDetector`
    for its attributes.
    """

    def candidates(self, images: Tensor) -> list[Candidates]:
        """As in `TorchvisionDetector`: every proposal as every class, differentiable
        through the features.
        """
        pictures = _channels_first(images)
        size = (images.shape[1], images.shape[2])
        batch, _ = self.model.transform(pictures)
        features = self.model.backbone(batch.tensors)
        with torch.no_grad():
            proposals, _ = self.model.rpn(
                batch, OrderedDict((k, v.detach()) for k, v in features.items())
            )
        heads = self.model.roi_heads
        regions = _Regions(
            heads, tuple(features), tuple(proposals), tuple(batch.image_sizes)
        )
        logits, deltas = _Boxes.apply(regions, *features.values())
        counts = [len(p) for p in proposals]
        boxes = torch.split(
            heads.box_coder.decode(deltas, proposals)[:, self._columns], counts
        )
        scores = torch.split(torch.softmax(logits, -1)[:, self._columns], counts)
        return [
            self._in_pixels(b, s, inner, size)
            for b, s, inner in zip(boxes, scores, batch.image_sizes, strict=True)
        ]


class _Regions(NamedTuple):
    """What the second stage of a Faster R-CNN looks at."""

    heads: Any  # the model's box heads
    levels: tuple[str, ...]  # names of the feature maps
    proposals: tuple[Tensor, ...]  # (R, 4) of each image
    sizes: tuple[tuple[int, int], ...]  # height and width of each image

    def scored(self, maps: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Logits (R, L) and deltas (R, 4 L) of all proposals, in the order of the
        images.
        """
        features = OrderedDict(zip(self.levels, maps, strict=True))
        pooled = self.heads.box_roi_pool(
            features, list(self.proposals), list(self.sizes)
        )
        logits, deltas = self.heads.box_predictor(self.heads.box_head(pooled))
        return logits, deltas

    def only(self, rows: Tensor) -> _Regions:
        """Those proposals that are True in `rows` (R,)."""
        each = torch.split(rows, [len(proposals) for proposals in self.proposals])
        kept = (
            proposals[mine]
            for proposals, mine in zip(self.proposals, each, strict=True)
        )
        return self._replace(proposals=tuple(kept))


class _Boxes(torch.autograd.Function):
    """`_Regions.scored`, differentiated for those proposals alone on which the loss
    depends.

    A loss looks at a few candidates of 150 or 1000; the library's backward pass of
    pooling takes as long for a gradient of zeros as for any other.
    """

    @staticmethod
    def forward(ctx: Any, regions: _Regions, *maps: Tensor) -> tuple[Tensor, Tensor]:
        ctx.regions = regions
        ctx.save_for_backward(*maps)
        return regions.scored(maps)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        rows = torch.cat(gradients, 1).ne(0).any(1)
        maps = [
            features.detach().requires_grad_(True) for features in ctx.saved_tensors
        ]
        with torch.enable_grad():
            outputs = ctx.regions.only(rows).scored(maps)
            # One scalar with the same derivative: torch imports sympy for gradients
            # that are tensors.
            pairs = zip(outputs, gradients, strict=True)
            product = torch.stack(
                [(output * gradient[rows]).sum() for output, gradient in pairs]
            ).sum()
        return (None, *torch.autograd.grad(product, maps, allow_unused=True))


class OneStageDetector(TorchvisionDetector):
    """A frozen one-stage detector behind the `Detector` interface; see
    `TorchvisionDetector` for its attributes.
    """

    def __init__(self, name: str, model: nn.Module, labels: Sequence[str]) -> None:
        """As in `TorchvisionDetector`."""
        super().__init__(name, model, labels)
        scores = [
            scores
            for architecture, scores in _SCORES.items()
            if isinstance(model, architecture)
        ]
        if not scores:
            raise TypeError(
                f"RetinaNet, FCOS or SSD expected, got {type(model).__name__}"
            )
        self._scores = scores[0]

    def candidates(self, images: Tensor) -> list[Candidates]:
        """As in `TorchvisionDetector`: every anchor as every class, with the one box
        that it has for all of them.
        """
        pictures = _channels_first(images)
        size = (images.shape[1], images.shape[2])
        batch, _ = self.model.transform(pictures)
        features = self.model.backbone(batch.tensors)
        maps = list(features.values()) if isinstance(features, dict) else [features]
        outputs = self.model.head(maps)
        scores = self._scores(outputs)[:, :, self._columns]
        coder: Any = self.model.box_coder
        decode: Callable[[Tensor, Tensor], Tensor] = getattr(
            coder, "decode_single", coder.decode
        )
        rows = zip(
            outputs["bbox_regression"],
            self.model.anchor_generator(batch, maps),
            strict=True,
        )
        boxes = [decode(deltas, anchors) for deltas, anchors in rows]
        return [
            self._in_pixels(b[:, None], s, inner, size)
            for b, s, inner in zip(boxes, scores, batch.image_sizes, strict=True)
        ]


def _threshold_holder(model: nn.Module) -> Any:
    """The part of a model that has the score threshold: the box heads of a Faster
    R-CNN, a one-stage model itself.
    """
    return getattr(model, "roi_heads", model)


def _channels_first(images: Tensor) -> list[Tensor]:
    """The list of images that the library's models take."""
    check_images(images)
    return list(images.permute(0, 3, 1, 2))


def wrap(name: str, model: nn.Module, labels: Sequence[str]) -> TorchvisionDetector:
    """A model of the library behind the `Detector` interface."""
    if isinstance(model, models.detection.FasterRCNN):
        return RCNNDetector(name, model, labels)
    return OneStageDetector(name, model, labels)


def load(name: str, weights: Path | None = None) -> TorchvisionDetector:
    """The project's own detector, or one of torchvision's COCO detectors."""
    path = SMALL_WEIGHTS if name == SMALL and weights is None else weights
    state = _from_hub(name) if path is None else read_weights(Path(path))
    model = _build(name)
    _freeze_norms(name, model)
    apply_weights(model, state, name if path is None else path)
    if name == SMALL:
        model.to(memory_format=torch.channels_last)  # its convolutions take less time
    return wrap(name, model, _labels(name))


def _build(name: str) -> nn.Module:
    """The network with random weights."""
    if name == SMALL:
        return fasterrcnn_small.build()
    model: nn.Module = models.get_model_builder(name)(
        weights=None, weights_backbone=None
    )
    return model


def _labels(name: str) -> tuple[str, ...]:
    """What label numbers mean; COCO's numbers have gaps, which the library calls
    N/A.
    """
    if name == SMALL:
        return (BACKGROUND, *SMALL_CLASSES)
    return tuple(published_weights(name).meta["categories"])


def published_weights(name: str) -> Any:
    """The library's entry for its COCO weights of a detector."""
    weights: Any = models.get_model_weights(name)
    return weights["COCO_V1"]


def _from_hub(name: str) -> dict[str, Tensor]:
    """The published weights, from the library's own download."""
    try:
        state: dict[str, Tensor] = published_weights(name).get_state_dict(
            progress=True, check_hash=True, weights_only=True
        )
    except (OSError, RuntimeError) as error:
        # no network, or a download whose hash does not fit
        expected = "a weights file, or a network that reaches the library's hub"
        raise DetectorError.of(
            f"weights of {name}", expected, one_line(error), download_advice("file")
        ) from error
    return state


def _freeze_norms(name: str, module: nn.Module) -> None:
    """Put the library's frozen norms in place, where it evaluates the published weights
    with them.
    """
    for part, child in module.named_children() if name in _FROZEN else ():
        if isinstance(child, nn.BatchNorm2d):
            frozen = ops.FrozenBatchNorm2d(child.num_features, eps=0.0)
            frozen.load_state_dict(child.state_dict())
            setattr(module, part, frozen)
        else:
            _freeze_norms(name, child)
