"""Rates are counted from rows: a figure is a measure, and a group of rows that it is
counted over.

Rows are a table of Polars. A measure is two of its expressions: what has to hold in a
row, and which rows count.

Rows of neighbouring cameras agree, and so do those of splats that share their images.
An interval that takes them for independent is two to three times too narrow. So a rate
over many views is resampled in blocks of neighbouring cameras and in seeds, each drawn
anew with replacement (the pigeonhole bootstrap: Owen 2007, "The pigeonhole bootstrap").
What holds of one object need not hold of the next: a rate over several has them drawn
anew, too.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import numpy as np
import polars as pl
from numpy.typing import NDArray

from attacks.figures.frame import HIGH, LOW, MEASURE, Figures
from attacks.figures.rate import Rate, wilson
from attacks.observe.rows import (
    ATTACKED,
    CLEAN,
    DEPTH,
    NOISE,
    OPERATING,
    TARGET_SCORE,
)
from mi_splat.errors import listed

DRAWS = 2000
FEWEST_BLOCKS = 6
BLOCK = 20.0
"""Draws of a resampled interval, blocks from which on there is one, and degrees of a
block of cameras.
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measure:
    """What is counted."""

    # what has to hold in a row; one where it cannot be said (null) does not hold
    holds: pl.Expr
    given: pl.Expr | None = None  # which rows count; None counts all


def count(
    rows: pl.DataFrame,
    measures: Mapping[str, Measure],
    by: Sequence[str] = (),
    *,
    clusters: Sequence[str] | None = None,
) -> Figures:
    """Count measures over groups of rows; the columns of a group become labels."""
    if not measures:
        return Figures({})
    sums = []
    for name, measure in measures.items():
        holds = measure.holds
        total = pl.len()
        if measure.given is not None:
            holds = holds & measure.given
            total = measure.given.sum()
        sums += [holds.sum().alias(f"{name}/successes"), total.alias(f"{name}/total")]
    columns = list(dict.fromkeys((*by, *(clusters or ()))))
    if columns:
        table = rows.group_by(columns, maintain_order=True).agg(sums)
    else:
        table = rows.select(sums)
    groups = table.partition_by(by, maintain_order=True) if by else [table]
    entries = []
    for group in groups:
        labels = {column: group[column][0] for column in by}
        for name in measures:
            rate = _rate(group, name, clusters)
            entries.append(({**labels, MEASURE: name}, rate))
    return Figures.of(entries)


def _rate(group: pl.DataFrame, name: str, clusters: Sequence[str] | None) -> Rate:
    """The rate of a measure over a group, of which each line has the sums of a part."""
    successes, total = (
        int(group[f"{name}/{what}"].sum()) for what in ("successes", "total")
    )
    if clusters is None or not total:
        return Rate(successes=successes, total=total)
    numbers = [
        np.unique(group[column].to_numpy(), return_inverse=True)[1]
        for column in clusters
    ]
    shape = tuple(int(column.max()) + 1 for column in numbers)
    sums = np.zeros((2, *shape))
    for number, what in enumerate(("successes", "total")):
        np.add.at(sums[number], tuple(numbers), group[f"{name}/{what}"].to_numpy())
    return Rate.with_interval(successes, total, _resampled(sums))


def _resampled(sums: NDArray[np.float64]) -> tuple[float, float]:
    """95 % interval of a rate whose blocks and seeds, and objects if there are several,
    are drawn anew.

    Where few blocks were counted, or all are of one kind, drawing them anew says
    nothing; Wilson's interval with each block for one draw stands in. The same of
    objects that are all of one kind; of few that are not, it is that of as many draws
    as their spread is worth (Korn and Graubard 1998, "Confidence intervals for
    proportions"). `sums` are (2, blocks, seeds) or (2, objects, blocks, seeds)
    successes and totals.
    """
    axes = range(1, sums.ndim)
    sums = sums[:, sums[1].sum(tuple(axis - 1 for axis in axes if axis > 1)) > 0]
    first = sums.shape[1]
    total = float(sums[1].sum())
    fraction = float(sums[0].sum()) / total
    few = first < FEWEST_BLOCKS
    if fraction in (0.0, 1.0) or (few and (sums.ndim == 3 or first == 1)):
        return wilson(fraction, first)
    drawn = sums[:, None]
    for weights in _draws(sums.shape[1:]):
        drawn = np.einsum(
            "kdn...,dn->kd...",
            np.broadcast_to(drawn, (2, DRAWS, *drawn.shape[2:])),
            weights,
        )
    fractions = (drawn[0] / np.maximum(drawn[1], 1.0))[drawn[1] > 0]
    if few:
        from scipy.special import ndtri, stdtrit  # a fifth of a second

        quantiles = float(ndtri(0.975)) / float(stdtrit(first - 1, 0.975))
        worth = (
            fraction
            * (1 - fraction)
            / max(float(fractions.var()), 1e-12)
            * quantiles**2
        )
        return wilson(fraction, min(max(worth, first), total))
    low, high = np.quantile(fractions, (0.025, 0.975))
    return float(low), float(high)


