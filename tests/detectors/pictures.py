"""Labelled pictures that need no renderer."""

from __future__ import annotations

import torch

from attacks.detectors.training.pictures import LabelledPicture


def drawn(box: tuple[int, int, int, int], *, size: int = 96, label: int = 1) -> LabelledPicture:
    """A grey picture with one bright rectangle."""
    image = torch.full((size, size, 3), 60, dtype=torch.uint8)
    x0, y0, x1, y1 = box
    image[y0:y1, x0:x1] = torch.tensor([250, 40 * label, 30], dtype=torch.uint8)
    return LabelledPicture(image, torch.tensor([box], dtype=torch.float32), torch.tensor([label]))
