"""A clean and an attacked splat side by side: how often an object is found, missed, or
taken for the target.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
import torch
from numpy.typing import NDArray
from torch import Tensor

from attacks.detectors.base import Detector
from attacks.gaussian_subset import Mask
from attacks.observe.drawing import annotated, stacked
from attacks.observe.observations import Observations, observations_of, report_cells
from attacks.observe.rates import (
    REPORTED,
    Confidence,
    Group,
    Measure,
    comparison_measures,
    count,
    with_control,
)
from attacks.observe.rows import ATTACKED, CLEAN, Cell
from attacks.observe.views import ViewDetections, evaluate
from attacks.rate import FEW, Rate
from mi_splat.cameras.camera import Camera, RenderFn
from mi_splat.errors import InvalidValueError, listed
from mi_splat.fields import between, checked_number
from mi_splat.maths.metrics import psnr
from mi_splat.scene import GaussianScene


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Judged:
    """What detectors report on splats from the same cameras, on the files and pictures
    of 8 bits.

    Attributes:
        rows: A table of Polars with a row for each splat, view and detector;
            docs/rows.md explains its columns.
        detections: One with a row for each detection.
        views: The picture and the detections of each view, for each splat: batch by
            batch, detector by detector.
        confidence: From which a detection counts in `rates`, in [0, 1].
    """

    rows: pl.DataFrame
    detections: pl.DataFrame
    views: Mapping[str, Sequence[ViewDetections]]
    confidence: float

    def __repr__(self) -> str:
        rates = (
            f"{detector + ': ' if len(self.rates) > 1 else ''}{name} {rate.successes}"
            f" of {rate.total}"
            for detector, by_measure in self.rates.items()
            for name, rate in by_measure.items()
        )
        return f"Judged({listed(self.views)}; {listed(rates)})"

    @property
    def rates(self) -> dict[str, dict[str, Rate]]:
        """For each detector, of the views in which the object shows, how often it is
        what.

        `found_clean` and `found_attacked`: reported as what it is; `missed`: not
        reported any more; `target_clean` and `target_attacked`: reported as the target,
        if there is one. Of a clean splat alone only the first.
        """
        if ATTACKED in self.views:
            compared = compare(self.rows, confidence=self.confidence)
            return {
                comparison.detector: dict(comparison.rates) for comparison in compared
            }
        reported = Measure(
            holds=pl.col("original_score") >= self.confidence,
            given=pl.col("x0").is_not_null(),
        )
        counted = count(self.rows, {f"found_{CLEAN}": reported}, ("detector",))
        return {str(detector): rates for (detector,), rates in counted.items()}

    def count(
        self, measures: Mapping[str, Measure], by: Sequence[str] = ("detector",)
    ) -> dict[Group, dict[str, Rate]]:
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

    Every splat goes through its file, and every picture through 8 bits, as a user would
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
        confidence: From which a detection counts, in [0, 1].

    Returns:
        Rows, rates and pictures.

    Raises:
        InvalidValueError: No splat is called "clean", or an argument is of another
            kind.
    """
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
    views = evaluate(splats, mask, cameras, detectors, render=render)
    looked = compared_rows(
        views, original=original, target=target, min_confidence=confidence
    )
    return Judged(
        rows=looked.rows,
        detections=looked.detections,
        views=views,
        confidence=confidence,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """One detector on both splats; rates count the views in which the object shows."""

    detector: str  # its name
    # what the object is; None where any class counts, since nothing said what it is
    original: str | None
    target: str | None  # what the attacker wants it to be; None if nothing certain
    views: int  # in which the object shows
    # those of `comparison_measures`, by name; none of the target without one
    rates: Mapping[str, Rate]
    # mean dB between the clean and the attacked pictures that differ; None where all
    # are the same
    psnr: float | None

    @classmethod
    def of(cls, detector: str, values: Mapping[str, Any]) -> Comparison:
        """What `as_dict` has made."""
        rates = {
            name: Rate.of(value)
            for name, value in values.items()
            if isinstance(value, Mapping)
        }
        return cls(
            detector=detector,
            rates=rates,
            **{name: values[name] for name in values if name not in rates},
        )

    def as_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        numbers = {
            "original": self.original,
            "target": self.target,
            "views": self.views,
            "psnr": self.psnr,
        }
        return {
            **numbers,
            **{name: rate.as_dict() for name, rate in self.rates.items()},
        }

    def doubts(self, cameras: int) -> list[str]:
        """Reasons to doubt the rates, given the number of cameras."""
        clean = self.rates["found_clean"]
        reasons = []
        if self.views < FEW:
            reasons.append(
                f"{self.detector}: the object shows in {self.views} of {cameras}"
                " views: few"
            )
        if self.original is None:
            reasons.append(
                f"{self.detector} finds nothing on the clean object, so that it is"
                " missed proves nothing"
            )
        elif clean.fraction < 0.5:
            reasons.append(
                f"{self.detector} finds the clean object in {clean.successes} of"
                f" {clean.total} views only"
            )
        return reasons


def compared_rows(
    seen: Mapping[str, Sequence[ViewDetections]],
    *,
    original: str | None = None,
    target: str | None = None,
    min_confidence: float = REPORTED,
    judges: Collection[str] = (),
) -> Observations:
    """What detectors report on a clean and an attacked splat, row by row; for `judges`
    neither class is given.
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
    own = {name: None if name in judges else original for name in shown}
    originals = {
        name: own[name] or usual_label(views, min_confidence)
        for name, views in shown.items()
    }

    def cells(view: ViewDetections) -> dict[str, Cell]:
        before = clean[view.detector, view.view]
        if torch.equal(before.pixels, view.pixels):
            change = None
        else:
            change = float(psnr(before.image, view.image))
        wanted = None if view.detector in judges else target
        known = report_cells(
            view.detections, view.box, original=originals[view.detector], target=wanted
        )
        return {**known, "psnr": change}

    return observations_of(
        (({"splat": splat}, view) for splat, views in seen.items() for view in views),
        cells,
    )


def compare(
    rows: pl.DataFrame, *, confidence: Confidence = REPORTED
) -> list[Comparison]:
    """Rates of each detector on the clean and the attacked splat, and the distance of
    their pictures.
    """
    comparisons = []
    for (detector,), seen in rows.partition_by(
        "detector", maintain_order=True, as_dict=True
    ).items():
        here = seen.filter(splat=ATTACKED)
        measures = comparison_measures(
            confidence, targeted=here["target"].null_count() < len(here)
        )
        rates = count(with_control(seen), measures)[()]
        psnrs = here["psnr"].drop_nulls()
        comparisons.append(
            Comparison(
                detector=detector,
                original=here["original"][0],
                target=here["target"][0],
                views=rates["found_clean"].total,
                rates=rates,
                psnr=None if psnrs.is_empty() else float(psnrs.to_numpy().mean()),
            )
        )
    return comparisons


def contradictions(
    rows: pl.DataFrame,
    judges: Mapping[str, Sequence[str]],
    cameras: Sequence[str],
    *,
    confidence: float = REPORTED,
) -> list[dict[str, Any]]:
    """Where judges contradict the other detectors, for each pair, as JSON can hold it.

    In a view, the most confident class on the object counts, from `confidence` on. Of a
    detector's report only what the judge could report too is compared: a judge that
    knows stop signs alone contradicts a detector that reports a TV where it reports a
    sign, or a sign where it reports none.

    Of each detector and judge (name and classes) come back the rate of contradicted
    views of the clean splat (false flags) and of the attacked one, and the names of
    these views.
    """
    sure = pl.when(pl.col("score") >= confidence).then("label")
    seen = rows.filter(pl.col("x0").is_not_null()).select(
        "splat", "view", "detector", sure.alias("report")
    )
    pairs = []
    for detector, judge in itertools.product(dict.fromkeys(rows["detector"]), judges):
        if detector in judges:
            continue
        said = seen.filter(detector=judge).select("splat", "view", verdict="report")
        both = seen.filter(detector=detector).join(
            said, on=("splat", "view"), maintain_order="left"
        )
        common = pl.when(pl.col("report").is_in(judges[judge])).then("report")
        both = both.with_columns(contradicted=common.ne_missing(pl.col("verdict")))
        rates = count(both, {"rate": Measure(holds=pl.col("contradicted"))}, ("splat",))
        views = both.filter("contradicted").with_columns(
            camera=pl.col("view").replace_strict(dict(enumerate(cameras)))
        )
        none = {"rate": Rate(successes=0, total=0)}
        pair = {
            splat: rates.get((splat,), none)["rate"].as_dict()
            for splat in (CLEAN, ATTACKED)
        }
        contradicted = views.select("splat", "camera", "report", "verdict").to_dicts()
        pairs.append(
            {"detector": detector, "judge": judge, **pair, "views": contradicted}
        )
    return pairs


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
    """Boxes on the clean pictures (left) and the attacked ones (right), views below one
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
