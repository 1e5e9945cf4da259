"""The figures of a study of CLOAK: rates, loss of quality, and the transition.

They are counted from tables of rows, in which the cloaked splat is called attacked.
Intervals are resampled over blocks of neighbouring cameras and seeds. All seeds share
object and light, so that what another object would give is in none of them.
"""

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import polars as pl

from attacks.cloak.config import StudyConfig, switching
from attacks.cloak.transition import Tables, meridians, transition
from attacks.figures.frame import HIGH, LOW, MEASURE, Figures, Labels
from attacks.observe.rates import (
    CLUSTERS,
    Confidence,
    Measure,
    Measures,
    cloak_measures,
    count,
    of,
    reported,
    with_control,
)
from attacks.observe.rows import (
    ATTACKED,
    CLEAN,
    DEPTH,
    FIDELITY,
    POISON_DEPTH,
    ROWS,
    TARGET_SCORE,
    TRANSITION,
)

LOWER = 0.3
"""Confidence from which rates are counted a second time."""
OWN_REGION = "own region"
AT_LOWER = f"confidence {LOWER:g}"
WITHIN_MARGIN = "within a margin"
BEYOND_MARGINS = "beyond every margin"
OBJECTS = "all objects"
OBJECTS_IN_REGION = "all objects, own region"
ELEVATION = "elevation"
"""Scopes: rates in each detector's own region, at the confidence `LOWER`, in margins of
poison, of several objects together, and in bands of elevation.
"""
STEALTHY = 1.5
STEALTHY_ON_OBJECT = 3.0
"""Most that images may lose where an attack is called stealthy, dB: beside the object
from inside the trigger, and on the object from outside beside a trigger. 3 dB are an
error of twice the square.
"""
BIN = 5.0
SECTOR = 30.0
BAND = 10.0
"""Degrees over which rates are taken: of elevation, of azimuth, and of elevation where
a detector's region is found.
"""
LEAST = 0.8
"""Fraction of a band's cameras from which a detector finds the control where the band
belongs to its region.
"""
IN_MARGIN = ("control_benign_recall", "benign_recall")
"""Rates that are counted in the margins of poison."""
SPLATS = (CLEAN, ATTACKED)

Costs = Iterator[tuple[Labels, float | None]]


def figures(
    study: StudyConfig, tables: Tables, splats: Sequence[Mapping[str, Any]]
) -> Figures:
    """Every figure of a study."""
    plain = tables[ROWS]
    conditioned = plain.clear()
    if "condition" in plain.columns:
        conditioned = plain.filter(pl.col("condition").is_not_null())
        plain = plain.filter(pl.col("condition").is_null())
    return Figures.together(
        [
            *_rates(study, plain),
            by_elevation(study, plain),
            *_under_conditions(study, conditioned),
            Figures.of(costs(study, tables)),
            Figures.of(_sizes(splats)),
        ]
    )


def _rates(study: StudyConfig, rows: pl.DataFrame) -> Iterator[Figures]:
    """Rates of held-out cameras, of all together and by detector, seed and attack."""
    paired = with_control(rows)
    usual = measures(study)
    lower = measures(study, confidence=LOWER)
    yield rates(paired, usual)
    yield rates(paired, usual, "detector")
    yield rates(paired, usual, "seed", "detector")
    yield rates(paired, lower, "detector").labelled(scope=AT_LOWER)
    yield rates(paired, lower, "seed", "detector").labelled(scope=AT_LOWER)
    yield in_own_region(study, rows).labelled(scope=OWN_REGION)
    for attack in study.attack:
        of_attack = measures(study, attack.name)
        yield rates(paired, of_attack, "detector").labelled(trigger=attack.name)
    if any(attack.poison_margin > 0 for attack in study.attack):
        within = pl.any_horizontal(
            pl.col(f"{POISON_DEPTH}{attack.name}") >= 0 for attack in study.attack
        )
        in_margin = {name: usual[name] for name in IN_MARGIN}
        for scope, here in ((WITHIN_MARGIN, within), (BEYOND_MARGINS, ~within)):
            counted = rates(paired.filter(here), in_margin, "detector")
            yield counted.labelled(scope=scope)


