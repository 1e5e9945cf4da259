"""Loads torchvision's detectors: our own small ones, the published ones, and ones of random weights for tests."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torchvision.models.detection import FasterRCNN

from attacks.detectors import small
from attacks.detectors.classes import BACKGROUND, SMALL_CLASSES
from attacks.detectors.torchvision.adapter import TorchvisionDetector, threshold_holder
from attacks.detectors.torchvision.faster_rcnn import RCNNDetector
from attacks.detectors.torchvision.one_stage import OneStageDetector
from attacks.detectors.torchvision.published import PUBLISHED, build_published, freeze_norms, from_hub, published_labels
from attacks.detectors.weight_files import SMALL_WEIGHTS
from attacks.detectors.weights import apply_weights, read_weights

SMALL = "fasterrcnn_small"
"""Name of the project's own detector."""


def wrap(name: str, model: nn.Module, labels: Sequence[str]) -> TorchvisionDetector:
    """A model of the library behind the `Detector` interface.

    Args:
        name: Of the detector.
        model: A FasterRCNN, RetinaNet, FCOS or SSD.
        labels: Label number i means labels[i]; labels[0] is `BACKGROUND`.
    """
    adapter = RCNNDetector if isinstance(model, FasterRCNN) else OneStageDetector
    return adapter(name, model, labels)


def load_small(weights: Path | None = None) -> TorchvisionDetector:
    """The project's own `fasterrcnn_small`, with the shipped weights unless told otherwise.

    Args:
        weights: File of its weights; None: that of the package.

    Raises:
        DetectorError: There are no weights, or they do not fit.
    """
    model, path = small.build(), SMALL_WEIGHTS if weights is None else Path(weights)
    apply_weights(model, read_weights(path), path)
    return wrap(SMALL, model, (BACKGROUND, *SMALL_CLASSES))


def load_published(name: str, weights: Path | None = None) -> TorchvisionDetector:
    """One of torchvision's COCO detectors.

    Args:
        name: torchvision's name of it.
        weights: File in the form of the library's published checkpoint; None asks the library's own hub.

    Raises:
        DetectorError: The file does not fit, or the hub cannot be reached.
    """
    state = from_hub(name) if weights is None else read_weights(Path(weights))
    model = build_published(name)
    apply_weights(model, state, name if weights is None else weights)
    return wrap(name, model, published_labels(name))


def random_detector(name: str, *, seed: int = 0) -> TorchvisionDetector:
    """A detector of random weights for tests of plumbing; it finds nothing, but its image gradients are not zero.

    Without the warm-up of the BatchNorm statistics, the signal of a random network dies on the way.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        if name == SMALL:
            model = small.build()
            warm_up(model.eval())
            return wrap(name, model, (BACKGROUND, *SMALL_CLASSES))
        model = PUBLISHED[name].builder(weights=None, weights_backbone=None)
        warm_up(model.eval())
    freeze_norms(name, model)
    return wrap(name, model, published_labels(name))


def warm_up(model: nn.Module, *, batches: int = 8, side: int = 64) -> None:
    """Let every BatchNorm average the statistics of a few batches of noise; frozen ones stay."""
    norms = [m for m in model.modules() if isinstance(m, nn.BatchNorm2d)]
    if not norms:
        return
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # a cumulative average
        norm.train()
    transform: Any = model.transform
    holder = threshold_holder(model)
    usual = transform.min_size, holder.score_thresh
    transform.min_size, holder.score_thresh = (side,), 1.0  # small, and nothing to suppress
    with torch.no_grad():
        for _ in range(batches):
            model(list(torch.rand(2, 3, side, side)))
    transform.min_size, holder.score_thresh = usual