@lru_cache(maxsize=64)
def _draws(shape: tuple[int, ...]) -> list[NDArray[np.float64]]:
    """For each axis, (draws, length) how often each of its parts is drawn: the same
    whenever the shape is.
    """
    generator = np.random.default_rng(0)
    return [
        generator.multinomial(n, np.full(n, 1 / n), size=DRAWS).astype(np.float64)
        for n in shape
    ]


def blocks_of(azimuth: str, elevation: str) -> pl.Expr:
    """The block of directions that a camera stands in, as a number: about `BLOCK`
    degrees wide and high.
    """
    band = ((pl.col(elevation) + 90) / BLOCK).floor()
    middle = ((band + 0.5) * BLOCK - 90).clip(-89, 89)
    around = (360 * middle.radians().cos() / BLOCK).round().clip(1)
    return (band * 1000 + (pl.col(azimuth) / 360 * around).floor()).cast(pl.Int64)


def banded(
    rows: pl.DataFrame,
    angle: str,
    interval: tuple[float, float],
    parts: int,
    measures: Mapping[str, Measure],
) -> Figures:
    """Rates over an angle, in equal parts of an interval; of an empty one nothing."""
    low = interval[0]
    width = (interval[1] - low) / parts
    if not width:
        return Figures({})
    part = ((pl.col(angle) - low) / width).cast(pl.Int64).clip(0, parts - 1)
    within = {LOW: low + part * width, HIGH: low + (part + 1) * width}
    counted = count(rows.with_columns(**within), measures, (LOW, HIGH))
    return counted.labelled(scope=angle)


# What figures count. Measures that need the clean splat's view of the same thing count
# rows of `with_control`, where its columns stand beside each row with `CONTROL` before
# their names.

Measures = Mapping[str, Measure]
Key = TypeVar("Key")
Confidence = float | Mapping[str, float] | pl.Expr
"""From which a detection counts: of all detectors, by the name of each, or by row."""

REPORTED = 0.5
DEFAULT_OF_YOLO = 0.25
"""Confidences from which the object's class counts as reported; the second is what
YOLO's own programs take.
"""
CONTROL = "clean."
"""What stands before the columns of the control."""
CLUSTERS = ("block", "seed")
"""Columns of `with_control`: rows of one block of cameras, or of one seed, are not
independent.
"""

_SAME = ("attack", "sources", "seed", "condition", "detector", "view")
"""Columns that say which control a row has."""
_CAMERA_COLUMNS = ("azimuth", "elevation", "distance", "x", "y", "z", "camera", "split")


def with_control(rows: pl.DataFrame) -> pl.DataFrame:
    """Each row beside that of the clean splat in the same view, and, where directions
    are known, the `block` it is in.

    Rows without a control are left out; of where the camera is, one copy stays.
    """
    on = [name for name in _SAME if name in rows.columns]
    once = [
        name
        for name in rows.columns
        if name in (*on, "splat", "draw", *_CAMERA_COLUMNS) or name.startswith(DEPTH)
    ]
    control = rows.filter(splat=CLEAN).select(
        *on,
        *(
            pl.col(name).alias(f"{CONTROL}{name}")
            for name in rows.columns
            if name not in once
        ),
    )
    table = rows.join(
        control, on=on, how="inner", nulls_equal=True, maintain_order="left"
    )
    if not {"azimuth", "elevation"} <= set(table.columns):
        return table
    return table.with_columns(blocks_of("azimuth", "elevation").alias(CLUSTERS[0]))


def of(splat: str) -> pl.Expr:
    """Rows of a splat."""
    return pl.col("splat") == splat


def reported(column: str, confidence: Confidence = REPORTED) -> pl.Expr:
    """Whether the score in a column counts."""
    if isinstance(confidence, Mapping):
        return pl.col(column) >= pl.col("detector").replace_strict(
            confidence, return_dtype=pl.Float64
        )
    return pl.col(column) >= confidence