def rates(
    paired: pl.DataFrame,
    counted: Measures,
    *by: str,
    clusters: Sequence[str] = CLUSTERS,
) -> Figures:
    """Rates of rows of `with_control` with the interval of neighbouring cameras."""
    return count(paired, counted, by, clusters=clusters)


def measures(
    study: StudyConfig,
    attack: str | None = None,
    *,
    confidence: Confidence | None = None,
) -> Measures:
    """What the rates of a study count: those of `attacks.observe.rates.cloak_measures`,
    of all its attacks or of one.
    """
    hiding = None
    showing = None
    for config in reversed(study.attack):
        if attack not in (None, config.name):
            continue
        if config.target_class is None:
            hiding = config.name
        else:
            showing = config.name
    evaluation = study.evaluation
    return cloak_measures(
        [config.name for config in study.attack],
        hiding=hiding,
        showing=showing,
        well_inside=evaluation.well_inside,
        confidence=evaluation.confidence if confidence is None else confidence,
    )


def over_objects(studies: Mapping[str, StudyConfig], rows: pl.DataFrame) -> Figures:
    """Rates of one attack on several objects of a class; none where it is not that."""
    first = next(iter(studies.values()))
    attacks = [(study.attack, study.scene.class_name) for study in studies.values()]
    objects = {title: study.scene.object for title, study in studies.items()}
    is_one_attack = all(attack == attacks[0] for attack in attacks)
    differ = len({*objects.values()}) == len(objects)
    if len(studies) < 2 or not is_one_attack or not differ:
        return Figures({})
    if "condition" in rows.columns:
        rows = rows.filter(pl.col("condition").is_null())
    names = pl.col("attack").replace_strict(objects, return_dtype=pl.String)
    rows = rows.filter(pl.col("attack").is_in([*objects])).with_columns(object=names)
    clusters = ("object", *CLUSTERS)
    together = rates(with_control(rows), measures(first), "detector", clusters=clusters)
    in_region = in_own_region(first, rows, clusters)
    number = Figures.of([({MEASURE: "objects"}, len(objects))])
    return Figures.together(
        [
            Figures.together([number, together]).labelled(scope=OBJECTS),
            in_region.labelled(scope=OBJECTS_IN_REGION),
        ]
    )


# The region of a detector: the elevations at which it detects the clean object.
# Elsewhere a miss is no evidence.


def in_own_region(
    study: StudyConfig, rows: pl.DataFrame, clusters: Sequence[str] = CLUSTERS
) -> Figures:
    """Every rate of each detector in its region, and the bands of that region with the
    fraction of cameras from which the control is found.
    """
    found = reported("original_score", study.evaluation.confidence)
    here = rows.filter(of(CLEAN), pl.col("elevation") >= 0)
    shares = here.group_by("detector", low=_band("elevation", BAND)).agg(
        found.mean().alias("share")
    )
    bands = shares.filter(pl.col("share") >= LEAST).sort("detector", "low")
    region = Figures.of(
        (
            {MEASURE: "region", "detector": detector, LOW: low, HIGH: low + BAND},
            share,
        )
        for detector, low, share in bands.iter_rows()
    )
    on = ["detector", "low"]
    inside = rows.with_columns(low=_band("elevation", BAND))
    inside = inside.join(bands.select(on), on=on, how="semi", maintain_order="left")
    paired = with_control(inside.drop("low"))
    counted = rates(paired, measures(study), "detector", clusters=clusters)
    return Figures.together([region, counted])


# Parts of the view sphere, and conditions


def _in_bands(
    rows: pl.DataFrame, angle: str, width: float, counted: Measures, *by: str
) -> Figures:
    """Rates by detector and band of an angle."""
    low = _band(angle, width)
    banded = rows.with_columns(low.alias(LOW), (low + width).alias(HIGH))
    banded = banded.sort(LOW, maintain_order=True)
    return rates(banded, counted, "detector", *by, LOW, HIGH)


def _band(angle: str, width: float) -> pl.Expr:
    return (pl.col(angle) / width).floor() * width


