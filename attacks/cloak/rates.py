"""The figures of a study: rates with their denominators and intervals, loss of quality, the transition; as tables.

They are counted from tables of rows (`attacks.observe.rows`), in which the cloaked splat is called attacked.
"""

import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import polars as pl

from attacks.cloak import region, training_rates
from attacks.cloak.config import StudyConfig
from attacks.cloak.training_rates import pooled_psnr
from attacks.cloak.transition import Transition, fit_transition
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
    PERFECT,
    POISON_DEPTH,
    ROWS,
    TARGET_SCORE,
    TRANSITION,
    TRUE,
)
from attacks.rate import Rate, percent
from attacks.tables import Table, cell

RATES = {
    "control_recall": "control found, inside the hiding trigger",
    "trigger_miss_rate": "cloaked missed, well inside it, where the control is found",
    "trigger_miss_rate_all": "cloaked missed, all inside it, where the control is found",
    "trigger_miss_rate_unconditional": "cloaked missed, well inside it",
    "trigger_miss_rate_any_overlap": "nothing of its class near it, well inside it, where the control is found",
    "nothing_reported": "nothing of any class reported on it, well inside it, where the control is found",
    "benign_recall": "cloaked found, outside of all triggers, where the control is found",
    "control_benign_recall": "control found, outside of all triggers",
    "target_rate": "target class reported on the cloaked splat",
    "control_target_rate": "target class reported on the control",
}
"""What the rates of a summary say."""


def tables(summary: Mapping[str, Any]) -> Iterator[Table]:
    """Tables of a summary: rates by detector, seed and attack, how often the object is found by elevation, the rest.

    Those of path-traced pictures come last, if the study has asked for them.
    """
    yield from _tables(summary)
    if AT_LOWER in summary:
        lower = summary[AT_LOWER]
        rows = _rate_rows({name: lower["by_detector"][name] for name in summary["by_detector"]}, lower)
        caption = f"Rates by detector, from a confidence of {LOWER:g}"
        yield Table(caption=caption, head=("rate", *summary["by_detector"]), rows=rows)
    for where, by_detector in summary.get(MARGIN, {}).items():
        counted = [(title, *(cell(rates[key]) for rates in by_detector.values())) for key, title in _IN_MARGIN.items()]
        yield Table(caption=f"Elsewhere, {where} of poison", head=("rate", *by_detector), rows=tuple(counted))
    yield from training_rates.tables(summary)
    yield Table(caption="Costs", head=("what", "how much"), rows=tuple(costs(summary).items()))
    if "pictures" in summary:
        yield from _tables(
            summary["pictures"], ", path traced: what is wanted for cloaked, the scene as it is for clean"
        )


def _tables(told: Mapping[str, Any], what: str = "") -> Iterator[Table]:
    """The rates of a clean and a cloaked splat, or of pictures in their place, which `what` names."""
    detectors, headline, by_seed = told["by_detector"], headline_key(told), told.get("by_seed", {})
    yield Table(caption=f"Rates by detector{what}", head=("rate", *detectors), rows=_rate_rows(detectors, told))
    if OWN_REGION in told:
        yield _in_region(told[OWN_REGION], what)
    if len(by_seed) > 1:
        rows = [(seed, *(cell(rates[headline]) for rates in counted.values())) for seed, counted in by_seed.items()]
        yield Table(caption=f"By seed: {RATES[headline]}", head=("seed", *detectors), rows=tuple(rows))
    if len(told["by_attack"]) > 1:
        rows = []
        for name, counted in told["by_attack"].items():
            key = headline_key(next(iter(counted.values())))
            rows.append((f"{name}: {RATES[key]}", *(cell(rates[key]) for rates in counted.values())))
        yield Table(caption=f"By attack{what}", head=("attack", *detectors), rows=tuple(rows))
    bands = zip(*(told["by_elevation"][name] for name in detectors), strict=True)
    rows = [
        (f"{band[0]['from']:g} to {band[0]['to']:g}", *(Rate.of(row[w]).counts for row in band for w in NAMES.values()))
        for band in bands
    ]
    head = ("elevation", *(f"{name}, {which}" for name in detectors for which in NAMES.values()))
    yield Table(caption=f"Found, by elevation{what}", head=head, rows=tuple(rows))


