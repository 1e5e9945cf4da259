"""What recognises an object for the audit: a detector that ships with the package, and
features of MobileNetV2 where its weights were downloaded.
"""

from __future__ import annotations

import torch
from torch import Tensor

from attacks.classifiers.frozen import Preparation
from attacks.classifiers.prototypes import has_features, load_features
from attacks.detectors.registry import load_detector

_CUT = 0.7  # share of an image's side that is the object, and what features see
_PREPARE = Preparation(size=128)
_NEAR = 0.35  # sides from the middle within which a box is the object's
_LEAST = 0.25  # sides of the longer side of its box
_BATCH = 8


class Recognition:
    """Compares images of one object; see `mi_splat.audit.held_out.Recogniser`."""

    def __init__(self, detector: str = "fasterrcnn_small") -> None:
        self._network = None
        self._detector = load_detector(detector)
        self.classes = self._detector.classes
        self.missing = ""
        if has_features():
            self._network = load_features()
        else:
            self.missing = (
                "only a detector compared the directions, which misses most of what"
                " features find: run `mi-splat detectors --get prototypes`"
            )

    def features(self, images: Tensor) -> Tensor:
        """(B, 1280) of the middle of (B, S, S, 3) images; all alike without weights."""
        if self._network is None:
            return torch.ones(len(images), 1)
        side = images.shape[1]
        edge = round(side * (1 - _CUT) / 2)
        middle = _PREPARE(images[:, edge : side - edge, edge : side - edge])
        with torch.no_grad():
            parts = [self._network(part) for part in torch.split(middle, _BATCH)]
        return torch.cat(parts)

    def scores(self, images: Tensor) -> Tensor:
        """(B, C) best confidence of each class in (B, S, S, 3) images."""
        side = images.shape[1]
        best = []
        with torch.no_grad():
            for part in torch.split(images, _BATCH):
                for candidates in self._detector.candidates(part):
                    boxes = candidates.boxes
                    middles = (boxes[..., :2] + boxes[..., 2:]) / 2
                    longest = (boxes[..., 2:] - boxes[..., :2]).amax(-1)
                    off = (middles - side / 2).norm(dim=-1)
                    is_near = (off < _NEAR * side) & (longest > _LEAST * side)
                    best.append((candidates.scores * is_near).amax(0))
        return torch.stack(best)