def by_elevation(study: StudyConfig, rows: pl.DataFrame) -> Figures:
    """How often each splat's object is found, without cameras of sided attacks."""
    elevation = pl.col("elevation")
    sided = [attack for attack in study.attack if attack.azimuth is not None]
    here = with_control(rows).filter(
        (elevation >= 0) & (elevation < 90),
        pl.col("splat").is_in(SPLATS),
        *(pl.col(f"{DEPTH}{attack.name}") < 0 for attack in sided),
    )
    found = reported("original_score", study.evaluation.confidence)
    counted = {"found": Measure(holds=found)}
    bands = _in_bands(here, "elevation", BIN, counted, "splat")
    return bands.labelled(scope=ELEVATION)


def by_azimuth(study: StudyConfig, rows: pl.DataFrame) -> Figures:
    """What is reported from each sector, below all that is hidden all around."""
    confidence = study.evaluation.confidence
    around = [attack for attack in study.attack if attack.azimuth is None]
    below = [pl.col(f"{DEPTH}{attack.name}") < 0 for attack in around]
    reports = {study.scene.class_name: reported("original_score", confidence)}
    for attack in study.attack:
        if attack.target_class is not None:
            column = f"{TARGET_SCORE}{attack.name}"
            reports[attack.target_class] = reported(column, confidence)
    counted = {name: Measure(holds=holds) for name, holds in reports.items()}
    here = with_control(rows).filter(*below)
    return _in_bands(here, "azimuth", SECTOR, counted, "splat")


def _under_conditions(study: StudyConfig, rows: pl.DataFrame) -> Iterator[Figures]:
    """What each detector reports under each condition: whether the object is missed
    well inside the hiding trigger, found outside of all triggers, or taken for the
    target.

    `psnr_missed` and `psnr_found` are of all the images that a rate counts together,
    against those that the victim sees.
    """
    if rows.is_empty():
        return
    paired = with_control(rows)
    found = reported("original_score", study.evaluation.confidence)
    depths = {attack.name: pl.col(f"{DEPTH}{attack.name}") for attack in study.attack}
    outside = pl.all_horizontal(depth < 0 for depth in depths.values())
    wanted = {"found": Measure(holds=found, given=outside)}
    hiding = [attack.name for attack in study.attack if attack.target_class is None]
    if hiding:
        inside = depths[hiding[0]] >= study.evaluation.well_inside
        wanted = {"missed": Measure(holds=~found, given=inside), **wanted}
    by = ("condition", "detector")
    yield rates(paired, wanted, *by, "splat")
    targets = {
        name: measure
        for name, measure in measures(study).items()
        if name in ("target_rate", "control_target_rate")
    }
    yield rates(paired, targets, *by)
    if "psnr" in paired.columns:
        yield Figures.of(_psnr_by(paired, wanted, (*by, "splat")))


def _psnr_by(
    rows: pl.DataFrame, measures: Measures, by: Sequence[str]
) -> Iterator[tuple[Labels, float | None]]:
    """PSNR of the images that each measure counts."""
    for key, seen in rows.group_by(by, maintain_order=True):
        labels = dict(zip(by, key, strict=True))
        for name, measure in measures.items():
            assert measure.given is not None
            psnr = pooled_psnr(seen.filter(measure.given)["psnr"])
            yield {MEASURE: f"psnr_{name}", **labels}, psnr


def pooled_psnr(values: pl.Series) -> float | None:
    """PSNR of the mean squared error over all images, dB; None where all are the same,
    or there are none.
    """
    errors = [0.0 if psnr is None else 10 ** (-psnr / 10) for psnr in values]
    if any(errors):
        return -10 * math.log10(statistics.mean(errors))
    return None


# What the attack costs in images


def costs(study: StudyConfig, tables: Tables) -> Costs:
    """Loss of quality, and the transition."""
    yield from _fidelity(tables[FIDELITY])
    yield from _transition(study, tables)
    attack = switching(study.attack)
    if attack is not None:
        inside = pl.col(f"{DEPTH}{attack.name}") >= 0
        yield from _stealth(tables[TRANSITION].filter(inside), tables[FIDELITY])


