"""Adapters to torchvision's detectors: the published COCO ones, and our own small ones that are built of its parts."""

from __future__ import annotations

from attacks.detectors.classes import BACKGROUND
from attacks.detectors.torchvision.adapter import TorchvisionDetector
from attacks.detectors.torchvision.faster_rcnn import RCNNDetector
from attacks.detectors.torchvision.loading import load_published, load_small, random_detector, wrap
from attacks.detectors.torchvision.one_stage import OneStageDetector

__all__ = [
    "BACKGROUND",
    "OneStageDetector",
    "RCNNDetector",
    "TorchvisionDetector",
    "load_published",
    "load_small",
    "random_detector",
    "wrap",
]
