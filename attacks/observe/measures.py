"""What figures count, as tables of measures: one for each question that rows answer.

A measure names columns of the schema (`attacks.observe.rows`). Those that need the clean splat's view of the same thing
count rows of `with_control`, where its columns stand beside each row with `CONTROL` before their names.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import polars as pl

from attacks.observe.rates import Group, Measure, banded, blocks_of, count
from attacks.observe.rows import ATTACKED, CLEAN, DEPTH, NOISE, TARGET_SCORE
from attacks.rate import Rate

Measures = Mapping[str, Measure]
Confidence = float | Mapping[str, float]
"""From which a detection counts: of all detectors, or by the name of each."""

REPORTED, DEFAULT_OF_YOLO = 0.5, 0.25
"""Confidences from which the object's class counts as reported; the second is what YOLO's own programs take."""
CURVE = tuple(round(0.05 * step, 2) for step in range(1, 20))
"""Confidences of `threshold_curve`."""
CONTROL = "clean."
"""What stands before the columns of the control."""
CLUSTERS = ("block", "seed")
"""Columns of `with_control`: rows of one block of cameras, or of one seed, are not independent."""

_SAME = ("attack", "sources", "seed", "condition", "detector", "view")
"""Columns that say which control a row has."""
_CAMERA_COLUMNS = ("azimuth", "elevation", "distance", "x", "y", "z", "camera")


def with_control(rows: pl.DataFrame) -> pl.DataFrame:
    """Each row beside that of the clean splat in the same view, and, where directions are known, the `block` it is in.

    Rows without a control are left out; of where the camera is, one copy stays.
    """
    on = [name for name in _SAME if name in rows.columns]
    once = [name for name in rows.columns if name in (*on, "splat", "draw", *_CAMERA_COLUMNS) or name.startswith(DEPTH)]
    control = rows.filter(splat=CLEAN).select(
        *on, *(pl.col(name).alias(f"{CONTROL}{name}") for name in rows.columns if name not in once)
    )
    table = rows.join(control, on=on, how="inner", nulls_equal=True, maintain_order="left")
    if not {"azimuth", "elevation"} <= set(table.columns):
        return table
    return table.with_columns(blocks_of("azimuth", "elevation").alias(CLUSTERS[0]))


def of(splat: str) -> pl.Expr:
    """Rows of a splat."""
    return pl.col("splat") == splat


def reported(column: str, confidence: Confidence = REPORTED) -> pl.Expr:
    """Whether the score in a column counts."""
    if isinstance(confidence, Mapping):
        return pl.col(column) >= pl.col("detector").replace_strict(confidence, return_dtype=pl.Float64)
    return pl.col(column) >= confidence


# DAGGER

STRICT = pl.col("success") & ~(reported("original_score") & pl.col("original").is_not_null()).fill_null(value=False)
"""Whether the aim is reached in a row, and the object's own class is gone."""

AIMS: Measures = {
    "success": Measure(holds=pl.col("success"), given=of(ATTACKED)),
    "strict": Measure(holds=pl.col("strict"), given=of(ATTACKED)),
    "unambiguous": Measure(holds=pl.col("unambiguous"), given=of(ATTACKED)),
    "clean_success": Measure(holds=pl.col("success"), given=of(CLEAN)),
    "noise_success": Measure(holds=pl.col("success"), given=of(NOISE)),
}
"""How often the aim is reached in views (`joint_views`): attacked, with the object's own class gone, with no other
class of more confidence, without an attack, and with each draw of random noise."""

REPORTED_AS_ORIGINAL: Measures = {
    f"found_{splat}": Measure(holds=pl.col("original").is_not_null() & reported("original_score"), given=of(splat))
    for splat in (CLEAN, ATTACKED)
}
"""In how many rows the object is reported as what it is, clean and attacked."""


def joint_views(rows: pl.DataFrame) -> pl.DataFrame:
    """A row for each view of each splat, in which the aim is reached if it is with every detector of the rows."""
    rows = rows.with_columns(strict=STRICT) if "original_score" in rows.columns else rows
    over = [name for name in ("attack", "seed", "condition", "splat", "draw", "view") if name in rows.columns]
    truths = [name for name in ("success", "strict", "unambiguous") if name in rows.columns]
    return rows.group_by(over, maintain_order=True).agg(pl.col(truths).all())


AZIMUTHS, ELEVATIONS = 8, 4
"""Parts of the angles that success is told by."""


def aim_figures(
    rows: pl.DataFrame, detectors: Sequence[str], elevations: tuple[float, float] | None = None
) -> dict[str, Any]:
    """Every rate of an attack, as JSON can hold it."""
    together, success = count(joint_views(rows), AIMS)[()], AIMS["success"]
    figures = {
        "rate": together["success"].as_dict(),
        "rates": {name: _of_detector(rows.filter(detector=name)) for name in detectors},
        "clean_rate": together["clean_success"].as_dict(),
        "noise_rate": together["noise_success"].as_dict(),
        "unambiguous_rate": together["unambiguous"].as_dict(),
    }
    if elevations is None:
        return figures
    return {
        **figures,
        "by_azimuth": banded(rows, "azimuth", (0.0, 360.0), AZIMUTHS, success),
        "by_elevation": banded(rows, "elevation", elevations, ELEVATIONS, success),
    }


def _of_detector(rows: pl.DataFrame) -> dict[str, Any]:
    """What one detector reports."""
    aims = count(joint_views(rows), AIMS)[()]
    return {
        "original": None if rows.is_empty() else rows["original"][0],
        "success": aims["success"].as_dict(),
        "noise": aims["noise_success"].as_dict(),
        "clean": aims["clean_success"].as_dict(),
        **{name: rate.as_dict() for name, rate in count(rows, REPORTED_AS_ORIGINAL)[()].items()},
    }