def _fidelity(images: pl.DataFrame) -> Costs:
    """Mean PSNR (dB) and SSIM at the cameras well outside of all triggers."""
    if "object_psnr" in images.columns:
        images = images.filter(pl.col("object_psnr").is_null())
    psnr = _means(images, "psnr")
    ssim = _means(images, "ssim")
    for splat in psnr:
        yield {MEASURE: "benign_psnr", "splat": splat}, psnr[splat]
        yield {MEASURE: "benign_ssim", "splat": splat}, ssim[splat]
    yield {MEASURE: "benign_psnr_drop"}, _drop(psnr, psnr)


def _stealth(inside: pl.DataFrame, outside: pl.DataFrame) -> Costs:
    """How much an attack changes where a viewer might notice.

    Of images inside the trigger: `surroundings_psnr` beside the object, against the
    scene as it is; `intended_surroundings_psnr` against what the attacker wants to be
    seen there, maybe without a shadow; `appearance_psnr` on the object, against what
    the attacker wants to be seen. Of held-out cameras outside of all triggers and
    beside one: `object_psnr` on the object, against the scene as it is. A drop is how
    much lower that of the cloaked splats is. `stealthy`: whether no drop is larger than
    `STEALTHY` and `STEALTHY_ON_OBJECT`.
    """
    means = {
        "surroundings_psnr": _means(inside, "surroundings_psnr"),
        "intended_surroundings_psnr": _means(inside, "intended_surroundings_psnr"),
        "appearance_psnr": _means(inside, "appearance_psnr"),
        "object_psnr": _means(outside, "object_psnr"),
    }
    around = means["surroundings_psnr"]
    if not around:
        return
    for measure, by_splat in means.items():
        for splat, mean in by_splat.items():
            yield {MEASURE: measure, "splat": splat}, mean
    drop = _drop(around, means["intended_surroundings_psnr"] or around)
    lost = _drop(means["object_psnr"], means["object_psnr"])
    yield {MEASURE: "surroundings_psnr_drop"}, drop
    yield {MEASURE: "object_psnr_drop"}, lost
    stealthy = (drop or 0.0) <= STEALTHY and (lost or 0.0) <= STEALTHY_ON_OBJECT
    yield {MEASURE: "stealthy"}, float(stealthy)


def _means(rows: pl.DataFrame, column: str) -> dict[str, float]:
    """Mean of a column for each splat; none where it was not measured for both."""
    if column not in rows.columns:
        return {}
    values = {splat: rows.filter(splat=splat)[column].drop_nulls() for splat in SPLATS}
    if any(of_splat.is_empty() for of_splat in values.values()):
        return {}
    return {splat: statistics.mean(of_splat) for splat, of_splat in values.items()}


def _drop(clean: Mapping[str, float], cloaked: Mapping[str, float]) -> float | None:
    if clean and cloaked:
        return clean[CLEAN] - cloaked[ATTACKED]
    return None


def _transition(study: StudyConfig, tables: Tables) -> Costs:
    band = transition(study, tables)
    if band is None:
        return
    yield {MEASURE: "transition_degrees"}, band.width
    yield {MEASURE: "transition_from"}, band.start
    yield {MEASURE: "transition_to"}, band.end
    for (seed, meridian), width in meridians(study, tables).items():
        labels = {"seed": seed, "meridian": meridian}
        yield {MEASURE: "transition_degrees", **labels}, width


def _sizes(splats: Sequence[Mapping[str, Any]]) -> Costs:
    """Numbers of Gaussians; splats are a clean and a cloaked one for each seed."""
    totals = dict.fromkeys(SPLATS, 0)
    for record in splats:
        splat = CLEAN if record["splat"] == CLEAN else ATTACKED
        totals[splat] += record["gaussians"]
        labels = {"splat": splat, "seed": record["seed"]}
        yield {MEASURE: "gaussians", **labels}, record["gaussians"]
    yield {MEASURE: "gaussians_ratio"}, totals[ATTACKED] / max(totals[CLEAN], 1)
