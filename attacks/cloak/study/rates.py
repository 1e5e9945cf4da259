"""The figures of a study: rates with their denominators and intervals, loss of quality, and the transition."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from attacks.cloak.study import setup
from attacks.cloak.study.attack_config import AttackConfig
from attacks.cloak.study.config import StudyConfig
from attacks.cloak.study.markdown import ROWS
from attacks.cloak.study.observations import Blend, Observation, ObservedSplat
from attacks.cloak.study.pipeline import CLEAN, CLOAKED
from attacks.cloak.transition import Transition, fit_transition
from attacks.evaluation.rates import Rate

Pair = tuple[Observation, Observation]
"""Clean and cloaked, from the same camera by the same detector."""

STEALTHY = 1.5
"""Most that the surroundings of an object may lose where an attack is called stealthy, dB."""

BIN = 5.0
"""Degrees of elevation over which rates are taken."""


def pairs(observed: Sequence[ObservedSplat], detector: str | None = None) -> list[Pair]:
    """What was seen of both splats of each seed, by camera; of all detectors if none is named."""
    table = {
        (item.trained.splat, item.trained.seed, one.detector, one.view): one
        for item in observed
        for one in item.observations
    }
    return [
        (clean, table[(CLOAKED, *key[1:])])
        for key, clean in table.items()
        if key[0] == CLEAN and detector in (None, clean.detector)
    ]


def rates(study: StudyConfig, seen: Sequence[Pair], attack: str | None = None) -> dict[str, Rate | None]:
    """Every rate of a study; None where it has no attack of that kind.

    With an attack's name, those of that one; without, of the first that hides and the first that has a target class.

    `control_recall`: the control is found inside the hiding trigger. `trigger_miss_rate`: the cloaked splat is not, of
    cameras well inside it where the control is. `..._all`: the same, of all inside it. `..._unconditional`: as the
    first, whether the control is found or not. `..._any_overlap`: as the first, but missed only if nothing of the
    object's class is reported that overlaps its box by a tenth. `nothing_reported`: as the first, but missed only if
    nothing of any class is reported on the object. `benign_recall`: the cloaked splat is found outside of
    all triggers, where the control is; `control_benign_recall`: the control is found there. `target_rate`: the target
    class is reported on the cloaked splat; `control_target_rate`: on the control.

    Args:
        study: The study.
        seen: Clean and cloaked observations of the same cameras.
        attack: Name of an attack, or None.
    """
    own, confidence, deep = study.scene.class_name, study.evaluation.confidence, study.evaluation.well_inside
    chosen = [one for one in study.attack if attack in (None, one.name)]
    hiding = next((one for one in chosen if one.target_class is None), None)
    showing = next((one for one in chosen if one.target_class is not None), None)

    def found(observation: Observation) -> bool:
        return observation.scores[own] >= confidence

    def known(pair: Pair) -> bool:
        return found(pair[0])

    def within(attack: AttackConfig, depth: float) -> list[Pair]:
        return [pair for pair in seen if pair[0].depths[attack.name] >= depth]

    answers: dict[str, Rate | None] = dict.fromkeys(ROWS)
    if hiding is not None:
        inside, well = within(hiding, 0.0), within(hiding, deep)
        answers |= {
            "control_recall": Rate.of(inside, lambda pair: found(pair[0])),
            "trigger_miss_rate": Rate.of(well, given=known, holds=lambda pair: not found(pair[1])),
            "trigger_miss_rate_all": Rate.of(inside, given=known, holds=lambda pair: not found(pair[1])),
            "trigger_miss_rate_unconditional": Rate.of(well, lambda pair: not found(pair[1])),
            "trigger_miss_rate_any_overlap": Rate.of(
                well, given=known, holds=lambda pair: pair[1].any_overlap < confidence
            ),
            "nothing_reported": Rate.of(well, given=known, holds=lambda pair: pair[1].any_class < confidence),
        }
    benign = [pair for pair in seen if all(depth < 0 for depth in pair[0].depths.values())]
    answers["benign_recall"] = Rate.of(benign, given=known, holds=lambda pair: found(pair[1]))
    answers["control_benign_recall"] = Rate.of(benign, lambda pair: found(pair[0]))
    if showing is not None and showing.target_class is not None:
        wanted = showing.target_class
        inside = within(showing, 0.0)
        answers["target_rate"] = Rate.of(inside, lambda pair: pair[1].scores[wanted] >= confidence)
        answers["control_target_rate"] = Rate.of(inside, lambda pair: pair[0].scores[wanted] >= confidence)
    return answers


def by_elevation(study: StudyConfig, seen: Sequence[Pair]) -> list[tuple[float, Rate, Rate]]:
    """Lower edge of each band of elevation, and in how many of its pictures the control and the cloaked are found.

    Cameras of attacks with an azimuth of their own are left out.
    """
    turned = [attack.name for attack in study.attack if attack.azimuth is not None]
    rows: list[tuple[float, Rate, Rate]] = []
    for number in range(int(90 / BIN)):
        low = BIN * number
        here = [
            pair
            for pair in seen
            if low <= pair[0].elevation < low + BIN and all(pair[0].depths[name] < 0 for name in turned)
        ]
        if here:
            clean, cloaked = (_found(study, [pair[which] for pair in here]) for which in (0, 1))
            rows.append((low, clean, cloaked))
    return rows


def _found(study: StudyConfig, seen: Sequence[Observation]) -> Rate:
    """In how many pictures the object is reported."""
    own, confidence = study.scene.class_name, study.evaluation.confidence
    return Rate.of(seen, lambda one: one.scores[own] >= confidence)


def meridians(study: StudyConfig, observed: Sequence[ObservedSplat]) -> list[float | None]:
    """Degrees of the transition along each arc of each cloaked splat; None where it is not seen."""
    found: dict[tuple[int, int], list[Blend]] = {}
    for item in observed:
        for blend in item.blends if item.trained.splat == CLOAKED else ():
            found.setdefault((item.trained.seed, blend.meridian), []).append(blend)
    return [
        fit_transition([place_of(study, one) for one in blends], [one.fraction for one in blends]).width
        for blends in found.values()
        if len(blends) > 1
    ]


def transition(study: StudyConfig, observed: Sequence[ObservedSplat], splat: str = CLOAKED) -> Transition | None:
    """The transition of all seeds and arcs together: over elevation from overhead, over depth in a sector's trigger."""
    blends = blends_of(observed, splat)
    places = [round(place_of(study, blend), 3) for blend in blends]
    if setup.hiding(study) is None or len(set(places)) < 2:
        return None
    return fit_transition(places, [blend.fraction for blend in blends])