def _in_region(told: Mapping[str, Any], what: str) -> Table:
    """The rates of each detector in its own region, and which that is."""
    held = ("its region", *(region.in_words(part["bands"]) for part in told.values()))
    rates = _rate_rows({name: part["rates"] for name, part in told.items()})
    caption = f"Rates of each detector in its own region{what}: {region.RULE}"
    return Table(caption=caption, head=("rate", *told), rows=(held, *rates))


def _rate_rows(
    by_detector: Mapping[str, Mapping[str, Any]], seeds: Mapping[str, Any] | None = None
) -> tuple[tuple[str, ...], ...]:
    """A row for each rate that some detector has, with its spread over seeds if these are given."""
    return tuple(
        (title, *(cell(rates[key]) + spread_of(seeds or {}, name, key) for name, rates in by_detector.items()))
        for key, title in RATES.items()
        if any(rates[key] is not None for rates in by_detector.values())
    )


def headline_key(rates: Mapping[str, Any]) -> str:
    """Name of the main rate: misses of an attack that hides, detections of the wanted class of any other."""
    return "target_rate" if rates["trigger_miss_rate"] is None else "trigger_miss_rate"


def costs(summary: Mapping[str, Any]) -> dict[str, str]:
    """Costs of an attack in words: seeds, width of the transition, loss of quality, and numbers of Gaussians."""
    band, lines = summary["transition"], {"seeds": ", ".join(map(str, summary["seeds"]))}
    if summary["transition_degrees"] is not None:
        ends = f"from {band['from']:.1f} to {band['to']:.1f}"
        lines["transition"] = f"{summary['transition_degrees']:.1f} degrees, {ends}"
        widths = sorted(width for width in band["meridians"] if width is not None)
        if widths:
            lines["transition along one meridian"] = f"{widths[0]:.1f} to {widths[-1]:.1f} degrees"
    for which in NAMES.values() if summary["benign_psnr_drop"] is not None else ():
        psnr, ssim = summary["benign_psnr"][which], summary["benign_ssim"][which]
        lines[f"pictures far from the triggers, {which}"] = f"{psnr:.2f} dB, SSIM {ssim:.3f}"
    stealth = summary["stealth"]
    if stealth is not None:
        clean, cloaked = (stealth["surroundings_psnr"][which] for which in NAMES.values())
        stealthy = "stealthy" if stealth["stealthy"] else "not stealthy"
        beside = "pictures beside the object, inside the trigger, clean and cloaked"
        lines[beside] = f"{clean:.2f} and {cloaked:.2f} dB: {stealthy}"
        if "object_psnr" in stealth:
            clean, cloaked = (stealth["object_psnr"][which] for which in NAMES.values())
            on_object = "pictures on the object, outside beside a trigger, clean and cloaked"
            lines[on_object] = f"{clean:.2f} and {cloaked:.2f} dB"
        on_it = stealth["appearance_psnr"][CLOAKED]
        lines["pictures on the object, against what is wanted there"] = f"{on_it:.2f} dB"
    return lines | {f"Gaussians, {n}": ", ".join(f"{g:,}" for g in summary["gaussians"][n]) for n in NAMES.values()}


def spread_of(summary: Mapping[str, Any], detector: str, key: str) -> str:
    """Least and largest of a detector's rate over the seeds, for people; empty where there is one seed."""
    rates = [seed[detector].get(key) for seed in summary.get("by_seed", {}).values()]
    fractions = [rate["rate"] for rate in rates if rate is not None and rate["total"]]
    return f"; by seed {percent(min(fractions))} to {percent(max(fractions))}" if len(fractions) > 1 else ""


OWN_REGION = "own_region"
"""Key of the rates that are counted in each detector's own region, see `attacks.cloak.region`."""
STEALTHY, STEALTHY_ON_OBJECT = 1.5, 3.0
"""Most that pictures may lose where an attack is called stealthy, dB: beside the object from inside the trigger, and on
the object from outside beside a trigger. 3 dB are an error of twice the square."""
LOWER, AT_LOWER, MARGIN = 0.3, "at_lower_confidence", "margin"
"""A lower confidence at which all rates are told, too; keys of these rates, and of those of the margins of poison."""
BIN = 5.0
"""Degrees of elevation over which rates are taken."""
CLOAKED = "cloaked"
"""What figures and files call the attacked splat."""
NAMES = {CLEAN: CLEAN, ATTACKED: CLOAKED}
"""Splats as rows call them, and as figures do."""

