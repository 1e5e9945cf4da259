"""What adapters that hold a torch model have in common: its weights are frozen, and a fingerprint stands for them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from torch import nn

from attacks.detectors.weights import check_finite, fingerprint

_Self = TypeVar("_Self", bound="FrozenDetector")


class FrozenDetector:
    """A torch model in evaluation mode whose weights have no gradients; a part of a `Detector`.

    Attributes:
        name: Name in `attacks.detectors.DETECTORS`.
        classes: Foreground classes.
        model: The model.
    """

    name: str
    classes: tuple[str, ...]
    model: Any

    def __init__(self, name: str, model: nn.Module, classes: Sequence[str]) -> None:
        """Freeze a model, in place.

        Raises:
            DetectorError: A weight is not a finite number.
        """
        check_finite(model.state_dict(), f"weights of {name}")
        self.name, self.classes = name, tuple(classes)
        self.model = model.eval().requires_grad_(False)

    @property
    def fingerprint(self) -> str:
        """See `Detector`."""
        return fingerprint(self.model.state_dict())

    def to(self: _Self, device: torch.device | str) -> _Self:
        """Move the weights to a device, in place."""
        self.model.to(device)
        return self
