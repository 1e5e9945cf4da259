"""Adapter to torchvision's Faster R-CNN family, and to our own small one."""

from __future__ import annotations

from collections import OrderedDict

import torch
from torch import Tensor

from attacks.detectors.base import Candidates
from attacks.detectors.torchvision.adapter import TorchvisionDetector, channels_first


class RCNNDetector(TorchvisionDetector):
    """A frozen Faster R-CNN behind the `Detector` interface; see `TorchvisionDetector` for its attributes."""

    def candidates(self, images: Tensor) -> list[Candidates]:
        """As in `TorchvisionDetector`: every proposal as every class.

        The choice of proposals is constant for the gradient, as in the library's own training; scores and boxes are
        differentiable in the images through the features.
        """
        pictures = channels_first(images)
        size = (images.shape[1], images.shape[2])
        batch, _ = self.model.transform(pictures)
        features = self.model.backbone(batch.tensors)
        with torch.no_grad():
            proposals, _ = self.model.rpn(batch, OrderedDict((k, v.detach()) for k, v in features.items()))
        heads = self.model.roi_heads
        logits, deltas = heads.box_predictor(heads.box_head(heads.box_roi_pool(features, proposals, batch.image_sizes)))
        counts = [len(p) for p in proposals]
        boxes = torch.split(heads.box_coder.decode(deltas, proposals)[:, self._columns], counts)
        scores = torch.split(torch.softmax(logits, -1)[:, self._columns], counts)
        return [
            self._in_pixels(b, s, inner, size) for b, s, inner in zip(boxes, scores, batch.image_sizes, strict=True)
        ]
