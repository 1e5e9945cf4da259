"""The figures of a study: rates with their denominators and intervals, loss of quality, and the fade-in band."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from attacks.cloak.study.config import Attack, Study
from attacks.cloak.study.markdown import ROWS
from attacks.cloak.study.observations import Looks, Shade, Sighting, overhead
from attacks.cloak.study.pipeline import CLEAN, CLOAKED
from attacks.cloak.transition import FadeBand, fade_band
from attacks.evaluation.rates import Rate

Pair = tuple[Sighting, Sighting]
"""Clean and cloaked, from the same camera by the same detector."""

BIN = 5.0
"""Degrees of elevation over which rates are taken."""


def pairs(looks: Sequence[Looks], detector: str | None = None) -> list[Pair]:
    """What was seen of both splats of each seed, by camera; of all detectors if none is named."""
    table = {(s.splat, s.seed, s.detector, s.view): s for look in looks for s in look.sightings}
    return [
        (clean, table[(CLOAKED, *key[1:])])
        for key, clean in table.items()
        if key[0] == CLEAN and detector in (None, clean.detector)
    ]


def rates(study: Study, seen: Sequence[Pair], attack: str | None = None) -> dict[str, Rate | None]:
    """Every rate of a study; None where it has no attack of that kind.

    With an attack's name, those of that one; without, of the first that hides and the first that wants a class.

    `clean_overhead_recall`: the control is found inside the hiding trigger. `cloaked_overhead_miss`: the cloaked splat
    is not, of cameras well inside it where the control is. `..._everywhere`: the same, of all inside it.
    `..._unconditional`: the same, whether the control is found or not. `..._loose`: as the first, but missed only if
    nothing of the object's class is reported that overlaps its box by a tenth. `benign_recall`: the cloaked splat is
    found outside of all triggers, where the control is. `rear_stop_sign`: the class wanted is reported on the cloaked
    splat; `clean_rear_stop_sign`: on the control.
    """
    own, least, deep = study.scene.called, study.looking.confidence, study.looking.inside
    chosen = [one for one in study.attack if attack in (None, one.name)]
    hiding = next((one for one in chosen if one.wants is None), None)
    showing = next((one for one in chosen if one.wants is not None), None)

    def found(sighting: Sighting) -> bool:
        return sighting.scores[own] >= least

    def within(attack: Attack, depth: float) -> list[Pair]:
        return [pair for pair in seen if pair[0].depths[attack.name] >= depth]

    answers: dict[str, Rate | None] = dict.fromkeys(ROWS)
    if hiding is not None:
        inside, well = within(hiding, 0.0), within(hiding, deep)
        answers |= {
            "clean_overhead_recall": _rate(inside, lambda pair: found(pair[0])),
            "cloaked_overhead_miss": _rate(_known(well, found), lambda pair: not found(pair[1])),
            "cloaked_overhead_miss_everywhere": _rate(_known(inside, found), lambda pair: not found(pair[1])),
            "cloaked_overhead_miss_unconditional": _rate(well, lambda pair: not found(pair[1])),
            "cloaked_overhead_miss_loose": _rate(_known(well, found), lambda pair: pair[1].loose < least),
        }
    benign = [pair for pair in seen if all(depth < 0 for depth in pair[0].depths.values())]
    answers["benign_recall"] = _rate(_known(benign, found), lambda pair: found(pair[1]))
    answers["clean_benign_recall"] = _rate(benign, lambda pair: found(pair[0]))
    if showing is not None and showing.wants is not None:
        wanted = showing.wants
        inside = within(showing, 0.0)
        answers["rear_stop_sign"] = _rate(inside, lambda pair: pair[1].scores[wanted] >= least)
        answers["clean_rear_stop_sign"] = _rate(inside, lambda pair: pair[0].scores[wanted] >= least)
    return answers


def _known(seen: Iterable[Pair], found: Callable[[Sighting], bool]) -> list[Pair]:
    """Pairs in which the control is found."""
    return [pair for pair in seen if found(pair[0])]


def _rate(seen: Sequence[Pair], holds: Callable[[Pair], bool]) -> Rate:
    return Rate(successes=sum(map(holds, seen)), total=len(seen))


def by_elevation(study: Study, seen: Sequence[Pair]) -> list[tuple[float, Rate, Rate]]:
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


def _found(study: Study, seen: Sequence[Sighting]) -> Rate:
    """In how many pictures the object is reported."""
    own, least = study.scene.called, study.looking.confidence
    return Rate(successes=sum(one.scores[own] >= least for one in seen), total=len(seen))


def meridians(looks: Sequence[Looks]) -> list[float | None]:
    """Degrees of the fade-in band along each meridian of each cloaked splat; None where it is not seen."""
    arcs: dict[tuple[int, int], list[Shade]] = {}
    for shade in (shade for look in looks for shade in look.shades if shade.splat == CLOAKED):
        arcs.setdefault((shade.seed, shade.arc), []).append(shade)
    bands = [
        fade_band([one.elevation for one in arc], [one.share for one in arc]) for arc in arcs.values() if len(arc) > 1
    ]
    return [band.width for band in bands]


def fade(study: Study, looks: Sequence[Looks], splat: str = CLOAKED) -> FadeBand | None:
    """The fade-in band over elevation, of all seeds and meridians together."""
    shades = [shade for look in looks for shade in look.shades if shade.splat == splat]
    if overhead(study) is None or len({shade.elevation for shade in shades}) < 2:
        return None
    return fade_band([round(shade.elevation, 3) for shade in shades], [shade.share for shade in shades])


def likeness(looks: Sequence[Looks], splat: str) -> tuple[float, float] | None:
    """Mean PSNR (dB) and mean SSIM of a splat's pictures at the cameras well outside of all triggers."""
    seen = [one for look in looks for one in look.likenesses if one.splat == splat]
    if not seen:
        return None
    return statistics.mean(one.psnr for one in seen), statistics.mean(one.ssim for one in seen)


