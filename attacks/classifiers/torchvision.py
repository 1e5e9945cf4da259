"""Adapter to every classifier of torchvision, with the preparation of images that
belongs to its weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torch import nn

from attacks.classifiers.frozen import FrozenClassifier, Preparation, check_classes
from attacks.detectors.catalogue import DetectorError
from attacks.detectors.vision import torchvision
from attacks.detectors.weights import apply_weights, one_line, read_weights
from mi_splat.errors import InvalidValueError, nearest

_GOOGLE = ("googlenet", "inception_v3")
"""Networks whose builders warn of their start, and whose published weights want the
images scaled once more.
"""


def load(
    name: str, weights: Path | None = None, classes: Sequence[str] | None = None
) -> FrozenClassifier:
    """One of torchvision's classifiers."""
    known = torchvision.models.list_models(module=torchvision.models)
    if name not in known:
        do = nearest(name, known, "see torchvision.models.list_models()")
        raise InvalidValueError.of("classifier", "one of torchvision", repr(name), do)
    entry = _entry(name, weights)
    if weights is None:
        try:
            state = entry.get_state_dict(
                progress=True, check_hash=True, weights_only=True
            )
        except (OSError, RuntimeError) as error:
            # no network, or a download whose hash does not fit
            expected = "a weights file, or a network that reaches the library's hub"
            do = "pass a file"
            raise DetectorError.of(
                f"weights of {name}", expected, one_line(error), do
            ) from error
    else:
        state = read_weights(Path(weights))
    names = check_classes(_imagenet(entry) if classes is None else classes)
    if name in _GOOGLE:
        options = {"init_weights": False, "transform_input": True}
    else:
        options = {}
    model: nn.Module = torchvision.models.get_model_builder(name)(
        weights=None, num_classes=len(names), **options
    )
    apply_weights(model, state, name if weights is None else weights)
    return FrozenClassifier(
        f"torchvision:{name}", model, names, preparation_of(entry.transforms())
    )


def _entry(name: str, weights: Path | None) -> Any:
    """The library's own entry for a file that has the name of its download; else for
    its best weights.
    """
    entries: Any = torchvision.models.get_model_weights(name)
    named = [
        entry
        for entry in entries
        if weights is not None and entry.url.endswith(f"/{Path(weights).name}")
    ]
    if named:
        return named[0]
    return entries.DEFAULT


def _imagenet(entry: Any) -> list[str]:
    """ImageNet's classes; two of its names stand for two classes each, of which the
    second gets its number.
    """
    names: list[str] = entry.meta["categories"]
    return [
        name if name not in names[:number] else f"{name} {number}"
        for number, name in enumerate(names)
    ]


def preparation_of(preset: Any) -> Preparation:
    """The preparation of a preset of the library
    (`torchvision.transforms._presets.ImageClassification`).
    """
    (size,), (shorter,) = preset.crop_size, preset.resize_size
    mode: str = preset.interpolation.value
    return Preparation(
        size=size,
        shorter=shorter,
        mean=tuple(preset.mean),
        deviation=tuple(preset.std),
        mode=mode,
    )
