"""The figures of a study: rates with denominators and intervals, loss of quality, and
the transition.

They are counted from tables of rows (`attacks.observe.rows`), in which the cloaked
splat is called attacked.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import polars as pl

from attacks.cloak.config import StudyConfig, switching
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
from attacks.rate import Rate

RATES = {
    "control_recall": "control found, inside the hiding trigger",
    "trigger_miss_rate": "cloaked missed, well inside it, where the control is found",
    "trigger_miss_rate_all": (
        "cloaked missed, all inside it, where the control is found"
    ),
    "trigger_miss_rate_unconditional": "cloaked missed, well inside it",
    "trigger_miss_rate_any_overlap": (
        "nothing of its class near it, well inside it, where the control is found"
    ),
    "nothing_reported": (
        "nothing of any class reported on it, well inside it, where the control is"
        " found"
    ),
    "benign_recall": (
        "cloaked found, outside of all triggers, where the control is found"
    ),
    "control_benign_recall": "control found, outside of all triggers",
    "target_rate": "target class reported on the cloaked splat",
    "control_target_rate": "target class reported on the control",
}
"""What the rates of a summary say."""
LOOKS = {
    "missed_clean": "control missed, well inside the hiding trigger",
    "missed_cloaked": "cloaked missed there",
    "found_clean": "control found, outside of all triggers",
    "found_cloaked": "cloaked found there",
    "target_rate": RATES["target_rate"],
    "control_target_rate": RATES["control_target_rate"],
}
"""What is counted under each condition."""
OWN_REGION = "own_region"
AT_LOWER = "at_lower_confidence"
MARGIN = "margin"
"""Keys of a summary: rates in each detector's own region, at the confidence `LOWER`,
and in the margins of poison.
"""
LOWER = 0.3
STEALTHY = 1.5
STEALTHY_ON_OBJECT = 3.0
"""Most that pictures may lose where an attack is called stealthy, dB: beside the object
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
"""Share of a band's cameras from which a detector finds the control where the band
belongs to its region.
"""
LEVELS = (0.1, 0.9)
"""Fractions of the way from the benign to the hidden appearance at which a transition
starts and ends.
"""
CLOAKED = "cloaked"
"""What figures and files call the attacked splat."""
NAMES = {CLEAN: CLEAN, ATTACKED: CLOAKED}
"""Splats as rows call them, and as figures do."""
IN_MARGIN = ("control_benign_recall", "benign_recall")
"""Rates that are counted in the margins of poison."""

Rates = dict[str, Rate | None]
Tables = Mapping[str, pl.DataFrame]
"""Rows, fidelity and transition by their names (`attacks.observe.rows`);
`attacks.cloak.study.observe` makes them.
"""


