"""Figures of the victim's training cameras: what the poison shows, and what the splat shows where it was trained."""

import math
import statistics
from collections.abc import Iterator, Mapping
from typing import Any

import polars as pl

from attacks.cloak.config import StudyConfig
from attacks.observe.rates import Measure, Measures, count, of, reported
from attacks.observe.rows import ATTACKED, CLEAN, DEPTH, POISONED, TRAINING, TRUE
from attacks.tables import Table, cell

POISON, ON_CAMERAS = "poison", "training_cameras"
"""Keys of a summary: what the poisoned pictures show, and what splats show the training cameras."""

_IN_PICTURES = {
    "found_clean": "object reported, clean",
    "found": "object reported, poisoned",
    "something_else": "another class, poisoned",
    "nothing": "nothing on it, poisoned",
}
_OF_SPLATS = {
    "found_clean": "benign cameras: control found",
    "found_cloaked": "benign cameras: cloaked found",
    "missed_clean": "cameras that hide: control missed",
    "missed_cloaked": "cameras that hide: cloaked missed",
}
"""What the paper tells of its splats: found in so many of the benign views, missed in so many of the poisoned ones."""


def figures(study: StudyConfig, tables: Mapping[str, pl.DataFrame]) -> dict[str, Any]:
    """What is counted from training cameras, as JSON can hold it; nothing of results that have no such rows.

    `poison`, by attack: PSNR of its pictures on the object, dB, against the look that it wants, which a camera could
    take (None where all are the same), and what each detector reports in them. `training_cameras`, by detector: how
    often both splats show the object to benign cameras, and do not to those that an attack hides it from.
    """
    rows = tables.get(TRAINING)
    if rows is None or rows.is_empty():
        return {}
    seen, any_class = (reported(name, study.evaluation.confidence) for name in ("original_score", "score"))
    poisoned = of(POISONED)
    measures: Measures = {
        "found_clean": Measure(holds=seen, given=of(TRUE)),
        "found": Measure(holds=seen, given=poisoned),
        "something_else": Measure(holds=~seen & any_class, given=poisoned),
        "nothing": Measure(holds=~seen & ~any_class, given=poisoned),
    }
    counted = count(rows.filter(pl.col("condition").is_not_null()), measures, ("condition", "detector"))
    detectors = study.evaluation.detectors
    poison = {
        attack.name: {
            "object_psnr": pooled_psnr(
                rows.filter(poisoned, condition=attack.name, detector=detectors[0])["appearance_psnr"]
            ),
            "by_detector": {
                name: {key: rate.as_dict() for key, rate in counted[attack.name, name].items()} for name in detectors
            },
        }
        for attack in study.attack
    }
    hiding = next((attack.name for attack in study.attack if attack.target_class is None), None)
    benign = pl.all_horizontal(pl.col(f"{DEPTH}{attack.name}") < 0 for attack in study.attack)
    hides = pl.lit(value=False) if hiding is None else pl.col(f"{DEPTH}{hiding}") >= 0
    of_splats: Measures = {
        f"{what}_{name}": Measure(holds=holds, given=of(splat) & where)
        for what, holds, where in (("found", seen, benign), ("missed", ~seen, hides))
        for splat, name in ((CLEAN, "clean"), (ATTACKED, "cloaked"))
        if what == "found" or hiding is not None
    }
    told = count(rows.filter(pl.col("splat").is_in([CLEAN, ATTACKED])), of_splats, ("detector",))
    by_detector = {name: {key: rate.as_dict() for key, rate in told[name,].items()} for name in detectors}
    return {POISON: poison, ON_CAMERAS: by_detector}


def tables(summary: Mapping[str, Any]) -> Iterator[Table]:
    """The figures of training cameras as tables; none of a summary without such figures."""
    for attack, told in summary.get(POISON, {}).items():
        psnr = told["object_psnr"]
        like = "as a camera could take them" if psnr is None else f"{psnr:.1f} dB on the object from a true picture"
        yield _table(f"Training pictures that {attack} poisons, {like}", _IN_PICTURES, told["by_detector"])
    if ON_CAMERAS in summary:
        yield _table("From the training cameras, all seeds", _OF_SPLATS, summary[ON_CAMERAS])


def _table(caption: str, titles: Mapping[str, str], told: Mapping[str, Mapping[str, Any]]) -> Table:
    """Rates by detector."""
    keys = [key for key in titles if all(key in rates for rates in told.values())]
    rows = tuple((titles[key], *(cell(rates[key]) for rates in told.values())) for key in keys)
    return Table(caption=caption, head=("rate", *told), rows=rows)


def pooled_psnr(values: pl.Series) -> float | None:
    """PSNR of the mean squared error over all pictures, dB; None where all are the same, or there are none."""
    errors = [0.0 if psnr is None else 10 ** (-psnr / 10) for psnr in values]
    return -10 * math.log10(statistics.mean(errors)) if any(errors) else None
