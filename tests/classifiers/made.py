"""A tiny classifier of random weights, for tests of plumbing."""

import torch
from torch import nn

from attacks.classifiers.frozen import FrozenClassifier, Preparation

CLASSES = ("car", "bird", "tv")
SIZE = 24


def toy_classifier(
    classes: tuple[str, ...] = CLASSES, *, seed: int = 0, size: int = SIZE
) -> FrozenClassifier:
    """A smooth network of two layers, of float64."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers = [
            nn.Conv2d(3, 8, 5, 3),
            nn.Tanh(),
            nn.Flatten(),
            nn.LazyLinear(len(classes)),
        ]
        model = nn.Sequential(*layers).double()
        model(torch.zeros(1, 3, size, size, dtype=torch.float64))
    return FrozenClassifier("toy", model, classes, Preparation(size=size))
