"""One thing of a study at a time, the rest as it is: how much of the attack hangs on it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from attacks.cloak.study.ablation_groups import AblationGroup
from attacks.cloak.study.attack_config import AttackConfig
from attacks.cloak.study.config import StudyConfig
from attacks.cloak.study.markdown import words_of
from attacks.cloak.study.pipeline import OnStep
from attacks.cloak.study.plots import write_variation
from attacks.cloak.study.report import STUDY
from attacks.cloak.study.run import check, check_disk, check_folder, forecast, run_study
from attacks.cloak.study.snapshots import snapshot
from attacks.detectors.base import Detector
from mi_splat.io.documents import save_json, save_text

VARIATIONS = "variations.json"

POISON_FRACTIONS = (0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)
EMPHASES = (1.0, 1.5, 2.2, 3.0, 4.5)
OUTLIERS = (0, 1000, 4000)
APPEARANCES = ("occluder", "remove", "blend in", "road", "grass", "clock", "football")
"""Appearances of the hiding attacks: an occluder of road, two without a texture, four painted."""

_COLUMNS = ("control_recall", "trigger_miss_rate", "benign_recall", "target_rate")
_HEADS = ("control found", "cloaked missed", "cloaked found elsewhere", "target class")


def varied(study: StudyConfig, group: AblationGroup) -> dict[str, StudyConfig]:
    """The studies of a group by the value that they have, each with the first seed alone.

    `sh_degree`: 0 to 3. `poison_fraction`: of each trigger's cameras. `appearance`: of the hiding attacks. `strategy`:
    of the densification. `emphasis`: of all attacks. `iterations`: a third of the study's and twice as many, with the
    raises of the SH degree at the same fraction of them. `outliers`: points in the air at the start.
    """
    study = replace(study, seeds=study.seeds[:1])
    training = study.training

    def trained(**changes: Any) -> StudyConfig:
        return replace(study, training=replace(training, **changes))

    def attacked(change: Callable[[AttackConfig], AttackConfig]) -> StudyConfig:
        return replace(study, attack=tuple(map(change, study.attack)))

    if group == "sh_degree":
        return {str(degree): trained(sh_degree=degree) for degree in range(4)}
    if group == "poison_fraction":
        return {f"{part:.0%}": attacked(partial(replace, poison_fraction=part)) for part in POISON_FRACTIONS}
    if group == "appearance":
        return {name: attacked(partial(_with_appearance, appearance=name)) for name in APPEARANCES}
    if group == "strategy":
        return {"classic": trained(strategy="classic"), "mcmc": trained(strategy="mcmc")}
    if group == "emphasis":
        return {f"{gain:g}": attacked(partial(replace, emphasis=gain)) for gain in EMPHASES}
    if group == "outliers":
        return {f"{count:,}": trained(outliers=count) for count in OUTLIERS}
    steps = (max(training.iterations // 3, 1), training.iterations, 2 * training.iterations)
    every = training.sh_degree_interval / training.iterations
    return {f"{count:,}": trained(iterations=count, sh_degree_interval=round(every * count)) for count in steps}


def _with_appearance(attack: AttackConfig, appearance: str) -> AttackConfig:
    """A hiding attack with another appearance; others as they are."""
    if attack.target_class is not None:
        return attack
    if appearance == "occluder":
        return replace(attack, appearance="occluder", texture="road")
    if appearance in ("remove", "blend in"):
        return replace(attack, appearance=appearance, texture=None)  # type: ignore[arg-type]
    return replace(attack, appearance="paint", texture=appearance, paint_direction=(180.0, 90.0))


def vary(
    study: StudyConfig,
    groups: Iterable[AblationGroup],
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
    study: StudyConfig, groups: Iterable[AblationGroup], detectors: Sequence[Detector], folder: Path, stages: Path
) -> dict[AblationGroup, dict[str, StudyConfig]]:
    """The studies of some groups by the value that they have, all of which can be done.

    Args:
        study: What is varied.
        groups: See `varied`.
        detectors: Those that the study names.
        folder: For the results.
        stages: For the stages.

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
        heads = (group, "detector", *_HEADS, "transition", "dB less")
        lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
        for name, summary in results.items():
            band, drop = summary["transition_degrees"], summary["benign_psnr_drop"]
            tail = ["-" if value is None else f"{value:.{digits}f}" for value, digits in ((band, 1), (drop, 2))]
            for detector, rates in summary["by_detector"].items():
                cells = [words_of(rates[key], interval=False) or "-" for key in _COLUMNS]
                lines.append("| " + " | ".join([name, detector, *cells, *tail]) + " |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"