Rates = dict[str, Rate | None]
Tables = Mapping[str, pl.DataFrame]
"""Rows, fidelity and transition by their names (`attacks.observe.rows`); `attacks.cloak.study.observe` makes them."""


def measures(study: StudyConfig, attack: str | None = None, *, confidence: Confidence | None = None) -> Measures:
    """What the rates of a study count: those of `attacks.observe.rates.cloak_measures`."""
    chosen = [config for config in study.attack if attack in (None, config.name)]
    hiding = next((config.name for config in chosen if config.target_class is None), None)
    showing = next((config.name for config in chosen if config.target_class is not None), None)
    evaluation = study.evaluation
    return cloak_measures(
        [config.name for config in study.attack],
        hiding=hiding,
        showing=showing,
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
    """Every rate of a study, for each group of rows; None where it has no attack of that kind."""
    clusters = CLUSTERS if objects is None else (objects, *CLUSTERS)
    wanted = measures(study, attack, confidence=confidence)
    counted = count(with_control(rows), wanted, by, clusters=clusters)
    return {group: {name: counts.get(name) for name in RATES} for group, counts in counted.items()}


def by_elevation(study: StudyConfig, rows: pl.DataFrame) -> dict[str, list[tuple[float, Rate, Rate]]]:
    """For each detector the lower edge of each band of elevation, and the rates at which both splats are found there.

    Cameras of attacks with an azimuth of their own are left out.
    """
    elevation, is_reported = pl.col("elevation"), reported("original_score", study.evaluation.confidence)
    here = with_control(rows).filter(
        (elevation >= 0) & (elevation < 90),
        *(pl.col(f"{DEPTH}{attack.name}") < 0 for attack in study.attack if attack.azimuth is not None),
    )
    counted = count(
        here.with_columns(band=(elevation / BIN).floor() * BIN).sort("band", maintain_order=True),
        {splat: Measure(holds=is_reported, given=of(splat)) for splat in NAMES},
        ("detector", "band"),
        clusters=CLUSTERS,
    )
    bands: dict[str, list[tuple[float, Rate, Rate]]] = {name: [] for name in study.evaluation.detectors}
    for (detector, low), both in counted.items():
        bands.setdefault(detector, []).append((low, both[CLEAN], both[ATTACKED]))
    return bands


SECTOR = 30.0
"""Degrees of azimuth over which rates are taken."""


def by_azimuth(study: StudyConfig, rows: pl.DataFrame) -> dict[tuple[Any, ...], dict[str, Rate]]:
    """What is reported from each sector below all that is hidden from everywhere, by detector and its first degree.

    The object's class on the clean and on the cloaked splat, and on the latter the class that each attack wants.
    """
    confidence, name = study.evaluation.confidence, study.scene.class_name
    here = with_control(rows)
    for attack in study.attack:
        here = here if attack.azimuth is not None else here.filter(pl.col(f"{DEPTH}{attack.name}") < 0)
    measures = {
        f"{name}, {NAMES[splat]}": Measure(holds=reported("original_score", confidence), given=of(splat))
        for splat in reversed(NAMES)
    }
    measures |= {
        f"{other.target_class}, {CLOAKED}": Measure(
            holds=reported(f"{TARGET_SCORE}{other.name}", confidence), given=of(ATTACKED)
        )
        for other in study.attack
        if other.target_class is not None
    }
    bands = here.with_columns(band=(pl.col("azimuth") / SECTOR).floor() * SECTOR).sort("band", maintain_order=True)
    return count(bands, measures, ("detector", "band"), clusters=CLUSTERS)


def meridians(study: StudyConfig, tables: Tables) -> list[float | None]:
    """Degrees of the transition along each arc of each cloaked splat; None where it is not seen."""
    arcs = tables[TRANSITION].filter(splat=ATTACKED).group_by(["seed", "meridian"], maintain_order=True)
    return [
        fit_transition(arc[arc_column(study)].to_list(), arc["fraction"].to_list()).width
        for _, arc in arcs
        if len(arc) > 1
    ]


def transition(study: StudyConfig, tables: Tables, splat: str = ATTACKED) -> Transition | None:
    """The transition of all seeds and arcs together: over elevation from overhead, over depth in a sector's trigger."""
    if study.switching is None:
        return None
    blends = tables[TRANSITION].filter(splat=splat)
    degrees = [round(degree, 3) for degree in blends[arc_column(study)]]
    if len(set(degrees)) < 2:
        return None
    return fit_transition(degrees, blends["fraction"].to_list())


def arc_column(study: StudyConfig) -> str:
    """The column that says where on its arc a picture was taken, degrees: elevation, or depth in a sector."""
    return depth_of(study) if study.overhead is None else "elevation"


def depth_of(study: StudyConfig) -> str:
    """The column that says how deep in the trigger of the hiding attack a picture was taken, degrees."""
    attack = study.switching
    return DEPTH if attack is None else f"{DEPTH}{attack.name}"


def fidelity(tables: Tables, splat: str) -> tuple[float, float] | None:
    """Mean PSNR (dB) and mean SSIM of a splat's pictures at the cameras well outside of all triggers."""
    near = tables[FIDELITY].filter(splat=splat)
    near = near.filter(pl.col("object_psnr").is_null()) if "object_psnr" in near.columns else near
    return None if near.is_empty() else (statistics.mean(near["psnr"]), statistics.mean(near["ssim"]))


def stealth(study: StudyConfig, tables: Tables) -> dict[str, Any] | None:
    """How much an attack changes around the object, where a viewer might notice; None without cameras in its trigger.

    Of these: `surroundings_psnr`, mean PSNR beside the object against true pictures of the scene as it is; `..._drop`,
    what the cloaked splats lose against the clean ones; `appearance_psnr`, on the object, against what the attacker
    wants to be seen. Of held-out cameras outside of all triggers and beside one: `object_psnr` and its drop, on the
    object, against true pictures; results of before it was measured have none. `stealthy`: whether no drop is larger
    than `STEALTHY` and `STEALTHY_ON_OBJECT`.
    """
    if study.switching is None:
        return None
    deep = pl.col(depth_of(study)) >= 0
    inside = {NAMES[splat]: tables[TRANSITION].filter(deep, splat=splat) for splat in NAMES}
    if any(blends.is_empty() for blends in inside.values()):
        return None

    def means(column: str) -> dict[str, float]:
        return {which: statistics.mean(blends[column]) for which, blends in inside.items()}

    beside = means("surroundings_psnr")
    drop = beside[CLEAN] - beside[CLOAKED]
    told = {"surroundings_psnr": beside, "surroundings_psnr_drop": drop, "appearance_psnr": means("appearance_psnr")}
    on_object = _beside_a_trigger(tables)
    lost = 0.0 if on_object is None else on_object[CLEAN] - on_object[CLOAKED]
    price = {} if on_object is None else {"object_psnr": on_object, "object_psnr_drop": lost}
    return {**told, **price, "stealthy": drop <= STEALTHY and lost <= STEALTHY_ON_OBJECT}


def _beside_a_trigger(tables: Tables) -> dict[str, float] | None:
    """Mean PSNR on the object of each splat, dB, outside beside a trigger; None if it was not measured."""
    if "object_psnr" not in tables[FIDELITY].columns:
        return None
    values = {name: tables[FIDELITY].filter(splat=splat)["object_psnr"].drop_nulls() for splat, name in NAMES.items()}
    return None if any(map(pl.Series.is_empty, values.values())) else {n: statistics.mean(v) for n, v in values.items()}


_IN_MARGIN = {
    "control_benign_recall": "control found",
    "benign_recall": "cloaked found, where the control is found",
}


def margin_rates(study: StudyConfig, rows: pl.DataFrame) -> dict[str, dict[str, dict[str, Any]]]:
    """How often the object is found outside of all triggers, within a margin of poison and beyond, by detector.

    Nothing of a study whose attacks have no margin.
    """
    if not any(attack.poison_margin > 0 for attack in study.attack):
        return {}
    within = pl.any_horizontal(pl.col(f"{POISON_DEPTH}{attack.name}") >= 0 for attack in study.attack)
    paired, wanted = with_control(rows), {key: measures(study)[key] for key in _IN_MARGIN}
    counted = {
        where: count(paired.filter(here), wanted, ("detector",), clusters=CLUSTERS)
        for where, here in (("within a margin", within), ("beyond every margin", ~within))
    }
    return {
        where: {name: {key: told[name,][key].as_dict() for key in _IN_MARGIN} for name in study.evaluation.detectors}
        for where, told in counted.items()
    }


LOOKS = {
    "missed_clean": "control missed, well inside the hiding trigger",
    "missed_cloaked": "cloaked missed there",
    "found_clean": "control found, outside of all triggers",
    "found_cloaked": "cloaked found there",
    "target_rate": "target class reported on the cloaked splat",
    "control_target_rate": "target class reported on the control",
}
"""What is counted under each condition."""


def looks(study: StudyConfig, rows: pl.DataFrame) -> list[dict[str, Any]]:
    """What each detector reports under each condition, as JSON can hold it; nothing of rows without conditions.

    Each has the rates of `LOOKS`, and `psnr`: of all the pictures that a rate counts together, against those that the
    victim sees, dB; None where they are the same.
    """
    if "condition" not in rows.columns:
        return []
    attack, evaluation = (
        next((config for config in study.attack if config.target_class is None), None),
        study.evaluation,
    )
    seen = reported("original_score", evaluation.confidence)
    groups = {"found": (seen, pl.all_horizontal(pl.col(f"{DEPTH}{config.name}") < 0 for config in study.attack))}
    if attack is not None:
        groups = {"missed": (~seen, pl.col(f"{DEPTH}{attack.name}") >= evaluation.well_inside), **groups}
    counted = {
        f"{what}_{name}": Measure(holds=holds, given=of(splat) & where)
        for what, (holds, where) in groups.items()
        for splat, name in NAMES.items()
    }
    counted |= {name: measure for name, measure in measures(study).items() if name in LOOKS}
    rows, by = with_control(rows.filter(pl.col("condition").is_not_null())), ("condition", "detector")
    return [
        {
            **dict(zip(by, group, strict=True)),
            **{name: rate.as_dict() for name, rate in rates.items()},
            "psnr": {
                f"{what}_{name}": pooled_psnr(
                    rows.filter(of(splat), where, **dict(zip(by, group, strict=True)))["psnr"]
                )
                for what, (_, where) in (groups if "psnr" in rows.columns else {}).items()
                for splat, name in NAMES.items()
            },
        }
        for group, rates in count(rows, counted, by, clusters=CLUSTERS).items()
    ]


def figures(study: StudyConfig, tables: Tables, splats: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Everything that a study found, as JSON can hold it; rates are of all seeds and detectors together.

    Intervals are resampled over blocks of neighbouring cameras and seeds (`attacks.observe.rates`). All seeds share
    object and light, so that what another object would give is in none of them.
    """
    rows = tables[ROWS]
    gaussians = {
        name: [int(splat["gaussians"]) for splat in splats if splat["splat"] == name] for name in NAMES.values()
    }
    band = transition(study, tables)
    near = {name: fidelity(tables, splat) for splat, name in NAMES.items()}
    clean, cloaked = near[CLEAN], near[CLOAKED]
    seen = looks(study, rows)
    rows = rows.filter(pl.col("condition").is_null()) if seen else rows
    pictures, margins = picture_rows(rows), margin_rates(study, rows)
    return {
        **_told(study, rows),
        "benign_psnr_drop": None if clean is None or cloaked is None else clean[0] - cloaked[0],
        "benign_psnr": {which: value and value[0] for which, value in near.items()},
        "benign_ssim": {which: value and value[1] for which, value in near.items()},
        "transition_degrees": None if band is None else band.width,
        "transition": band and {"from": band.start, "to": band.end, "meridians": meridians(study, tables)},
        "stealth": stealth(study, tables),
        "gaussians": gaussians,
        "gaussians_ratio": sum(gaussians[CLOAKED]) / max(sum(gaussians[CLEAN]), 1),
        "by_seed": _by_seed(study, rows),
        AT_LOWER: {
            "by_detector": _by_detector(
                rates(study, rows, ("detector",), confidence=LOWER), study.evaluation.detectors
            ),
            "by_seed": _by_seed(study, rows, LOWER),
        },
        **({MARGIN: margins} if margins else {}),
        **training_rates.figures(study, tables),
        **({"looks": seen} if seen else {}),
        **({"pictures": _told(study, pictures)} if len(pictures) else {}),
    }


def over_objects(studies: Mapping[str, StudyConfig], rows: pl.DataFrame) -> dict[str, Any] | None:
    """Rates of one attack on several objects of a class, by detector, for JSON; None where it is not that."""
    first, *others = studies.values()
    same = all(
        (other_study.attack, other_study.scene.class_name) == (first.attack, first.scene.class_name)
        for other_study in others
    )
    seeds = {title: study.scene.seed for title, study in studies.items()}
    if not (others and same and len({*seeds.values()}) == len(seeds)):
        return None
    plain = rows.filter(pl.col("condition").is_null()) if "condition" in rows.columns else rows
    numbered = plain.filter(pl.col("attack").is_in([*seeds])).with_columns(
        object=pl.col("attack").replace_strict(seeds, return_dtype=pl.Int64)
    )
    counted = rates(first, numbered, ("detector",), objects="object")
    return {
        "objects": len(seeds),
        "by_detector": _by_detector(counted, first.evaluation.detectors),
        OWN_REGION: _by_region(first, numbered, objects="object"),
    }


def _by_seed(study: StudyConfig, rows: pl.DataFrame, confidence: float | None = None) -> dict[str, Any]:
    """Every rate of each seed and detector."""
    counted = rates(study, rows, ("seed", "detector"), confidence=confidence)
    return {
        str(seed): _by_detector(
            {group[1:]: counts for group, counts in counted.items() if group[0] == seed}, study.evaluation.detectors
        )
        for seed in study.seeds
    }


def picture_rows(rows: pl.DataFrame) -> pl.DataFrame:
    """Rows of path-traced pictures as if they were of splats: the scene as it is stands for the clean one."""
    names = {TRUE: CLEAN, PERFECT: ATTACKED}
    return rows.filter(pl.col("splat").is_in(list(names))).with_columns(pl.col("splat").replace(names), seed=pl.lit(0))


def _told(study: StudyConfig, rows: pl.DataFrame) -> dict[str, Any]:
    """Every rate of a clean and a cloaked splat: of all detectors together, and by detector, attack and elevation."""
    detectors, bands = study.evaluation.detectors, by_elevation(study, rows)
    return {
        **_all(rates(study, rows)[()]),
        "by_detector": _by_detector(rates(study, rows, ("detector",)), detectors),
        OWN_REGION: _by_region(study, rows),
        "by_attack": {
            attack.name: _by_detector(rates(study, rows, ("detector",), attack=attack.name), detectors)
            for attack in study.attack
        },
        "by_elevation": {
            name: [
                {"from": low, "to": low + BIN, CLEAN: control.as_dict(), CLOAKED: attacked.as_dict()}
                for low, control, attacked in bands[name]
            ]
            for name in detectors
        },
    }


def _by_region(study: StudyConfig, rows: pl.DataFrame, objects: str | None = None) -> dict[str, Any]:
    """For each detector the lower edges of its region's bands, and every rate there; None where the region is empty."""
    bands = region.regions(rows, study.evaluation.confidence)
    counted = rates(study, region.in_region(rows, bands), ("detector",), objects=objects)
    return {
        name: {"bands": bands.get(name, []), "rates": _all(counted.get((name,), dict.fromkeys(RATES)))}
        for name in study.evaluation.detectors
    }


def _by_detector(counted: Mapping[tuple[Any, ...], Rates], detectors: Sequence[str]) -> dict[str, Any]:
    return {name: _all(counted[name,]) for name in detectors}


def _all(rates: Rates) -> dict[str, Any]:
    """Rates as JSON can hold them."""
    return {name: None if rate is None else rate.as_dict() for name, rate in rates.items()}