def confidence_for(detector: str, confidence: float | Mapping[str, float]) -> float:
    """Confidence from which the detections of one detector count."""
    if isinstance(confidence, Mapping):
        return confidence[detector]
    return confidence


def confidence_words(confidence: float | Mapping[str, float]) -> str:
    """Confidences that count, for a sentence."""
    if not isinstance(confidence, Mapping):
        return f"{confidence:g}"
    if len({*confidence.values()}) == 1:
        return f"{next(iter(confidence.values())):g}"
    return listed([f"{least:g} ({name})" for name, least in confidence.items()])


# DAGGER

_OWN = pl.col(OPERATING)
"""The detector's own threshold, of rows of `with_thresholds`."""


def with_thresholds(rows: pl.DataFrame) -> pl.DataFrame:
    """Rows in which each says from which confidence its detector's detections count;
    those that do not say it count from `REPORTED`.
    """
    if OPERATING not in rows.columns:
        return rows.with_columns(pl.lit(REPORTED).alias(OPERATING))
    return rows.with_columns(_OWN.fill_null(REPORTED))


STRICT = pl.col("success") & ~(
    reported("original_score", _OWN) & pl.col("original").is_not_null()
).fill_null(value=False)
"""Whether the aim is reached in a row, and the object's own class is gone."""

AIMS: Measures = {
    name: Measure(holds=pl.col(name)) for name in ("success", "strict", "unambiguous")
}
"""How often the aim is reached in views (`joint_views`): in any way, with the object's
own class gone, and with no other class of more confidence.
"""

_WANTED = (pl.col("target_score") >= pl.col("threshold")).fill_null(pl.col("success"))
_GONE = ~reported("original_score", _OWN)
_FOUND = reported("clean.original_score", _OWN) & (
    pl.col("clean.original") == pl.col("own")
)
IF_DETECTED: Measures = {
    "detected": Measure(holds=_FOUND),
    "strict_if_detected": Measure(holds=_WANTED & _GONE, given=_FOUND),
    "success_if_detected": Measure(holds=_WANTED, given=_FOUND),
    "lost_if_detected": Measure(holds=_GONE, given=_FOUND),
}
"""What attacks, and their controls, have reached where the clean object is detected as
its `own` class: the wanted class is reported (success), the own class is not (lost),
and both (strict); of `with_control`.
"""

REPORTED_AS_ORIGINAL: Measures = {
    f"found_{splat}": Measure(
        holds=pl.col("original").is_not_null() & reported("original_score", _OWN),
        given=of(splat),
    )
    for splat in (CLEAN, ATTACKED)
}
"""In how many rows the object is reported as what it is, clean and attacked."""


def detected_views(rows: pl.DataFrame) -> pl.DataFrame:
    """Those rows in whose view every detector reports the clean object, as a class that
    it knows.
    """
    clean = with_thresholds(rows.filter(splat=CLEAN)).select(
        "view",
        detected=pl.col("original").is_not_null()
        & reported("original_score", _OWN).fill_null(value=False),
    )
    every = clean.group_by("view").agg(pl.col("detected").all()).filter("detected")
    return rows.join(every.select("view"), on="view", how="semi", maintain_order="left")


def joint_views(rows: pl.DataFrame) -> pl.DataFrame:
    """A row for each view of each splat, in which the aim is reached if it is with
    every detector of the rows.
    """
    if "original_score" in rows.columns:
        rows = with_thresholds(rows).with_columns(strict=STRICT)
    over = [
        name
        for name in ("attack", "seed", "condition", "splat", "draw", "view")
        if name in rows.columns
    ]
    truths = [
        name for name in ("success", "strict", "unambiguous") if name in rows.columns
    ]
    return rows.group_by(over, maintain_order=True).agg(pl.col(truths).all())


# Transfer, and an attacked splat under other conditions


def transfer_measures(
    confidence: Confidence = REPORTED, kinds: Sequence[str] = ("targeted", "untargeted")
) -> Measures:
    """How often attacks, and noise of their sizes, deceive a detector, of the rows
    whose clean object it finds.

    `found`: the clean object is reported, and not taken for the target. `targeted`: the
    wanted class is reported on the attacked object; `untargeted`: the object's own
    class no longer is; `reached`: the attack's own objective is; `noise_...`: the same
    of random noise. All but `found` need rows of `with_control`.
    """
    clean = reported(f"{CONTROL}original_score", confidence) & ~reported(
        f"{CONTROL}target_score", confidence
    )
    holds = {
        "targeted": reported("target_score", confidence),
        "untargeted": ~reported("original_score", confidence),
        "reached": pl.col("success"),
    }
    return {
        "found": Measure(holds=clean, given=of(CLEAN)),
        **{
            f"{before}{kind}": Measure(holds=holds[kind], given=of(splat) & clean)
            for before, splat in (("", ATTACKED), ("noise_", NOISE))
            for kind in kinds
        },
    }


