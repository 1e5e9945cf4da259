"""A clean and an attacked splat side by side: how often an object is found, missed, or
taken for the target.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
import torch
from numpy.typing import NDArray
from torch import Tensor

from attacks.detectors.base import Detector
from attacks.detectors.registry import as_detectors, operating_threshold
from attacks.figures.frame import MEASURE, Figures
from attacks.figures.rate import FEW, Rate
from attacks.gaussian_subset import Mask
from attacks.observe.conditions import OWN
from attacks.observe.drawing import annotated, stacked
from attacks.observe.observations import Observations, observations_of, report_cells
from attacks.observe.rates import (
    REPORTED,
    Confidence,
    Measure,
    comparison_measures,
    confidence_for,
    count,
    reported,
    with_control,
)
from attacks.observe.rows import ATTACKED, CLEAN, ROWS, Cell
from attacks.observe.sector import HIDDEN, sector_figures
from attacks.observe.survival import survival_figures
from attacks.observe.views import ViewDetections, detect_scenes
from mi_splat.cameras.camera import Camera, RenderFn
from mi_splat.errors import InvalidValueError, listed
from mi_splat.fields import between, checked_number
from mi_splat.maths.metrics import psnr
from mi_splat.scene import GaussianScene


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class DetectionRates:
    """What detectors report on splats from the same cameras, on the files and images
    of 8 bits.

    Attributes:
        rows: A table of Polars with a row for each splat, view and detector;
            docs/rows.md explains its columns.
        detections: One with a row for each detection.
        views: The image and the detections of each view, for each splat: batch by
            batch, detector by detector.
        confidence: From which a detection counts in `rates`, in [0, 1], or by the name
            of each detector.
    """

    rows: pl.DataFrame
    detections: pl.DataFrame
    views: Mapping[str, Sequence[ViewDetections]]
    confidence: float | Mapping[str, float]

    def __repr__(self) -> str:
        rates = (
            f"{detector + ': ' if len(self.rates) > 1 else ''}{name} {rate.successes}"
            f" of {rate.total}"
            for detector, by_measure in self.rates.items()
            for name, rate in by_measure.items()
        )
        return f"DetectionRates({listed(self.views)}; {listed(rates)})"

    @property
    def rates(self) -> dict[str, dict[str, Rate]]:
        """For each detector, of the views in which the object shows, how often it is
        what.

        `found_clean` and `found_attacked`: reported as what it is; `missed`: not
        reported any more; `target_clean` and `target_attacked`: reported as the target,
        if there is one. Of a clean splat alone only the first.
        """
        figures = self._figures()
        return {
            detector: {
                measure: of_one.rate(measure) for measure in of_one.labels(MEASURE)
            }
            for (detector,), of_one in figures.groups("detector").items()
        }

    def _figures(self) -> Figures:
        if ATTACKED in self.views:
            return compared_rates(self.rows, self.confidence)
        found = Measure(
            holds=reported("original_score", self.confidence),
            given=pl.col("x0").is_not_null(),
        )
        return count(self.rows, {f"found_{CLEAN}": found}, ("detector",))

    def count(
        self, measures: Mapping[str, Measure], by: Sequence[str] = ("detector",)
    ) -> Figures:
        """Any rate that the rows give."""
        return count(self.rows, measures, by)


def evaluate(
    scenes: GaussianScene | Mapping[str, GaussianScene],
    mask: Mask,
    cameras: Camera | Sequence[Camera],
    detectors: Detector | str | Sequence[Detector | str],
    *,
    render: RenderFn,
    original: str | None = None,
    target: str | None = None,
    confidence: float | None = None,
) -> DetectionRates:
    """Run detectors on one object of splats from many cameras.

    Every splat goes through its file, and every image through 8 bits, as a user would
    get them.

    Args:
        scenes: Splats by name, with the same Gaussians in the same order: the untouched
            one is called "clean", the attacked one "attacked", others as you like. Or
            the clean one alone.
        mask: The object's Gaussians: (N,) bool, row numbers, or a slice.
        cameras: Views; better others than those that were attacked.
        detectors: Any number, with different names; or their names.
        render: The renderer.
        original: What the object is; None is what each detector calls it in most views
            of the clean splat.
        target: What the attacker wants it to be; None if nothing certain.
        confidence: From which a detection counts, in [0, 1]; None is the operating
            threshold of each detector.

    Returns:
        Rows, rates and images.

    Raises:
        InvalidValueError: No splat is called "clean", or an argument is of another
            kind.
    """
    if confidence is not None:
        checked_number("confidence", confidence, between(0, 1))
    splats = {CLEAN: scenes} if isinstance(scenes, GaussianScene) else scenes
    if not isinstance(splats, Mapping):
        got = type(scenes).__name__
        raise InvalidValueError.of(
            "scenes",
            "scenes by name, or one",
            got,
            'pass {"clean": ..., "attacked": ...}',
        )
    chosen = as_detectors(detectors)
    views = detect_scenes(splats, mask, cameras, chosen, render=render)
    least = thresholds_of(chosen) if confidence is None else confidence
    looked = compared_rows(
        views, original=original, target=target, min_confidence=least
    )
    return DetectionRates(
        rows=looked.rows,
        detections=looked.detections,
        views=views,
        confidence=least,
    )


def thresholds_of(detectors: Sequence[Detector]) -> dict[str, float]:
    """Operating thresholds by the names of detectors."""
    return {one.name: operating_threshold(one) for one in detectors}


Classes = str | Sequence[str] | None
"""What an object is: a class, several of which any counts, or any at all."""


def compared_rows(
    seen: Mapping[str, Sequence[ViewDetections]],
    *,
    original: str | Sequence[str] | None = None,
    target: str | None = None,
    min_confidence: float | Mapping[str, float] = REPORTED,
    checkers: Collection[str] = (),
    place: Callable[[ViewDetections], Mapping[str, Cell]] | None = None,
) -> Observations:
    """What detectors report on a clean and an attacked splat, row by row; for
    `checkers` neither class is given, and `place` gives further cells.
    """
    clean = {(view.detector, view.view): view for view in seen[CLEAN]}
    shown = {
        name: [
            view
            for view in seen[CLEAN]
            if view.detector == name and view.box is not None
        ]
        for name, _ in clean
    }
    own = {name: None if name in checkers else original for name in shown}
    originals: dict[str, Classes] = {
        name: own[name] or usual_label(views, confidence_for(name, min_confidence))
        for name, views in shown.items()
    }
    cells = compared_cells(
        originals, target=target, checkers=checkers, place=place, clean=clean
    )
    return observations_of(
        (({"splat": splat}, view) for splat, views in seen.items() for view in views),
        cells,
    )


def compared_cells(
    originals: Mapping[str, Classes],
    *,
    target: str | None = None,
    checkers: Collection[str] = (),
    place: Callable[[ViewDetections], Mapping[str, Cell]] | None = None,
    clean: Mapping[tuple[str, int], ViewDetections] | None = None,
) -> Callable[[ViewDetections], dict[str, Cell]]:
    """The cells of `compared_rows`, given what the object is to each detector.

    Each view is compared with that of the clean splat: the first that is seen where
    `clean` does not have it.
    """
    before = dict(clean or {})

    def cells(view: ViewDetections) -> dict[str, Cell]:
        first = before.setdefault((view.detector, view.view), view)
        if torch.equal(first.pixels, view.pixels):
            change = None
        else:
            change = float(psnr(first.image, view.image))
        wanted = None if view.detector in checkers else target
        known = report_cells(
            view.detections, view.box, original=originals[view.detector], target=wanted
        )
        where = {} if place is None else place(view)
        return {**where, **known, "psnr": change}

    return cells


def compare(rows: pl.DataFrame, *, confidence: Confidence = REPORTED) -> Figures:
    """Rates of each detector on the clean and the attacked splat, and the mean PSNR of
    those of their images that differ.
    """
    means = rows.filter(splat=ATTACKED).group_by("detector", maintain_order=True)
    distances = Figures.of(
        ({MEASURE: "psnr", "detector": detector}, psnr)
        for detector, psnr in means.agg(pl.col("psnr").mean()).iter_rows()
    )
    return Figures.together([compared_rates(rows, confidence), distances])


def figures(record: Mapping[str, Any], tables: Mapping[str, pl.DataFrame]) -> Figures:
    """Every figure of an evaluation, from its rows."""
    rows = tables[ROWS]
    confidence = record["min_confidence"]
    survived = Figures({})
    if "condition" in rows.columns:
        survived = survival_figures(rows, confidence)
        rows = rows.filter(condition=OWN).drop("condition")
    compared = compare(rows, confidence=confidence)
    checkers = record.get("cross_checks", {})
    parts = [
        compared,
        contradictions(rows, checkers, confidence=confidence),
        survived,
    ]
    if HIDDEN in rows.columns:
        parts.append(sector_figures(rows, confidence))
    return Figures.together(parts)


def compared_rates(rows: pl.DataFrame, confidence: Confidence) -> Figures:
    """The rates of `compare`."""
    parts = []
    for seen in rows.partition_by("detector", maintain_order=True):
        targets = seen.filter(splat=ATTACKED)["target"]
        targeted = targets.null_count() < len(targets)
        measures = comparison_measures(confidence, targeted=targeted)
        parts.append(count(with_control(seen), measures, ("detector",)))
    return Figures.together(parts)


def classes_of(rows: pl.DataFrame) -> dict[str, tuple[str | None, str | None]]:
    """For each detector what the object is, and what the attacker wants it to be; None
    where any class counts, or where nothing certain is wanted.
    """
    first = rows.filter(splat=ATTACKED).unique(
        "detector", keep="first", maintain_order=True
    )
    columns = first.select("detector", "original", "target").iter_rows()
    return {detector: (original, target) for detector, original, target in columns}


def doubts(rows: pl.DataFrame, figures: Figures, cameras: int) -> Iterator[str]:
    """Reasons to doubt the rates of a comparison, given the number of cameras."""
    for detector, (original, _) in classes_of(rows).items():
        clean = figures.rate("found_clean", detector=detector)
        if clean.total < FEW:
            shown = f"the object shows in {clean.total} of {cameras} views: few"
            yield f"{detector}: {shown}"
        if original is None:
            yield (
                f"{detector} finds nothing on the clean object, so that it is missed"
                " proves nothing"
            )
        elif clean.fraction < 0.5:
            yield f"{detector} finds the clean object in {clean.counts} views only"


def contradicted_views(
    rows: pl.DataFrame,
    checkers: Mapping[str, Sequence[str]],
    *,
    confidence: Confidence = REPORTED,
) -> pl.DataFrame:
    """Which views checkers contradict, for each detector and each one that checks it.

    In a view, the most confident class on the object counts, from `confidence` on. Of a
    detector's report only what the checker could report too is compared: a checker that
    knows only stop signs contradicts a detector that reports a TV where it reports a
    sign, or a sign where it reports none.

    Args:
        rows: Of clean and attacked splats.
        checkers: Their classes by their names.
        confidence: From which a detection counts.

    Returns:
        A row for each detector, checker, splat and view in which the object shows, with
        the `report`, the `verdict` of the checker, and whether it is `contradicted`.
    """
    sure = pl.when(reported("score", confidence)).then("label")
    seen = rows.filter(pl.col("x0").is_not_null()).select(
        "splat", "view", "detector", report=sure
    )
    others = seen.filter(~pl.col("detector").is_in([*checkers]))
    pairs = []
    for checker, classes in checkers.items():
        said = seen.filter(detector=checker).select("splat", "view", verdict="report")
        both = others.join(said, on=("splat", "view"), maintain_order="left")
        common = pl.when(pl.col("report").is_in(classes)).then("report")
        contradicted = common.ne_missing(pl.col("verdict"))
        pairs.append(
            both.with_columns(checked_by=pl.lit(checker), contradicted=contradicted)
        )
    return pl.concat(pairs)


def contradictions(
    rows: pl.DataFrame,
    checkers: Mapping[str, Sequence[str]],
    *,
    confidence: Confidence = REPORTED,
) -> Figures:
    """How often checkers contradict each detector: on the clean splat these are false
    flags.
    """
    if not checkers:
        return Figures({})
    views = contradicted_views(rows, checkers, confidence=confidence)
    contradicted = {"contradicted": Measure(holds=pl.col("contradicted"))}
    return count(views, contradicted, ("detector", "checked_by", "splat"))


def usual_label(
    views: Sequence[ViewDetections], min_confidence: float = 0.5
) -> str | None:
    """What a detector calls the object in most views; None if it finds nothing
    there.
    """
    labels = sorted({label for view in views for label in view.detections.labels})
    counts = {
        label: sum(view.confidence(label) >= min_confidence for view in views)
        for label in labels
    }
    best = max(counts, key=lambda label: counts[label], default=None)
    if best is not None and counts[best]:
        return best
    return None


def largest_changes(clean: GaussianScene, attacked: GaussianScene) -> Tensor:
    """(N,) the largest change of any value of each Gaussian."""
    if len(clean) != len(attacked):
        got = f"{len(clean):,} and {len(attacked):,}"
        do = "pass the scene that was attacked"
        raise InvalidValueError.of(
            "the scenes", "the same Gaussians in both", got, do
        ).hinted("--box")
    degree = max(clean.degree, attacked.degree)
    pairs = zip(
        clean.with_degree(degree).tensors(),
        attacked.with_degree(degree).tensors(),
        strict=True,
    )
    return torch.stack(
        [
            (before - after).abs().reshape(len(before), -1).amax(1)
            for before, after in pairs
        ]
    ).amax(0)


def changed_mask(clean: GaussianScene, attacked: GaussianScene) -> Tensor:
    """(N,) bool, which Gaussians an attack changed."""
    changed = largest_changes(clean, attacked) > 0
    if not bool(changed.any()):
        expected = "one that differs from the other"
        do = "say which Gaussians are the object, for instance by a box"
        raise InvalidValueError.of(
            "the scenes", expected, "two that are the same", do
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
    """Boxes on the clean images (left) and the attacked ones (right), views below one
    another.
    """
    before, after = (
        [view for view in views if view.detector == detector]
        for views in (clean, attacked)
    )
    rows = [
        round(i * (len(before) - 1) / max(min(most, len(before)) - 1, 1))
        for i in range(min(most, len(before)))
    ]
    return stacked(
        [
            np.concatenate(
                [
                    annotated(
                        view.image,
                        view.detections,
                        f"{name}, {names[row] if names else row}",
                    )
                    for view, name in ((before[row], "clean"), (after[row], "attacked"))
                ],
                axis=1,
            )
            for row in rows
        ]
    )
