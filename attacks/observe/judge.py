"""`judge`: what detectors report on splats from many cameras, as rows, rates and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import polars as pl

from attacks.detectors.base import Detector
from attacks.gaussian_subset import Mask
from attacks.observe.comparison import compare, compared_rows
from attacks.observe.measures import REPORTED
from attacks.observe.rates import Group, Measure, count
from attacks.observe.rows import ATTACKED, CLEAN
from attacks.observe.views import ViewDetections, evaluate
from attacks.rate import Rate
from mi_splat._lazy import Previewed
from mi_splat.cameras import Camera, RenderFn
from mi_splat.errors import InvalidValueError, listed
from mi_splat.fields import between, checked_number
from mi_splat.scene import GaussianScene


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Judged(Previewed):
    """What detectors report on splats from the same cameras, on the files and pictures of 8 bits.

    Attributes:
        rows: A table of Polars with a row for each splat, view and detector; docs/rows.md explains its columns.
        detections: One with a row for each detection.
        views: The picture and the detections of each view, for each splat: batch by batch, detector by detector.
        confidence: From which a detection counts in `rates`, in [0, 1].
    """

    rows: pl.DataFrame
    detections: pl.DataFrame
    views: Mapping[str, Sequence[ViewDetections]]
    confidence: float

    def __repr__(self) -> str:
        rates = (
            f"{detector + ': ' if len(self.rates) > 1 else ''}{name} {rate.successes} of {rate.total}"
            for detector, by_measure in self.rates.items()
            for name, rate in by_measure.items()
        )
        return f"Judged({listed(self.views)}; {listed(rates)})"

    @property
    def rates(self) -> dict[str, dict[str, Rate]]:
        """For each detector, of the views in which the object shows, how often it is what.

        `found_clean` and `found_attacked`: reported as what it is; `missed`: not reported any more; `target_clean` and
        `target_attacked`: reported as the target, if there is one. Of a clean splat alone only the first.
        """
        if ATTACKED in self.views:
            compared = compare(self.rows, confidence=self.confidence)
            return {comparison.detector: dict(comparison.rates) for comparison in compared}
        reported = Measure(holds=pl.col("original_score") >= self.confidence, given=pl.col("x0").is_not_null())
        counted = count(self.rows, {f"found_{CLEAN}": reported}, ("detector",))
        return {str(detector): rates for (detector,), rates in counted.items()}

    def count(self, measures: Mapping[str, Measure], by: Sequence[str] = ("detector",)) -> dict[Group, dict[str, Rate]]:
        """Any rate that the rows give."""
        return count(self.rows, measures, by)


def judge(
    scenes: GaussianScene | Mapping[str, GaussianScene],
    mask: Mask,
    cameras: Camera | Sequence[Camera],
    detectors: Detector | str | Sequence[Detector | str],
    *,
    render: RenderFn,
    original: str | None = None,
    target: str | None = None,
    confidence: float = REPORTED,
) -> Judged:
    """Let detectors look at one object of splats from many cameras.

    Every splat goes through its file, and every picture through 8 bits, as a user would get them.

    Args:
        scenes: Splats by name, with the same Gaussians in the same order: the untouched one is called "clean", the
            attacked one "attacked", others as you like. Or the clean one alone.
        mask: The object's Gaussians: (N,) bool, row numbers, or a slice.
        cameras: Views; better others than those that were attacked.
        detectors: Any number, with different names; or their names.
        render: The renderer.
        original: What the object is; None is what each detector calls it in most views of the clean splat.
        target: What the attacker wants it to be; None if nothing certain.
        confidence: From which a detection counts, in [0, 1].

    Returns:
        Rows, rates and pictures.

    Raises:
        InvalidValueError: No splat is called "clean", or an argument is of another kind.
    """
    checked_number("confidence", confidence, between(0, 1))
    splats = {CLEAN: scenes} if isinstance(scenes, GaussianScene) else scenes
    if not isinstance(splats, Mapping):
        got = type(scenes).__name__
        raise InvalidValueError.of("scenes", "scenes by name, or one", got, 'pass {"clean": ..., "attacked": ...}')
    views = evaluate(splats, mask, cameras, detectors, render=render)
    looked = compared_rows(views, original=original, target=target, min_confidence=confidence)
    return Judged(rows=looked.rows, detections=looked.detections, views=views, confidence=confidence)