# A clean and an attacked splat


def comparison_measures(
    confidence: Confidence = REPORTED, *, targeted: bool
) -> Measures:
    """How often an object is found, missed or taken for the target, of views in which
    it shows; of `with_control`.

    `found_clean`, `found_attacked`: it is reported; `missed`: it is not any more, of
    views where the clean one is; `target_clean`, `target_attacked`: the wanted class is
    reported.
    """
    shown = pl.col("x0").is_not_null()
    seen = reported("original_score", confidence)
    wanted = reported("target_score", confidence)
    both = ((CLEAN, of(CLEAN) & shown), (ATTACKED, of(ATTACKED) & shown))
    control = reported(f"{CONTROL}original_score", confidence)
    return {
        **{f"found_{splat}": Measure(holds=seen, given=given) for splat, given in both},
        "missed": Measure(holds=~seen, given=of(ATTACKED) & shown & control),
        **{
            f"target_{splat}": Measure(holds=wanted, given=given)
            for splat, given in both
            if targeted
        },
    }


# CLOAK


def cloak_measures(
    attacks: Sequence[str],
    *,
    hiding: str | None,
    showing: str | None,
    well_inside: float,
    confidence: Confidence = REPORTED,
) -> Measures:
    """What the rates of a study of CLOAK count, of `with_control`; without those of
    which it has no attack.

    `control_recall`: the control is found inside the hiding trigger.
    `trigger_miss_rate`: the cloaked splat is not, of cameras well inside it where the
    control is. `..._all`: the same, of all inside it. `..._unconditional`: as the
    first, whether the control is found or not. `..._any_overlap`: as the first, but
    missed only if nothing of the object's class is reported that overlaps its box by a
    tenth. `nothing_reported`: as the first, but missed only if nothing of any class is
    reported on the object. `benign_recall`: the cloaked splat is found outside of all
    triggers, where the control is; `control_benign_recall`: the control is found there.
    `target_rate`: the target class is reported on the cloaked splat, by detectors that
    have such a class; `control_target_rate`: on the control.
    """

    def inside(name: str, degrees: float = 0.0) -> pl.Expr:
        return pl.col(f"{DEPTH}{name}") >= degrees

    cloaked = of(ATTACKED)
    clean = of(ATTACKED) & reported(f"{CONTROL}original_score", confidence)
    control, seen = (
        reported(f"{before}original_score", confidence) for before in (CONTROL, "")
    )
    benign = pl.all_horizontal(~inside(name) for name in attacks)
    measures = {
        "benign_recall": Measure(holds=seen, given=benign & clean),
        "control_benign_recall": Measure(holds=control, given=benign & cloaked),
    }
    if hiding is not None:
        every = inside(hiding)
        well = inside(hiding, well_inside)
        measures |= {
            "control_recall": Measure(holds=control, given=every & cloaked),
            "trigger_miss_rate": Measure(holds=~seen, given=well & clean),
            "trigger_miss_rate_all": Measure(holds=~seen, given=every & clean),
            "trigger_miss_rate_unconditional": Measure(
                holds=~seen, given=well & cloaked
            ),
            "trigger_miss_rate_any_overlap": Measure(
                holds=~reported("any_overlap", confidence), given=well & clean
            ),
            "nothing_reported": Measure(
                holds=~reported("score", confidence), given=well & clean
            ),
        }
    if showing is not None:
        wanted = f"{TARGET_SCORE}{showing}"
        known = inside(showing) & cloaked & pl.col(wanted).is_not_null()
        measures |= {
            "target_rate": Measure(holds=reported(wanted, confidence), given=known),
            "control_target_rate": Measure(
                holds=reported(f"{CONTROL}{wanted}", confidence), given=known
            ),
        }
    return measures


# More than one threshold


def rates_at(
    rows: pl.DataFrame,
    measures: Callable[[Confidence], Measures],
    confidences: Mapping[Key, Confidence],
    by: Sequence[str] = (),
    *,
    clusters: Sequence[str] | None = None,
) -> dict[Key, Figures]:
    """The same rates at several confidences, by their names."""
    return {
        name: count(rows, measures(least), by, clusters=clusters)
        for name, least in confidences.items()
    }