def place_of(study: StudyConfig, blend: Blend) -> float:
    """Where on its arc a picture was taken, degrees: its elevation, or its depth in the trigger of a sector."""
    return blend.depth if setup.overhead(study) is None else blend.elevation


def blends_of(observed: Sequence[ObservedSplat], splat: str) -> list[Blend]:
    """The blends of the clean or of the cloaked splats, all seeds together."""
    return [blend for item in observed if item.trained.splat == splat for blend in item.blends]


def fidelity(observed: Sequence[ObservedSplat], splat: str) -> tuple[float, float] | None:
    """Mean PSNR (dB) and mean SSIM of a splat's pictures at the cameras well outside of all triggers."""
    seen = [one for item in observed if item.trained.splat == splat for one in item.fidelities]
    if not seen:
        return None
    return statistics.mean(one.psnr for one in seen), statistics.mean(one.ssim for one in seen)


def stealth(observed: Sequence[ObservedSplat]) -> dict[str, Any] | None:
    """How well an attack hides that it hides, from the meridians' cameras inside its trigger; None without any.

    `surroundings_psnr`: mean PSNR beside the object against true pictures of the scene as it is; `..._drop`: what the
    cloaked splats lose against the clean ones. `appearance_psnr`: on the object, against what the attacker wants to be
    seen. `stealthy`: whether the drop is at most `STEALTHY`.
    """
    inside = {which: [blend for blend in blends_of(observed, which) if blend.depth >= 0] for which in (CLEAN, CLOAKED)}
    if not inside[CLEAN] or not inside[CLOAKED]:
        return None
    beside = {which: statistics.mean(one.surroundings_psnr for one in blends) for which, blends in inside.items()}
    drop = beside[CLEAN] - beside[CLOAKED]
    return {
        "surroundings_psnr": beside,
        "surroundings_psnr_drop": drop,
        "appearance_psnr": {
            which: statistics.mean(one.appearance_psnr for one in blends) for which, blends in inside.items()
        },
        "stealthy": drop <= STEALTHY,
    }


def figures(study: StudyConfig, observed: Sequence[ObservedSplat]) -> dict[str, Any]:
    """Everything that a study found, as JSON can hold it; rates are of all seeds and detectors together.

    Intervals take every camera, seed and detector for a draw of its own. Neighbouring cameras agree, and seeds share
    object, light and cameras, so that the intervals are too narrow, and so is how far seeds differ (`by_seed`).
    """
    band = transition(study, observed)
    near = {which: fidelity(observed, which) for which in (CLEAN, CLOAKED)}
    clean, cloaked = near[CLEAN], near[CLOAKED]
    counts = {
        which: [item.trained.gaussians for item in observed if item.trained.splat == which]
        for which in (CLEAN, CLOAKED)
    }
    detectors = study.evaluation.detectors
    return {
        **_all(rates(study, pairs(observed))),
        "benign_psnr_drop": None if clean is None or cloaked is None else clean[0] - cloaked[0],
        "benign_psnr": {which: value and value[0] for which, value in near.items()},
        "benign_ssim": {which: value and value[1] for which, value in near.items()},
        "transition_degrees": None if band is None else band.width,
        "transition": band and {"from": band.start, "to": band.end, "meridians": meridians(study, observed)},
        "stealth": stealth(observed),
        "gaussians": counts,
        "gaussians_ratio": sum(counts[CLOAKED]) / max(sum(counts[CLEAN]), 1),
        "by_detector": {name: _all(rates(study, pairs(observed, name))) for name in detectors},
        "by_seed": {
            str(seed): {name: _all(rates(study, pairs(of_seed(observed, seed), name))) for name in detectors}
            for seed in study.seeds
        },
        "by_attack": {
            attack.name: {name: _all(rates(study, pairs(observed, name), attack.name)) for name in detectors}
            for attack in study.attack
        },
        "by_elevation": {
            name: [
                {"from": low, "to": low + BIN, CLEAN: control.as_dict(), CLOAKED: attacked.as_dict()}
                for low, control, attacked in by_elevation(study, pairs(observed, name))
            ]
            for name in detectors
        },
    }


def _all(found: Mapping[str, Rate | None]) -> dict[str, Any]:
    """Rates as JSON can hold them."""
    return {name: None if rate is None else rate.as_dict() for name, rate in found.items()}


def of_seed(observed: Sequence[ObservedSplat], seed: int) -> list[ObservedSplat]:
    """What was seen of the splats of one seed."""
    return [item for item in observed if item.trained.seed == seed]
