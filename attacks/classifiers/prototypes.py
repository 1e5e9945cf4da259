"""A classifier that needs no training: a class is the mean direction of the features of a few pictures of it.

As nearest class means with pretrained features (Snell et al., arXiv 1703.05175, call them prototypes): the features of
a picture are compared by their cosine with those of clean pictures of OTHER objects of each class, both less the mean
of all classes. The vectors are a part of the package, and the network that makes features is got by
`mi-splat classifiers --get prototypes` (`attacks.classifiers.mobilenet`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn.functional import normalize

from attacks.classifiers.frozen import FrozenClassifier, Preparation, ZeroShot, check_classes
from attacks.classifiers.mobilenet import LENGTH, load_features
from attacks.detectors.weights import fingerprint
from mi_splat.assets import ASSETS
from mi_splat.capture.settings import Ground
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Checked, Seed, Steps, above, check_choice
from mi_splat.io.documents import save_bytes
from mi_splat.io.noted_tensors import NOTES, check_like, read_noted_tensors
from mi_splat.io.parsing import DocumentReader

VECTORS = Path(__file__).with_name("prototypes.safetensors")
"""Where the package has the vectors."""
TEMPERATURE = 20.0
"""What cosines are multiplied by to become logits."""
_READER = DocumentReader(expected="the prototypes of classes", do="restore the file, or make it again")


@dataclass(frozen=True, slots=True, kw_only=True)
class PrototypesConfig(Checked):
    """Settings of the pictures that prototypes are made of.

    Attributes:
        classes: Keys of `mi_splat.assets.ASSETS`.
        seeds: Objects of each class. Whoever is judged by the prototypes must be of another seed.
        grounds: What they stand on; "none" is nothing but sky.
        views: Pictures of each object on each ground, from cameras spread over `elevations`.
        elevations: Lowest and highest, degrees.
        size: Pixels of a side.
        samples: Of the path tracer, for each pixel.
    """

    classes: tuple[str, ...] = tuple(ASSETS)
    seeds: tuple[Seed, ...] = (1, 2)
    grounds: tuple[Ground, ...] = ("road", "grass", "none")
    views: Steps = 12
    elevations: tuple[float, float] = (0.0, 80.0)
    size: Annotated[int, above(0, "pixels")] = 160
    samples: Steps = 16


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prototypes:
    """Directions of classes among features.

    Attributes:
        classes: Their names.
        directions: (C, F) unit vectors.
        centre: (F,) mean of the classes, from which they point.
        features: Fingerprint of the network.
        recipe: How they were made, as JSON can hold it.
    """

    classes: tuple[str, ...]
    directions: Tensor
    centre: Tensor
    features: str
    recipe: Mapping[str, Any]

    @classmethod
    def of(cls, pictures: Mapping[str, Tensor], features: nn.Module, recipe: Mapping[str, Any]) -> Prototypes:
        """The prototypes of some classes."""
        classes, prepare, means = check_classes(list(pictures)), Preparation(), []
        for name, images in pictures.items():
            if not len(images):
                raise InvalidValueError.of(f"pictures of {name}", "one or more", "none", "add some")
            with torch.no_grad():
                rows = [normalize(features(prepare(image[None])), dim=1) for image in images]
            means.append(normalize(torch.cat(rows).mean(0), dim=0))
        if len(classes) < 2:
            raise InvalidValueError.of("classes", "two or more", len(classes), "add another")
        centre = torch.stack(means).mean(0)
        directions = normalize(torch.stack(means) - centre, dim=1)
        seen = fingerprint(features.state_dict())
        return cls(classes=classes, directions=directions, centre=centre, features=seen, recipe=recipe)

    def save(self, path: Path) -> None:
        """Write the prototypes to a .safetensors file."""
        notes = {"classes": self.classes, "features": self.features, "recipe": dict(self.recipe)}
        tensors = {"directions": self.directions.contiguous(), "centre": self.centre.contiguous()}
        save_bytes(save(tensors, {NOTES: json.dumps(notes)}), path)


def read_prototypes(path: Path = VECTORS) -> Prototypes:
    """Prototypes from a file."""
    notes, tensors = read_noted_tensors(path, _READER)
    classes = tuple(notes.texts("classes"))
    wanted = {"directions": torch.empty(len(classes), LENGTH), "centre": torch.empty(LENGTH)}
    check_like(tensors, wanted, f"prototypes {path}", _READER)
    recipe = dict(notes.object("recipe").values)
    return Prototypes(classes=classes, features=notes.text("features"), recipe=recipe, **tensors)


def load_prototypes(weights: Path | None = None, *, classes: Sequence[str] | None = None) -> FrozenClassifier:
    """The classifier."""
    features, prototypes = load_features(weights), read_prototypes(VECTORS)
    if (seen := fingerprint(features.state_dict())) != prototypes.features:
        do = "make the prototypes of this network"
        raise InvalidValueError.of(f"network of {VECTORS}", prototypes.features, seen, do)
    return prototype_classifier(prototypes, features, classes=classes)


def prototype_classifier(
    prototypes: Prototypes, features: nn.Module, *, classes: Sequence[str] | None = None
) -> FrozenClassifier:
    """The classifier of some prototypes: the class that is nearest in direction."""
    chosen = check_classes(prototypes.classes if classes is None else classes)
    for name in chosen:
        check_choice("class", name, prototypes.classes)
    directions = prototypes.directions[[prototypes.classes.index(name) for name in chosen]]
    model = ZeroShot(features, directions, temperature=TEMPERATURE, centre=prototypes.centre)
    return FrozenClassifier("prototypes", model, chosen, Preparation())
