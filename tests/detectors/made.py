"""Detectors of random weights."""

from typing import Any

import torch
from torch import nn

from attacks.detectors import torchvision


def random_detector(name: str, *, seed: int = 0) -> torchvision.TorchvisionDetector:
    """A detector of random weights; it finds nothing, but its image gradients are not zero.

    Without the warm-up of the BatchNorm statistics, the signal of a random network dies on the way.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = torchvision._build(name)
        warm_up(model.eval())
    torchvision._freeze_norms(name, model)
    return torchvision.wrap(name, model, torchvision._labels(name))


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
    holder = torchvision._threshold_holder(model)
    usual = transform.min_size, holder.score_thresh
    transform.min_size, holder.score_thresh = (side,), 1.0  # small, and nothing to suppress
    with torch.no_grad():
        for _ in range(batches):
            model(list(torch.rand(2, 3, side, side)))
    transform.min_size, holder.score_thresh = usual