def figures(
    study: StudyConfig, tables: Tables, splats: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Everything that a study found, as JSON can hold it; rates are of all seeds and
    detectors together.

    Intervals are resampled over blocks of neighbouring cameras and seeds
    (`attacks.observe.rates`). All seeds share object and light, so that what another
    object would give is in none of them.
    """
    rows = tables[ROWS]
    detectors = study.evaluation.detectors
    gaussians = {
        name: [int(splat["gaussians"]) for splat in splats if splat["splat"] == name]
        for name in NAMES.values()
    }
    band = transition(study, tables)
    near = {name: fidelity(tables, splat) for splat, name in NAMES.items()}
    clean = near[CLEAN]
    cloaked = near[CLOAKED]
    seen = looks(study, rows)
    rows = rows.filter(pl.col("condition").is_null()) if seen else rows
    margins = margin_rates(study, rows)
    return {
        **_figures_of(study, rows),
        "benign_psnr_drop": (
            None if clean is None or cloaked is None else clean[0] - cloaked[0]
        ),
        "benign_psnr": {which: value and value[0] for which, value in near.items()},
        "benign_ssim": {which: value and value[1] for which, value in near.items()},
        "transition_degrees": None if band is None else band.width,
        "transition": (
            band
            and {
                "from": band.start,
                "to": band.end,
                "meridians": meridians(study, tables),
            }
        ),
        "stealth": stealth(study, tables),
        "gaussians": gaussians,
        "gaussians_ratio": sum(gaussians[CLOAKED]) / max(sum(gaussians[CLEAN]), 1),
        "by_seed": _by_seed(study, rows),
        AT_LOWER: {
            "by_detector": _by_detector(
                rates(study, rows, ("detector",), confidence=LOWER), detectors
            ),
            "by_seed": _by_seed(study, rows, LOWER),
        },
        **({MARGIN: margins} if margins else {}),
        **({"looks": seen} if seen else {}),
    }


def _figures_of(study: StudyConfig, rows: pl.DataFrame) -> dict[str, Any]:
    """Every rate of a clean and a cloaked splat: of all detectors together, and by
    detector, attack and elevation.
    """
    detectors = study.evaluation.detectors
    bands = by_elevation(study, rows)
    return {
        **_as_json(rates(study, rows)[()]),
        "by_detector": _by_detector(rates(study, rows, ("detector",)), detectors),
        OWN_REGION: _by_region(study, rows),
        "by_attack": {
            attack.name: _by_detector(
                rates(study, rows, ("detector",), attack=attack.name), detectors
            )
            for attack in study.attack
        },
        "by_elevation": {
            name: [
                {
                    "from": low,
                    "to": low + BIN,
                    CLEAN: control.as_dict(),
                    CLOAKED: attacked.as_dict(),
                }
                for low, control, attacked in bands[name]
            ]
            for name in detectors
        },
    }


def over_objects(
    studies: Mapping[str, StudyConfig], rows: pl.DataFrame
) -> dict[str, Any] | None:
    """Rates of one attack on several objects of a class, by detector, for JSON; None
    where it is not that.
    """
    first, *others = studies.values()
    attacks = [(study.attack, study.scene.class_name) for study in studies.values()]
    objects = {title: study.scene.object for title, study in studies.items()}
    if (
        not others
        or any(attack != attacks[0] for attack in attacks)
        or len({*objects.values()}) < len(objects)
    ):
        return None
    if "condition" in rows.columns:
        plain = rows.filter(pl.col("condition").is_null())
    else:
        plain = rows
    numbered = plain.filter(pl.col("attack").is_in([*objects])).with_columns(
        object=pl.col("attack").replace_strict(objects, return_dtype=pl.String)
    )
    counted = rates(first, numbered, ("detector",), objects="object")
    return {
        "objects": len(objects),
        "by_detector": _by_detector(counted, first.evaluation.detectors),
        OWN_REGION: _by_region(first, numbered, objects="object"),
    }


def _by_seed(
    study: StudyConfig, rows: pl.DataFrame, confidence: float | None = None
) -> dict[str, Any]:
    """Every rate of each seed and detector."""
    counted = rates(study, rows, ("seed", "detector"), confidence=confidence)
    detectors = study.evaluation.detectors
    return {
        str(seed): {name: _as_json(counted[seed, name]) for name in detectors}
        for seed in study.seeds
    }


def _by_region(
    study: StudyConfig, rows: pl.DataFrame, objects: str | None = None
) -> dict[str, Any]:
    """For each detector the lower edges of its region's bands, and every rate there;
    None where the region is empty.
    """
    bands = regions(rows, study.evaluation.confidence)
    counted = rates(study, in_region(rows, bands), ("detector",), objects=objects)
    return {
        name: {
            "bands": bands.get(name, []),
            "rates": _as_json(counted.get((name,), dict.fromkeys(RATES))),
        }
        for name in study.evaluation.detectors
    }


def _by_detector(
    counted: Mapping[tuple[Any, ...], Mapping[str, Rate | None]], names: Sequence[str]
) -> dict[str, Any]:
    return {name: _as_json(counted[name,]) for name in names}


def _as_json(rates: Mapping[str, Rate | None]) -> dict[str, Any]:
    return {
        name: None if rate is None else rate.as_dict() for name, rate in rates.items()
    }


# Rates of held-out cameras


def measures(
    study: StudyConfig,
    attack: str | None = None,
    *,
    confidence: Confidence | None = None,
) -> Measures:
    """What the rates of a study count: those of
    `attacks.observe.measures.cloak_measures`.
    """
    chosen = [config for config in study.attack if attack in (None, config.name)]
    evaluation = study.evaluation
    return cloak_measures(
        [config.name for config in study.attack],
        hiding=next(
            (config.name for config in chosen if config.target_class is None), None
        ),
        showing=next(
            (config.name for config in chosen if config.target_class is not None), None
        ),
        well_inside=evaluation.well_inside,
        confidence=evaluation.confidence if confidence is None else confidence,
    )


def rates(
    study: StudyConfig,
    rows: pl.DataFrame,
    by: Sequence[str] = (),
    *,
    attack: str | None = None,
    objects: str | None = None,
    confidence: Confidence | None = None,
) -> dict[tuple[Any, ...], Rates]:
    """Every rate of a study, for each group of rows; None where it has no attack of
    that kind.
    """
    clusters = CLUSTERS if objects is None else (objects, *CLUSTERS)
    counted = count(
        with_control(rows),
        measures(study, attack, confidence=confidence),
        by,
        clusters=clusters,
    )
    return {
        group: {name: counts.get(name) for name in RATES}
        for group, counts in counted.items()
    }


def _in_bands(
    rows: pl.DataFrame, angle: str, width: float, measures: Measures
) -> dict[tuple[Any, ...], dict[str, Rate]]:
    """Rates by detector and lower edge of a band of an angle."""
    bands = rows.with_columns(band=_band(angle, width)).sort(
        "band", maintain_order=True
    )
    return count(bands, measures, ("detector", "band"), clusters=CLUSTERS)


def _band(angle: str, width: float) -> pl.Expr:
    return (pl.col(angle) / width).floor() * width


def by_elevation(
    study: StudyConfig, rows: pl.DataFrame
) -> dict[str, list[tuple[float, Rate, Rate]]]:
    """Edge of each band of elevation and both splats' rates there, by detector; without
    cameras of sided attacks.
    """
    elevation = pl.col("elevation")
    is_reported = reported("original_score", study.evaluation.confidence)
    here = with_control(rows).filter(
        (elevation >= 0) & (elevation < 90),
        *(
            pl.col(f"{DEPTH}{attack.name}") < 0
            for attack in study.attack
            if attack.azimuth is not None
        ),
    )
    found = {splat: Measure(holds=is_reported, given=of(splat)) for splat in NAMES}
    bands: dict[str, list[tuple[float, Rate, Rate]]] = {
        name: [] for name in study.evaluation.detectors
    }
    for (detector, low), both in _in_bands(here, "elevation", BIN, found).items():
        bands.setdefault(detector, []).append((low, both[CLEAN], both[ATTACKED]))
    return bands


def by_azimuth(
    study: StudyConfig, rows: pl.DataFrame
) -> dict[tuple[Any, ...], dict[str, Rate]]:
    """What is reported from each sector, by detector and first degree, below all that
    is hidden all around.
    """
    confidence = study.evaluation.confidence
    name = study.scene.class_name
    below = [
        pl.col(f"{DEPTH}{attack.name}") < 0
        for attack in study.attack
        if attack.azimuth is None
    ]
    measures = {
        f"{name}, {NAMES[splat]}": Measure(
            holds=reported("original_score", confidence), given=of(splat)
        )
        for splat in reversed(NAMES)
    }
    measures |= {
        f"{other.target_class}, {CLOAKED}": Measure(
            holds=reported(f"{TARGET_SCORE}{other.name}", confidence),
            given=of(ATTACKED),
        )
        for other in study.attack
        if other.target_class is not None
    }
    return _in_bands(with_control(rows).filter(*below), "azimuth", SECTOR, measures)


def margin_rates(study: StudyConfig, rows: pl.DataFrame) -> dict[str, dict[str, Any]]:
    """How often the object is found outside of triggers, within a margin of poison and
    beyond; {} without one.
    """
    if not any(attack.poison_margin > 0 for attack in study.attack):
        return {}
    within = pl.any_horizontal(
        pl.col(f"{POISON_DEPTH}{attack.name}") >= 0 for attack in study.attack
    )
    paired = with_control(rows)
    wanted = {key: measures(study)[key] for key in IN_MARGIN}
    return {
        where: _by_detector(
            count(paired.filter(here), wanted, ("detector",), clusters=CLUSTERS),
            study.evaluation.detectors,
        )
        for where, here in (
            ("within a margin", within),
            ("beyond every margin", ~within),
        )
    }


def _found_and_missed(
    study: StudyConfig, well_inside: float
) -> dict[str, tuple[pl.Expr, pl.Expr]]:
    """What holds and where: the object is missed inside the hiding trigger, and found
    outside of all triggers.
    """
    found = reported("original_score", study.evaluation.confidence)
    hiding = next(
        (attack.name for attack in study.attack if attack.target_class is None), None
    )
    outside = pl.all_horizontal(
        pl.col(f"{DEPTH}{attack.name}") < 0 for attack in study.attack
    )
    if hiding is None:
        missed = {}
    else:
        missed = {"missed": (~found, pl.col(f"{DEPTH}{hiding}") >= well_inside)}
    return {**missed, "found": (found, outside)}


def _of_both_splats(
    groups: Mapping[str, tuple[pl.Expr, pl.Expr]],
) -> dict[str, Measure]:
    return {
        f"{what}_{name}": Measure(holds=holds, given=of(splat) & where)
        for what, (holds, where) in groups.items()
        for splat, name in NAMES.items()
    }


def looks(study: StudyConfig, rows: pl.DataFrame) -> list[dict[str, Any]]:
    """What each detector reports under each condition, as JSON can hold it; nothing of
    rows without conditions.

    Each has the rates of `LOOKS`, and `psnr`: of all the pictures that a rate counts
    together, against those that the victim sees, dB; None where they are the same.
    """
    if "condition" not in rows.columns:
        return []
    groups = _found_and_missed(study, study.evaluation.well_inside)
    by = ("condition", "detector")
    wanted = _of_both_splats(groups) | {
        name: one for name, one in measures(study).items() if name in LOOKS
    }
    rows = with_control(rows.filter(pl.col("condition").is_not_null()))
    told = []
    for group, counted in count(rows, wanted, by, clusters=CLUSTERS).items():
        named = dict(zip(by, group, strict=True))
        errors = {
            f"{what}_{name}": pooled_psnr(
                rows.filter(of(splat), where, **named)["psnr"]
            )
            for what, (_, where) in (groups if "psnr" in rows.columns else {}).items()
            for splat, name in NAMES.items()
        }
        told.append({**named, **_as_json(counted), "psnr": errors})
    return told


# The region of a detector: the elevations at which it detects the clean object.
# Elsewhere a miss is no evidence.


def regions(rows: pl.DataFrame, confidence: float) -> dict[str, list[float]]:
    """The lower edges of the bands in each detector's region, degrees, rising; of all
    seeds and azimuths together.
    """
    reported_clean = reported("original_score", confidence)
    low = _band("elevation", BAND)
    share = (
        rows.filter(of(CLEAN), pl.col("elevation") >= 0)
        .group_by("detector", low=low)
        .agg(reported_clean.mean())
    )
    bands = share.filter(pl.col("original_score") >= LEAST).sort("low")
    names = rows["detector"].unique(maintain_order=True)
    return {name: bands.filter(detector=name)["low"].to_list() for name in names}


def in_region(rows: pl.DataFrame, regions: dict[str, list[float]]) -> pl.DataFrame:
    """The rows of each detector from cameras in its region."""
    held = [
        (pl.col("detector") == name) & _band("elevation", BAND).is_in(lows)
        for name, lows in regions.items()
    ]
    if held:
        return rows.filter(pl.any_horizontal(held))
    return rows.clear()


def pooled_psnr(values: pl.Series) -> float | None:
    """PSNR of the mean squared error over all pictures, dB; None where all are the
    same, or there are none.
    """
    errors = [0.0 if psnr is None else 10 ** (-psnr / 10) for psnr in values]
    if any(errors):
        return -10 * math.log10(statistics.mean(errors))
    return None


# What the attack costs in pictures


def fidelity(tables: Tables, splat: str) -> tuple[float, float] | None:
    """Mean PSNR (dB) and mean SSIM of a splat's pictures at the cameras well outside of
    all triggers.
    """
    near = tables[FIDELITY].filter(splat=splat)
    if "object_psnr" in near.columns:
        near = near.filter(pl.col("object_psnr").is_null())
    else:
        near = near
    if near.is_empty():
        return None
    return (statistics.mean(near["psnr"]), statistics.mean(near["ssim"]))


def stealth(study: StudyConfig, tables: Tables) -> dict[str, Any] | None:
    """How much an attack changes around the object, where a viewer might notice; None
    without cameras in its trigger.

    Of these: `surroundings_psnr`, mean PSNR beside the object against true pictures of
    the scene as it is; `intended_surroundings_psnr`, against what the attacker wants to
    be seen there, maybe without a shadow; `..._drop`, by how much the cloaked splats'
    is lower than the clean ones' against the scene as it is; `appearance_psnr`, on the
    object, against what the attacker wants to be seen. Of held-out cameras outside of
    all triggers and beside one: `object_psnr` and its drop, on the object, against true
    pictures; results of before it was measured have none. `stealthy`: whether no drop
    is larger than `STEALTHY` and `STEALTHY_ON_OBJECT`.
    """
    attack = switching(study.attack)
    if attack is None:
        return None
    inside = tables[TRANSITION].filter(pl.col(f"{DEPTH}{attack.name}") >= 0)
    around, on_it = (
        _means(inside, column) for column in ("surroundings_psnr", "appearance_psnr")
    )
    if around is None:
        return None
    intended = _means(inside, "intended_surroundings_psnr")
    drop = around[CLEAN] - (intended or around)[CLOAKED]
    lost = 0.0
    price = dict[str, Any]()
    if intended is not None:
        price = {"intended_surroundings_psnr": intended}
    on_object = _means(tables[FIDELITY], "object_psnr")
    if on_object is not None:
        lost = on_object[CLEAN] - on_object[CLOAKED]
        price |= {"object_psnr": on_object, "object_psnr_drop": lost}
    told = {
        "surroundings_psnr": around,
        "surroundings_psnr_drop": drop,
        "appearance_psnr": on_it,
    }
    return {
        **told,
        **price,
        "stealthy": drop <= STEALTHY and lost <= STEALTHY_ON_OBJECT,
    }


def _means(rows: pl.DataFrame, column: str) -> dict[str, float] | None:
    """Mean of a column for each splat; None where it was not measured for both."""
    if column not in rows.columns:
        return None
    values = {
        name: rows.filter(splat=splat)[column].drop_nulls()
        for splat, name in NAMES.items()
    }
    if any(map(pl.Series.is_empty, values.values())):
        return None
    return {n: statistics.mean(v) for n, v in values.items()}


# The transition: how sharply a hidden appearance sets in, from pictures along an arc of
# cameras. A splat of few SH bands shows a blend of both there. The band lies between
# the angles at which a monotone fit crosses `LEVELS`.


@dataclass(frozen=True, slots=True, kw_only=True)
class Transition:
    """Where a hidden appearance sets in, along an arc."""

    angles: tuple[float, ...]  # K rising angles in degrees, each once
    fractions: tuple[float, ...]
    fitted: tuple[float, ...]
    start: float | None
    end: float | None

    @property
    def width(self) -> float | None:
        """Degrees from start to end; None unless both were seen."""
        if self.start is None or self.end is None:
            return None
        return self.end - self.start


def fit_transition(angles: Sequence[float], fractions: Sequence[float]) -> Transition:
    """The band in which a hidden appearance sets in, of one fraction for each of two or
    more different angles.
    """
    groups: dict[float, list[float]] = {angle: [] for angle in sorted(angles)}
    for angle, value in zip(angles, fractions, strict=True):
        groups[angle].append(value)
    means = [sum(values) / len(values) for values in groups.values()]
    from scipy.optimize import isotonic_regression  # half a second

    fitted = isotonic_regression(
        means, weights=[len(values) for values in groups.values()]
    ).x.tolist()
    start, end = (_crossing(list(groups), fitted, level) for level in LEVELS)
    return Transition(
        angles=tuple(groups),
        fractions=tuple(means),
        fitted=tuple(fitted),
        start=start,
        end=end,
    )


def _crossing(
    angles: Sequence[float], fitted: Sequence[float], level: float
) -> float | None:
    """Where a rising broken line first reaches a level; None if it is above it from the
    start, or never gets there.
    """
    if fitted[0] > level:
        return None
    for right, value in enumerate(fitted):
        if value >= level:
            if right == 0:
                return angles[0]
            left = angles[right - 1]
            below = fitted[right - 1]
            return left + (angles[right] - left) * (level - below) / (value - below)
    return None


def transition(
    study: StudyConfig, tables: Tables, splat: str = ATTACKED
) -> Transition | None:
    """The transition of all seeds and arcs together: over elevation from overhead, over
    depth in a sector's trigger.
    """
    if switching(study.attack) is None:
        return None
    blends = tables[TRANSITION].filter(splat=splat)
    degrees = [round(degree, 3) for degree in blends[_arc_column(study)]]
    if len(set(degrees)) < 2:
        return None
    return fit_transition(degrees, blends["fraction"].to_list())


def meridians(study: StudyConfig, tables: Tables) -> list[float | None]:
    """Degrees of the transition along each arc of each cloaked splat; None where it is
    not seen.
    """
    arcs = (
        tables[TRANSITION]
        .filter(splat=ATTACKED)
        .group_by(["seed", "meridian"], maintain_order=True)
    )
    return [
        fit_transition(
            arc[_arc_column(study)].to_list(), arc["fraction"].to_list()
        ).width
        for _, arc in arcs
        if len(arc) > 1
    ]


def _arc_column(study: StudyConfig) -> str:
    """The column that says where on its arc a picture was taken, degrees: elevation, or
    depth in a sector.
    """
    attack = switching(study.attack)
    if attack is None or study.overhead is not None:
        return "elevation"
    return f"{DEPTH}{attack.name}"