# Transfer, and an attacked splat under other conditions


def transfer_measures(confidence: Confidence = REPORTED, kinds: Sequence[str] = ("targeted", "untargeted")) -> Measures:
    """How often attacks, and noise of their sizes, deceive a detector, of the rows whose clean object it finds.

    `found`: the clean object is reported, and not taken for the target. `targeted`: the wanted class is reported on the
    attacked object; `untargeted`: the object's own class no longer is; `reached`: the attack's own objective is;
    `noise_...`: the same of random noise. All but `found` need rows of `with_control`.
    """
    clean = reported(f"{CONTROL}original_score", confidence) & ~reported(f"{CONTROL}target_score", confidence)
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


def comparison_measures(confidence: Confidence = REPORTED, *, targeted: bool) -> Measures:
    """How often an object is found, missed or taken for the target, of views in which it shows; of `with_control`.

    `found_clean`, `found_attacked`: it is reported; `missed`: it is not any more, of views where the clean one is;
    `target_clean`, `target_attacked`: the wanted class is reported.
    """
    shown, seen = pl.col("x0").is_not_null(), reported("original_score", confidence)
    wanted = reported("target_score", confidence)
    both = ((CLEAN, of(CLEAN) & shown), (ATTACKED, of(ATTACKED) & shown))
    control = reported(f"{CONTROL}original_score", confidence)
    return {
        **{f"found_{splat}": Measure(holds=seen, given=given) for splat, given in both},
        "missed": Measure(holds=~seen, given=of(ATTACKED) & shown & control),
        **{f"target_{splat}": Measure(holds=wanted, given=given) for splat, given in both if targeted},
    }


# CLOAK


def cloak_measures(
    attacks: Sequence[str],
    *,
    hiding: str | None,
    showing: str | None,
    well_inside: float,
    confidence: Confidence = REPORTED,
    depth: str = DEPTH,
) -> Measures:
    """What the rates of a study of CLOAK count, of `with_control`; without those of which it has no attack.

    `control_recall`: the control is found inside the hiding trigger. `trigger_miss_rate`: the cloaked splat is not, of
    cameras well inside it where the control is. `..._all`: the same, of all inside it. `..._unconditional`: as the
    first, whether the control is found or not. `..._any_overlap`: as the first, but missed only if nothing of the
    object's class is reported that overlaps its box by a tenth. `nothing_reported`: as the first, but missed only if
    nothing of any class is reported on the object. `benign_recall`: the cloaked splat is found outside of all triggers,
    where the control is; `control_benign_recall`: the control is found there. `target_rate`: the target class is
    reported on the cloaked splat, by detectors that have such a class; `control_target_rate`: on the control.
    """

    def inside(name: str, degrees: float = 0.0) -> pl.Expr:
        return pl.col(f"{depth}{name}") >= degrees

    cloaked, clean = of(ATTACKED), of(ATTACKED) & reported(f"{CONTROL}original_score", confidence)
    control, seen = (reported(f"{before}original_score", confidence) for before in (CONTROL, ""))
    benign = pl.all_horizontal(~inside(name) for name in attacks)
    measures = {
        "benign_recall": Measure(holds=seen, given=benign & clean),
        "control_benign_recall": Measure(holds=control, given=benign & cloaked),
    }
    if hiding is not None:
        every, well = inside(hiding), inside(hiding, well_inside)
        measures |= {
            "control_recall": Measure(holds=control, given=every & cloaked),
            "trigger_miss_rate": Measure(holds=~seen, given=well & clean),
            "trigger_miss_rate_all": Measure(holds=~seen, given=every & clean),
            "trigger_miss_rate_unconditional": Measure(holds=~seen, given=well & cloaked),
            "trigger_miss_rate_any_overlap": Measure(holds=~reported("any_overlap", confidence), given=well & clean),
            "nothing_reported": Measure(holds=~reported("score", confidence), given=well & clean),
        }
    if showing is not None:
        wanted = f"{TARGET_SCORE}{showing}"
        known = inside(showing) & cloaked & pl.col(wanted).is_not_null()
        measures |= {
            "target_rate": Measure(holds=reported(wanted, confidence), given=known),
            "control_target_rate": Measure(holds=reported(f"{CONTROL}{wanted}", confidence), given=known),
        }
    return measures


# More than one threshold


def rates_at(
    rows: pl.DataFrame,
    measures: Callable[[Confidence], Measures],
    confidences: Mapping[str, Confidence],
    by: Sequence[str] = (),
    *,
    clusters: Sequence[str] | None = None,
) -> dict[str, dict[Group, dict[str, Rate]]]:
    """The same rates at several confidences."""
    return {name: count(rows, measures(least), by, clusters=clusters) for name, least in confidences.items()}


def threshold_curve(
    rows: pl.DataFrame,
    measures: Callable[[Confidence], Measures],
    name: str,
    confidences: Iterable[float] = CURVE,
    by: Sequence[str] = (),
    *,
    clusters: Sequence[str] | None = None,
) -> dict[Group, list[tuple[float, Rate]]]:
    """A rate over the confidence from which a detection counts, for each group: what a report draws."""
    lines: dict[Group, list[tuple[float, Rate]]] = {}
    for confidence in confidences:
        counted = count(rows, {name: measures(confidence)[name]}, by, clusters=clusters)
        for group, rates in counted.items():
            lines.setdefault(group, []).append((confidence, rates[name]))
    return lines
