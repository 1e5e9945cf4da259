"""How often an attack reaches its aim.

A rate is given in both forms that reviewers ask for: over all views, and over those where the benign object was found
in the first place.
"""

from __future__ import annotations

from collections.abc import Sequence

from attacks.evaluation.views import ViewDetections
from attacks.rate import Rate

__all__ = ["Rate", "rates"]


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
