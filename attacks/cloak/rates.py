"""The figures of a study: rates with their denominators and intervals, loss of quality, the transition; as Markdown.

They are counted from rows (`attacks.observe.rows`), in which the cloaked splat is called attacked.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import polars as pl

from attacks.cloak import setup
from attacks.cloak.config import StudyConfig
from attacks.cloak.transition import Transition, fit_transition
from attacks.observe.measures import CLUSTERS, Confidence, Measures, cloak_measures, of, reported, with_control
from attacks.observe.rates import Measure, count
from attacks.observe.rows import ATTACKED, CLEAN, DEPTH
from attacks.rate import Rate

ROWS = {
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


def markdown(summary: Mapping[str, Any]) -> str:
    """Tables of a summary: rates by detector and their spread over seeds, found by elevation, and the rest."""
    detectors = summary["by_detector"]
    lines = ["| | " + " | ".join(detectors) + " |", "|---" * (len(detectors) + 1) + "|"]
    for key, title in ROWS.items():
        cells = [words_of(rates[key]) + spread_of(summary, name, key) for name, rates in detectors.items()]
        if any(cells):
            lines.append(f"| {title} | " + " | ".join(cells) + " |")
    lines += ["", "| elevation | " + " | ".join(f"{name}, clean | cloaked" for name in detectors) + " |"]
    lines.append("|---" * (2 * len(detectors) + 1) + "|")
    for rows in zip(*(summary["by_elevation"][name] for name in detectors), strict=True):
        cells = [words_of(row[which], interval=False) for row in rows for which in ("clean", "cloaked")]
        lines.append(f"| {rows[0]['from']:g} to {rows[0]['to']:g} | " + " | ".join(cells) + " |")
    band, drop = summary["transition"], summary["benign_psnr_drop"]
    lines += ["", "| | |", "|---|---|"]
    lines.append(f"| seeds | {', '.join(map(str, summary['seeds']))} |")
    if band is not None and summary["transition_degrees"] is not None:
        degrees = f"{summary['transition_degrees']:.1f} degrees, from {band['from']:.1f} to {band['to']:.1f}"
        lines.append(f"| transition | {degrees} |")
        widths = sorted(width for width in band["meridians"] if width is not None)
        if widths:
            lines.append(f"| along one meridian | {widths[0]:.1f} to {widths[-1]:.1f} degrees |")
    if drop is not None:
        psnr, ssim = summary["benign_psnr"], summary["benign_ssim"]
        lines.append(f"| far from the triggers, clean | {psnr['clean']:.2f} dB, SSIM {ssim['clean']:.3f} |")
        lines.append(f"| far from the triggers, cloaked | {psnr['cloaked']:.2f} dB, SSIM {ssim['cloaked']:.3f} |")
    price = summary["stealth"]
    if price is not None:
        before, after = (price["surroundings_psnr"][which] for which in ("clean", "cloaked"))
        title = "stealthy" if price["stealthy"] else "not stealthy"
        lines.append(
            f"| beside the object, inside the trigger, clean and cloaked | {before:.2f} and {after:.2f} dB: {title} |"
        )
        lines.append(f"| on the object, against what is wanted there | {price['appearance_psnr']['cloaked']:.2f} dB |")
    for which in ("clean", "cloaked"):
        lines.append(f"| Gaussians, {which} | {', '.join(f'{n:,}' for n in summary['gaussians'][which])} |")
    return "\n".join(lines) + "\n"


def spread_of(summary: Mapping[str, Any], detector: str, key: str) -> str:
    """Least and largest of a detector's rate over the seeds, for people; empty where there is one seed."""
    rates = [seed[detector].get(key) for seed in summary["by_seed"].values()]
    fractions = [rate["rate"] for rate in rates if rate is not None and rate["total"]]
    return f"; by seed {min(fractions):.1%} to {max(fractions):.1%}" if len(fractions) > 1 else ""


