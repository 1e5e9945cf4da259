"""How good a small detector is on held-out pictures: average precision, and false positives per picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from attacks.detectors.base import Detector
from attacks.detectors.training.average_precision import Score, detect_all, score
from attacks.detectors.training.backgrounds import background_sets
from attacks.detectors.training.config import BackgroundConfig, PictureSetConfig, SplatConfig
from attacks.detectors.training.dataset import load, make
from attacks.detectors.training.false_positives import FalsePositives, false_positives
from attacks.detectors.training.pictures import LabelledPicture
from attacks.detectors.training.splat_pictures import splat_set

MIN_CONFIDENCE = 0.001
"""Confidence of YOLO's detections that count in an average precision; its own floor of 0.25 would cut the curve off."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOutResult:
    """A detector on one set of pictures.

    Attributes:
        score: Average precision and recall; None for a set without objects.
        false_positives: At a confidence of 0.5 and an intersection over union of 0.5.
    """

    score: Score | None
    false_positives: FalsePositives


def load_for_evaluation(name: str, weights: Path | None = None) -> Detector:
    """A small detector that keeps its unlikely detections too, as an average precision needs them.

    The R-CNN keeps its own floor of 0.05, with which its published figures were measured.

    Raises:
        DetectorError: Its weights are missing or do not fit, or it needs a package that is not there.
    """
    if name == "yolov8n_small":
        from attacks.detectors import ultralytics

        return ultralytics.load_small(weights, min_confidence=MIN_CONFIDENCE)
    from attacks.detectors import torchvision

    return torchvision.load_small(weights)


def held_out_sets(
    folder: Path,
    scenes: PictureSetConfig,
    *,
    splats: int,
    splat: SplatConfig,
    backgrounds: BackgroundConfig,
    processes: int,
    on_work: Callable[[str, int, int], None],
) -> dict[str, list[LabelledPicture]]:
    """Held-out pictures by set: path traced, renders of splats, and each kind of background.

    Args:
        folder: Where the pictures are kept; what is missing is made.
        scenes: Scenes with objects, and how many pictures of them.
        splats: Number of further such scenes that are made into splats; 0 leaves them out.
        splat: How splats are made.
        backgrounds: Pictures without objects.
        processes: How many processes make path-traced pictures; 0 makes them in this one.
        on_work: Called with what is going on, the units of it that are done, and the number wanted.

    Raises:
        InvalidValueError: The folder holds pictures that were made otherwise.
    """
    text = "path-traced pictures"
    make(scenes, folder / scenes.split, processes=processes, on_step=lambda done, all_: on_work(text, done, all_))
    sets = {"path traced": load(folder / scenes.split, limit=scenes.count)} if scenes.count else {}
    if splats:
        sets["splat renders"] = splat_set(
            scenes,
            range(10_000, 10_000 + splats),  # none of the path-traced scenes
            folder / "splats",
            splat,
            on_step=lambda done, all_: on_work("splats", done, all_),
        )
    empty = background_sets(
        folder / "backgrounds", backgrounds, on_step=lambda done, all_: on_work("backgrounds", done, all_)
    )
    return sets | {f"background: {kind}": pictures for kind, pictures in empty.items() if pictures}


def evaluate_sets(
    detector: Detector, sets: Mapping[str, Sequence[LabelledPicture]], *, confidence: float = 0.5
) -> dict[str, HeldOutResult]:
    """Run a detector over sets of labelled pictures.

    Args:
        detector: Its classes are those that the labels count in.
        sets: Name to pictures of one size.
        confidence: Least confidence of a false positive.
    """
    found = {}
    for name, pictures in sets.items():
        results = detect_all(detector, pictures)
        any_object = any(len(picture.labels) for picture in pictures)
        found[name] = HeldOutResult(
            score=score(results, pictures, detector.classes) if any_object else None,
            false_positives=false_positives(results, pictures, detector.classes, confidence=confidence),
        )
    return found


def figures(results: Mapping[str, HeldOutResult]) -> dict[str, dict[str, object]]:
    """The results as JSON can hold them."""
    return {
        name: {
            **({} if result.score is None else {**asdict(result.score), "map": result.score.mean}),
            "pictures": result.false_positives.pictures,
            "false_positives": {
                "per_picture": result.false_positives.rate,
                "total": result.false_positives.total,
                "interval": list(result.false_positives.interval),
                "pictures_with": result.false_positives.pictures_with,
                "by_class": result.false_positives.by_class,
            },
        }
        for name, result in results.items()
    }
