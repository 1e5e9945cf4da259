"""What all adapters to classifiers share: a frozen network, images brought to it, and
rows of what it says.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from attacks.classifiers.base import Classifier
from attacks.detectors.base import check_images
from attacks.detectors.vision import torchvision
from attacks.detectors.weights import FrozenModel
from mi_splat.errors import InvalidValueError, nearest

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Preparation:
    """How images are brought to a network: scaled, cut, and normalised, by
    torchvision's differentiable functions.
    """

    # width and height of what the network gets, pixels: the middle is cut out
    size: int = 224
    # pixels to which the shorter side is scaled before, with antialiasing; None is
    # `size`
    shorter: int | None = None
    mean: Triple = (0.485, 0.456, 0.406)  # of each channel, sRGB in [0, 1]; subtracted
    deviation: Triple = (0.229, 0.224, 0.225)  # of each channel; divided by
    mode: str = "bilinear"  # "bilinear" or "bicubic"

    def __call__(self, images: Tensor) -> Tensor:
        """(B, H, W, 3) sRGB in [0, 1] to (B, 3, size, size)."""
        planes = images.permute(0, 3, 1, 2)
        mode = torchvision.transforms.InterpolationMode(self.mode)
        functional = torchvision.transforms.functional
        scaled = functional.resize(
            planes, [self.shorter or self.size], mode, antialias=True
        )
        cut: Tensor = functional.normalize(
            functional.center_crop(scaled, [self.size]), self.mean, self.deviation
        )
        return cut


class FrozenClassifier(FrozenModel):
    """A frozen network behind the `Classifier` interface."""

    def __init__(
        self, name: str, model: nn.Module, classes: Sequence[str], prepare: Preparation
    ) -> None:
        """Freeze a model, in place."""
        super().__init__(name, model, check_classes(classes))
        self.prepare, self.settings = prepare, json.dumps([self.classes, repr(prepare)])

    @property
    def size(self) -> int:
        """See `Classifier`."""
        return self.prepare.size

    def scores(self, images: Tensor) -> Tensor:
        """See `Classifier`."""
        check_images(images)
        weight = next(self.model.parameters())
        logits: Tensor = self.model(self.prepare(images.to(weight)))
        return logits


class ZeroShot(nn.Module):
    """Features of an image less their centre, compared with those of each class: their
    cosine, times a temperature.
    """

    def __init__(
        self,
        encoder: nn.Module,
        directions: Tensor,
        *,
        temperature: float,
        centre: Tensor,
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.directions: Tensor
        self.temperature: Tensor
        self.centre: Tensor
        self.register_buffer("directions", directions)
        self.register_buffer("temperature", directions.new_tensor(temperature))
        self.register_buffer("centre", centre)

    def forward(self, pictures: Tensor) -> Tensor:
        """(B, 3, S, S) prepared images to (B, C) logits."""
        features = nn.functional.normalize(self.encoder(pictures), dim=1)
        features = nn.functional.normalize(features - self.centre, dim=1)
        return self.temperature * features @ self.directions.T


def check_classes(classes: Sequence[str]) -> tuple[str, ...]:
    """The classes, each named once."""
    if isinstance(classes, str) or not classes or len(set(classes)) < len(classes):
        do = 'give a list such as ["car", "person"]'
        raise InvalidValueError.of(
            "classes", "names, each once", repr(classes)[:160], do
        )
    return tuple(classes)


def class_number(classifier: Any, name: str, what: str = "class") -> int:
    """Position of a class among those of a classifier."""
    classes: tuple[str, ...] = classifier.classes
    if name not in classes:
        shown = ", ".join(classes[:12]) + (
            f" and {len(classes) - 12} more" if len(classes) > 12 else ""
        )
        do = nearest(name, classes, "choose one of them")
        raise InvalidValueError.of(
            f"{what} of {classifier.name}", f"one of {shown}", repr(name), do
        )
    return classes.index(name)


def classified(
    classifier: Classifier, pictures: Iterable[Tensor], label: str
) -> list[dict[str, Any]]:
    """A row for each image: `view`, its position; `classifier`; `top1`; `right`;
    `confidence` in the true class.
    """
    true = class_number(classifier, label, "label")
    rows = list[dict[str, Any]]()
    for view, picture in enumerate(pictures):
        with torch.no_grad():
            confidence = torch.softmax(classifier.scores(picture[None])[0].double(), 0)
        top1 = classifier.classes[int(confidence.argmax())]
        row = {"view": view, "classifier": classifier.name, "top1": top1}
        rows.append(
            {**row, "right": top1 == label, "confidence": float(confidence[true])}
        )
    return rows