def words_of(rate: Mapping[str, Any] | None, *, interval: bool = True) -> str:
    """A rate for people; empty if there is none."""
    if rate is None or not rate["total"]:
        return ""
    low, high = rate["interval"]
    fraction = f"{rate['successes']}/{rate['total']}"
    return f"{fraction} = {rate['rate']:.1%} ({low:.1%} to {high:.1%})" if interval else fraction


STEALTHY = 1.5
"""Most that the surroundings of an object may lose where an attack is called stealthy, dB."""
BIN = 5.0
"""Degrees of elevation over which rates are taken."""
CLOAKED = "cloaked"
"""What figures and files call the attacked splat."""
NAMES = {CLEAN: CLEAN, ATTACKED: CLOAKED}
"""Splats as rows call them, and as figures do."""

Rates = dict[str, Rate | None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StudyRows:
    """What was seen of the splats of a study.

    Attributes:
        rows: A row for each splat, seed, detector and held-out camera.
        fidelity: A row for each splat, seed and camera far outside of all triggers.
        transition: A row for each splat, seed and camera of an arc.
        gaussians: Number of Gaussians of the clean and of the cloaked splats, by seed in the order of the study.
    """

    rows: pl.DataFrame
    fidelity: pl.DataFrame
    transition: pl.DataFrame
    gaussians: Mapping[str, Sequence[int]]


def measures(study: StudyConfig, attack: str | None = None, *, confidence: Confidence | None = None) -> Measures:
    """What the rates of a study count: those of `attacks.observe.measures.cloak_measures`.

    Args:
        study: The study.
        attack: Name of the attack that is meant; None is the first that hides and the first that has a target class.
        confidence: From which a detection counts; None is the study's.
    """
    chosen = [one for one in study.attack if attack in (None, one.name)]
    hiding = next((one.name for one in chosen if one.target_class is None), None)
    showing = next((one.name for one in chosen if one.target_class is not None), None)
    evaluation = study.evaluation
    return cloak_measures(
        [one.name for one in study.attack],
        hiding=hiding,
        showing=showing,
        well_inside=evaluation.well_inside,
        confidence=evaluation.confidence if confidence is None else confidence,
    )


def rates(
    study: StudyConfig, rows: pl.DataFrame, by: Sequence[str] = (), *, attack: str | None = None
) -> dict[tuple[Any, ...], Rates]:
    """Every rate of a study, for each group of rows; None where it has no attack of that kind.

    Args:
        study: The study.
        rows: Of both splats.
        by: Columns that make the groups.
        attack: As in `measures`.
    """
    counted = count(with_control(rows), measures(study, attack), by, clusters=CLUSTERS)
    return {group: {name: counts.get(name) for name in ROWS} for group, counts in counted.items()}


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


def meridians(study: StudyConfig, seen: StudyRows) -> list[float | None]:
    """Degrees of the transition along each arc of each cloaked splat; None where it is not seen."""
    arcs = seen.transition.filter(splat=ATTACKED).group_by(["seed", "meridian"], maintain_order=True)
    return [
        fit_transition(arc[place_of(study)].to_list(), arc["fraction"].to_list()).width
        for _, arc in arcs
        if len(arc) > 1
    ]


def transition(study: StudyConfig, seen: StudyRows, splat: str = ATTACKED) -> Transition | None:
    """The transition of all seeds and arcs together: over elevation from overhead, over depth in a sector's trigger."""
    if setup.hiding(study) is None:
        return None
    blends = seen.transition.filter(splat=splat)
    places = [round(place, 3) for place in blends[place_of(study)]]
    if len(set(places)) < 2:
        return None
    return fit_transition(places, blends["fraction"].to_list())


def place_of(study: StudyConfig) -> str:
    """The column that says where on its arc a picture was taken, degrees: elevation, or depth in a sector."""
    return depth_of(study) if setup.overhead(study) is None else "elevation"


def depth_of(study: StudyConfig) -> str:
    """The column that says how deep in the trigger of the hiding attack a picture was taken, degrees."""
    attack = setup.hiding(study)
    return DEPTH if attack is None else f"{DEPTH}{attack.name}"


def fidelity(seen: StudyRows, splat: str) -> tuple[float, float] | None:
    """Mean PSNR (dB) and mean SSIM of a splat's pictures at the cameras well outside of all triggers."""
    near = seen.fidelity.filter(splat=splat)
    return None if near.is_empty() else (statistics.mean(near["psnr"]), statistics.mean(near["ssim"]))


def stealth(study: StudyConfig, seen: StudyRows) -> dict[str, Any] | None:
    """How well an attack hides that it hides, from the meridians' cameras inside its trigger; None without any.

    `surroundings_psnr`: mean PSNR beside the object against true pictures of the scene as it is; `..._drop`: what the
    cloaked splats lose against the clean ones. `appearance_psnr`: on the object, against what the attacker wants to be
    seen. `stealthy`: whether the drop is at most `STEALTHY`.
    """
    if setup.hiding(study) is None:
        return None
    deep = pl.col(depth_of(study)) >= 0
    inside = {NAMES[splat]: seen.transition.filter(deep, splat=splat) for splat in NAMES}
    if any(blends.is_empty() for blends in inside.values()):
        return None

    def means(column: str) -> dict[str, float]:
        return {which: statistics.mean(blends[column]) for which, blends in inside.items()}

    beside = means("surroundings_psnr")
    drop = beside[CLEAN] - beside[CLOAKED]
    return {
        "surroundings_psnr": beside,
        "surroundings_psnr_drop": drop,
        "appearance_psnr": means("appearance_psnr"),
        "stealthy": drop <= STEALTHY,
    }


def figures(study: StudyConfig, seen: StudyRows) -> dict[str, Any]:
    """Everything that a study found, as JSON can hold it; rates are of all seeds and detectors together.

    Intervals are resampled over blocks of neighbouring cameras and seeds (`attacks.observe.rates`). All seeds share
    object and light, so that what another object would give is in none of them.
    """
    band = transition(study, seen)
    near = {name: fidelity(seen, splat) for splat, name in NAMES.items()}
    clean, cloaked = near[CLEAN], near[CLOAKED]
    detectors = study.evaluation.detectors
    by_seed = rates(study, seen.rows, ("seed", "detector"))
    bands = by_elevation(study, seen.rows)
    return {
        **_all(rates(study, seen.rows)[()]),
        "benign_psnr_drop": None if clean is None or cloaked is None else clean[0] - cloaked[0],
        "benign_psnr": {which: value and value[0] for which, value in near.items()},
        "benign_ssim": {which: value and value[1] for which, value in near.items()},
        "transition_degrees": None if band is None else band.width,
        "transition": band and {"from": band.start, "to": band.end, "meridians": meridians(study, seen)},
        "stealth": stealth(study, seen),
        "gaussians": {which: list(numbers) for which, numbers in seen.gaussians.items()},
        "gaussians_ratio": sum(seen.gaussians[CLOAKED]) / max(sum(seen.gaussians[CLEAN]), 1),
        "by_detector": _by_detector(rates(study, seen.rows, ("detector",)), detectors),
        "by_seed": {
            str(seed): _by_detector(
                {group[1:]: counts for group, counts in by_seed.items() if group[0] == seed}, detectors
            )
            for seed in study.seeds
        },
        "by_attack": {
            attack.name: _by_detector(rates(study, seen.rows, ("detector",), attack=attack.name), detectors)
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


def _by_detector(counted: Mapping[tuple[Any, ...], Rates], detectors: Sequence[str]) -> dict[str, Any]:
    return {name: _all(counted[name,]) for name in detectors}


def _all(rates: Rates) -> dict[str, Any]:
    """Rates as JSON can hold them."""
    return {name: None if rate is None else rate.as_dict() for name, rate in rates.items()}