def as_json(rate: Rate | None) -> dict[str, Any] | None:
    """A rate with numerator, denominator and 95 % Wilson interval."""
    if rate is None:
        return None
    return {
        "rate": rate.share if rate.total else None,
        "successes": rate.successes,
        "total": rate.total,
        "interval": list(rate.interval),
    }


def figures(study: Study, looks: Sequence[Looks]) -> dict[str, Any]:
    """Everything that a study found, as JSON can hold it; rates are of all seeds and detectors together.

    Intervals take every camera, seed and detector for a draw of its own. Seeds share cameras and pictures, so that how
    far they differ (`by_seed`) says more than an interval over all of them.
    """
    band = fade(study, looks)
    near = {which: likeness(looks, which) for which in (CLEAN, CLOAKED)}
    clean, cloaked = near[CLEAN], near[CLOAKED]
    counts = {
        which: [look.trained.gaussians for look in looks if look.trained.splat == which] for which in (CLEAN, CLOAKED)
    }
    detectors = study.looking.detectors
    return {
        **_all(rates(study, pairs(looks))),
        "benign_psnr_drop": None if clean is None or cloaked is None else clean[0] - cloaked[0],
        "benign_psnr": {which: value and value[0] for which, value in near.items()},
        "benign_ssim": {which: value and value[1] for which, value in near.items()},
        "fade_in_degrees": None if band is None else band.width,
        "fade_in": None if band is None else {"from": band.start, "to": band.end, "meridians": meridians(looks)},
        "gaussians": counts,
        "gaussians_ratio": sum(counts[CLOAKED]) / max(sum(counts[CLEAN]), 1),
        "by_detector": {name: _all(rates(study, pairs(looks, name))) for name in detectors},
        "by_seed": {
            str(seed): {name: _all(rates(study, pairs(of_seed(looks, seed), name))) for name in detectors}
            for seed in study.seeds
        },
        "by_attack": {
            attack.name: {name: _all(rates(study, pairs(looks, name), attack.name)) for name in detectors}
            for attack in study.attack
        },
        "by_elevation": {
            name: [
                {"from": low, "to": low + BIN, CLEAN: as_json(control), CLOAKED: as_json(attacked)}
                for low, control, attacked in by_elevation(study, pairs(looks, name))
            ]
            for name in detectors
        },
    }


def _all(found: Mapping[str, Rate | None]) -> dict[str, Any]:
    """Rates as JSON can hold them."""
    return {name: as_json(rate) for name, rate in found.items()}


def of_seed(looks: Sequence[Looks], seed: int) -> list[Looks]:
    """What was seen of the splats of one seed."""
    return [look for look in looks if look.trained.seed == seed]
