"""What recognises an object for the audit: a detector that ships with the package, and
features of MobileNetV2 where its weights were downloaded, or else those of the
detector's backbone.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.nn import functional

from attacks.classifiers.frozen import Preparation
from attacks.classifiers.prototypes import has_features, load_features
from attacks.detectors.registry import load_detector

_CUT = 0.7  # share of an image's side that is the object, and what features see
_PREPARE = Preparation(size=128)
_NEAR = 0.35  # sides from the middle within which a box is the object's
_LEAST = 0.25  # sides of the longer side of its box
_BATCH = 8
# factor for cosine distances of backbone features, chosen on the first random set of
# `scenes/recipes/held_out_set.py`, so that none of its honest splats is contradicted
_OF_BACKBONE = 1.5


@runtime_checkable
class _Backbone(Protocol):
    """A detector whose backbone describes images."""

    def pooled(self, images: Tensor) -> Tensor: ...


class Recognition:
    """Compares images of one object; see `mi_splat.audit.held_out.Recogniser`."""

    def __init__(self, detector: str = "fasterrcnn_small") -> None:
        self._network = None
        self._detector = load_detector(detector)
        self.classes = self._detector.classes
        self.missing = ""
        self.scale = 1.0
        if has_features():
            self._network = load_features()
            return
        self.scale = _OF_BACKBONE
        self.missing = (
            "only a small detector compared the directions, which misses much of what"
            " features of photographs find: run `mi-splat detectors --get prototypes`"
        )

    def features(self, images: Tensor) -> Tensor:
        """(B, F) of the middle of (B, S, S, 3) images; all alike where the detector has
        none.
        """
        with torch.no_grad():
            return self.described(images)

    def described(self, images: Tensor) -> Tensor:
        """The same, differentiable in the images."""
        side = images.shape[1]
        edge = round(side * (1 - _CUT) / 2)
        parts = torch.split(images[:, edge : side - edge, edge : side - edge], _BATCH)
        return torch.cat([self._described(part) for part in parts])

    def _described(self, images: Tensor) -> Tensor:
        if self._network is not None:
            described: Tensor = self._network(_PREPARE(images))
            return described
        if isinstance(self._detector, _Backbone):
            planes = images.movedim(-1, 1)
            size = (_PREPARE.size, _PREPARE.size)
            small = functional.interpolate(
                planes, size=size, mode="bilinear", antialias=True
            )
            return self._detector.pooled(small.movedim(1, -1))
        return torch.ones(len(images), 1)

    def scores(self, images: Tensor) -> Tensor:
        """(B, C) best confidence of each class in (B, S, S, 3) images."""
        with torch.no_grad():
            return self.confidences(images)

    def confidences(self, images: Tensor) -> Tensor:
        """The same, differentiable in the images."""
        side = images.shape[1]
        best = []
        for part in torch.split(images, _BATCH):
            for candidates in self._detector.candidates(part):
                boxes = candidates.boxes
                middles = (boxes[..., :2] + boxes[..., 2:]) / 2
                longest = (boxes[..., 2:] - boxes[..., :2]).amax(-1)
                off = (middles - side / 2).norm(dim=-1)
                is_near = (off < _NEAR * side) & (longest > _LEAST * side)
                best.append((candidates.scores * is_near).amax(0))
        return torch.stack(best)
