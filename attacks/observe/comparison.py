"""A clean and an attacked scene side by side: how often an object is found, missed, or taken for the target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from attacks.observe.drawing import annotated, stacked
from attacks.observe.views import ViewDetections
from attacks.rate import Rate
from mi_splat.errors import InvalidValueError, message
from mi_splat.metrics import psnr
from mi_splat.scene import ATTRIBUTES, GaussianScene


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """One detector on both scenes; rates count the views in which the object shows.

    Attributes:
        detector: Its name.
        original: What the object is; None where any class counts, since nothing said what it is.
        target: What the attacker wants it to be; None if nothing certain.
        views: Views in which the object shows.
        found_clean: The object is found in the clean scene.
        found_attacked: The object is found in the attacked scene.
        missed: Of the views where it is found clean, the attacked object is not.
        target_clean: The target is reported on the object in the clean scene: false positives; None without a target.
        target_attacked: The same in the attacked scene.
        psnr: Mean dB between the clean and the attacked pictures; None where they are the same.
    """

    detector: str
    original: str | None
    target: str | None
    views: int
    found_clean: Rate
    found_attacked: Rate
    missed: Rate
    target_clean: Rate | None
    target_attacked: Rate | None
    psnr: float | None

    @property
    def rates(self) -> dict[str, Rate]:
        """The rates by name, in order."""
        every = {
            "found_clean": self.found_clean,
            "found_attacked": self.found_attacked,
            "missed": self.missed,
            "target_clean": self.target_clean,
            "target_attacked": self.target_attacked,
        }
        return {name: rate for name, rate in every.items() if rate is not None}

    def as_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        numbers = {"original": self.original, "target": self.target, "views": self.views, "psnr": self.psnr}
        return {**numbers, **{name: rate.as_dict() for name, rate in self.rates.items()}}


def compare(
    clean: Sequence[ViewDetections],
    attacked: Sequence[ViewDetections],
    *,
    detector: str,
    original: str | None = None,
    target: str | None = None,
    min_confidence: float = 0.5,
) -> Comparison:
    """What one detector makes of both scenes.

    Args:
        clean: The clean scene, from `evaluate`.
        attacked: The attacked scene, from the same cameras.
        detector: Name of the detector whose views count.
        original: What the object is; if None, what the detector calls it in most views of the clean scene.
        target: What the attacker wants it to be.
        min_confidence: Confidence from which a detection counts, in [0, 1].
    """
    before, after = ([view for view in views if view.detector == detector] for views in (clean, attacked))
    shown, shown_after = ([view for view in views if view.box is not None] for views in (before, after))
    original = usual_label(shown, min_confidence) if original is None else original

    def found(view: ViewDetections, label: str | None) -> bool:
        return view.confidence(label) >= min_confidence

    gone = rates(before, after, original=original, wanted=None, min_confidence=min_confidence)
    gaps = [psnr(b.image, a.image) for b, a in zip(before, after, strict=True) if not torch.equal(b.pixels, a.pixels)]
    return Comparison(
        detector=detector,
        original=original,
        target=target,
        views=len(shown),
        found_clean=Rate.of(shown, lambda view: found(view, original)),
        found_attacked=Rate.of(shown_after, lambda view: found(view, original)),
        missed=gone["given_found"],
        target_clean=None if target is None else Rate.of(shown, lambda view: found(view, target)),
        target_attacked=None if target is None else Rate.of(shown_after, lambda view: found(view, target)),
        psnr=float(torch.stack(gaps).mean()) if gaps else None,
    )


def usual_label(views: Sequence[ViewDetections], min_confidence: float = 0.5) -> str | None:
    """What a detector calls the object in most views; None if it finds nothing there."""
    labels = sorted({label for view in views for label in view.detections.labels})
    counts = {label: sum(view.confidence(label) >= min_confidence for view in views) for label in labels}
    best = max(counts, key=lambda label: counts[label], default=None)
    return best if best is not None and counts[best] else None


def changed_mask(clean: GaussianScene, attacked: GaussianScene) -> Tensor:
    """(N,) bool, which Gaussians an attack changed.

    Raises:
        InvalidValueError: There are other numbers of Gaussians, or all are the same.
    """
    do = "say which Gaussians are the object, for instance by a box"
    if len(clean) != len(attacked):
        got = f"{len(clean):,} and {len(attacked):,}"
        raise InvalidValueError(message("the scenes", "the same Gaussians in both", got, do)).hinted("--box")
    degree = max(clean.degree, attacked.degree)
    changed = torch.zeros(len(clean), dtype=torch.bool)
    for name in ATTRIBUTES:
        before, after = (getattr(scene.with_degree(degree), name) for scene in (clean, attacked))
        changed |= (before != after).reshape(len(clean), -1).any(-1)
    if not bool(changed.any()):
        raise InvalidValueError(
            message("the scenes", "one that differs from the other", "two that are the same", do)
        ).hinted("--box")
    return changed


def side_by_side(
    clean: Sequence[ViewDetections],
    attacked: Sequence[ViewDetections],
    *,
    detector: str,
    most: int,
    names: Sequence[str] = (),
) -> NDArray[np.uint8]:
    """Boxes on the clean pictures (left) and the attacked ones (right), views below one another.

    Args:
        clean: The clean scene, from `evaluate`.
        attacked: The attacked scene, from the same cameras.
        detector: Whose boxes.
        most: Views shown, evenly out of all.
        names: Of the cameras; numbers if there are none.
    """
    before, after = ([view for view in views if view.detector == detector] for views in (clean, attacked))
    rows = [round(i * (len(before) - 1) / max(min(most, len(before)) - 1, 1)) for i in range(min(most, len(before)))]
    return stacked(
        [
            np.concatenate(
                [
                    annotated(view.image, view.detections, f"{name}, {names[row] if names else row}")
                    for view, name in ((before[row], "clean"), (after[row], "attacked"))
                ],
                axis=1,
            )
            for row in rows
        ]
    )


def rates(
    clean: Sequence[ViewDetections],
    attacked: Sequence[ViewDetections],
    *,
    original: str | None,
    wanted: str | None,
    min_confidence: float = 0.5,
    detector: str | None = None,
) -> dict[str, Rate]:
    """How often an attack reaches its aim.

    Args:
        clean: The clean scene, from `evaluate` or `detect_views`.
        attacked: The attacked scene, from the same cameras by the same detectors.
        original: What the object is; None counts any class.
        wanted: What the attacker wants it to be; None counts a view as a success when `original` is gone.
        min_confidence: Confidence from which a detection counts, in [0, 1].
        detector: Name of the detector whose views count; None counts those of all.

    Returns:
        `all`: over all views in which the object shows; `given_found`: over those where the clean object is found.
    """
    benign = {(view.detector, view.view): view for view in clean}
    pairs = [
        (benign[view.detector, view.view], view)
        for view in attacked
        if view.box is not None and detector in (None, view.detector)
    ]

    def reached(pair: tuple[ViewDetections, ViewDetections]) -> bool:
        if wanted is None:
            return pair[1].confidence(original) < min_confidence
        return pair[1].confidence(wanted) >= min_confidence

    def found(pair: tuple[ViewDetections, ViewDetections]) -> bool:
        return pair[0].confidence(original) >= min_confidence

    return {"all": Rate.of(pairs, reached), "given_found": Rate.of(pairs, reached, given=found)}
