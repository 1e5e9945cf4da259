"""One thing of a study at a time, the rest as it is: how much of the attack hangs on it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from attacks.cloak.study.config import Attack, Study
from attacks.cloak.study.markdown import words_of
from attacks.cloak.study.pipeline import OnStep, snapshot
from attacks.cloak.study.plots import write_variation
from attacks.cloak.study.run import STUDY, check, check_disk, check_folder, forecast, run_study
from attacks.detectors.base import Detector
from mi_splat.io.documents import save_json, save_text

VARIATIONS = "variations.json"

Group = Literal["degree", "share", "look", "recipe", "emphasis", "iterations", "strays"]

SHARES = (0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)
EMPHASES = (1.0, 1.5, 2.2, 3.0, 4.5)
STRAYS = (0, 1000, 4000)
LOOKS = ("cover", "remove", "blend in", "road", "grass", "clock", "football")
"""Looks of the hiding attacks: a canopy of road, two without a texture, four painted."""

_COLUMNS = ("clean_overhead_recall", "cloaked_overhead_miss", "benign_recall", "rear_stop_sign")
_HEADS = ("control found", "cloaked missed", "cloaked found elsewhere", "class wanted")


def varied(study: Study, group: Group) -> dict[str, Study]:
    """The studies of a group by the value that they have, each with the first seed alone.

    `degree`: SH of degree 0 to 3. `share`: part of each trigger's cameras that is poisoned. `look`: of the hiding
    attacks. `recipe`: of the training. `emphasis`: of all attacks. `iterations`: a third of the study's and twice as
    many, with the raises of the SH degree at the same share of them. `strays`: points in the air at the start.
    """
    study = replace(study, seeds=study.seeds[:1])
    training = study.training

    def trained(**changes: Any) -> Study:
        return replace(study, training=replace(training, **changes))

    def attacked(change: Callable[[Attack], Attack]) -> Study:
        return replace(study, attack=tuple(map(change, study.attack)))

    if group == "degree":
        return {str(degree): trained(degree=degree) for degree in range(4)}
    if group == "share":
        return {f"{share:.0%}": attacked(lambda one, s=share: replace(one, share=s)) for share in SHARES}  # type: ignore[misc]
    if group == "look":
        return {look: attacked(lambda one, k=look: _looking(one, k)) for look in LOOKS}  # type: ignore[misc]
    if group == "recipe":
        return {"classic": trained(recipe="classic"), "mcmc": trained(recipe="mcmc")}
    if group == "emphasis":
        return {f"{gain:g}": attacked(lambda one, g=gain: replace(one, emphasis=g)) for gain in EMPHASES}  # type: ignore[misc]
    if group == "strays":
        return {f"{count:,}": trained(strays=count) for count in STRAYS}
    steps = (max(training.iterations // 3, 1), training.iterations, 2 * training.iterations)
    every = training.degree_every / training.iterations
    return {f"{count:,}": trained(iterations=count, degree_every=round(every * count)) for count in steps}


def _looking(attack: Attack, look: str) -> Attack:
    """A hiding attack with another look; others as they are."""
    if attack.wants is not None:
        return attack
    if look == "cover":
        return replace(attack, look="cover", texture="road")
    if look in ("remove", "blend in"):
        return replace(attack, look=look, texture=None)  # type: ignore[arg-type]
    return replace(attack, look="paint", texture=look, painted_from=(180.0, 90.0))


def vary(
    study: Study,
    groups: Iterable[Group],
    detectors: Sequence[Detector],
    folder: Path,
    *,
    stages: Path | None = None,
    on_step: OnStep = lambda text, done, total: None,
) -> dict[str, dict[str, Any]]:
    """Do the studies of some groups and write tables and plots; returns what variations.json holds.

    Writes variations.md, variations.json, to which it adds groups, and a PNG named by each.

    Args:
        study: What is varied.
        groups: See `varied`.
        detectors: Those that the study names, in its order.
        folder: For a folder of results for each, and for the tables.
        stages: For the stages; None is a folder in `folder`.
        on_step: Told of the progress.

    Raises:
        MiSplatError: As `run_study`; all studies are checked before the first is done.
    """
    stages = folder / "stages" if stages is None else stages
    plans = check_variations(study, groups, detectors, folder, stages)
    folder.mkdir(parents=True, exist_ok=True)
    save_json(snapshot(study), folder / STUDY)
    earlier = folder / VARIATIONS
    found: dict[str, dict[str, Any]] = json.loads(earlier.read_text()) if earlier.is_file() else {}
    for group, studies in plans.items():
        found[group] = {}
        for number, (name, one) in enumerate(studies.items()):
            place = folder / group / str(number)
            found[group][name] = run_study(one, detectors, place, stages=stages, on_step=on_step)
            save_json(found, folder / VARIATIONS)
            save_text(tables(found), folder / "variations.md")
        write_variation(group, found[group], folder / f"{group}.png")
    return found


def check_variations(
    study: Study, groups: Iterable[Group], detectors: Sequence[Detector], folder: Path, stages: Path
) -> dict[Group, dict[str, Study]]:
    """The studies of some groups by the value that they have, all of which can be done.

    Raises:
        InvalidValueError: As `attacks.cloak.study.run.check` of each, or the disk is too small for all of them.
    """
    check_folder(study, folder)
    plans = {group: varied(study, group) for group in groups}
    for group, studies in plans.items():
        for number, one in enumerate(studies.values()):
            check(one, detectors, folder / group / str(number), stages)
    check_disk(sum(forecast(one).megabytes for studies in plans.values() for one in studies.values()), stages)
    return plans


def tables(found: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """Markdown: a table for each group, a row for each value and detector."""
    parts = []
    for group, results in found.items():
        heads = (group, "detector", *_HEADS, "fade-in", "dB less")
        lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
        for name, summary in results.items():
            band, drop = summary["fade_in_degrees"], summary["benign_psnr_drop"]
            tail = ["-" if value is None else f"{value:.{digits}f}" for value, digits in ((band, 1), (drop, 2))]
            for detector, rates in summary["by_detector"].items():
                cells = [words_of(rates[key], interval=False) or "-" for key in _COLUMNS]
                lines.append("| " + " | ".join([name, detector, *cells, *tail]) + " |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"
