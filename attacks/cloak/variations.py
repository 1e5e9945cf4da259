"""One thing of a study at a time, the rest as it is: how much of the attack hangs on it, as tables and plots."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from attacks.cloak.config import AttackConfig, CleaningConfig, StudyConfig
from attacks.cloak.plots import new_axes, save_figure
from attacks.cloak.rates import spread_of, words_of
from attacks.cloak.setup import target_of
from attacks.cloak.steps import OnStep
from attacks.cloak.study import STUDY, check, check_disk, check_folder, detectors_of, forecast, run_study
from attacks.detectors.base import Detector
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import check_choice
from mi_splat.io.documents import save_json, save_text
from mi_splat.io.locks import locked_folder
from mi_splat.io.parsing import read_json

RATES = {
    "control_recall": "control found",
    "trigger_miss_rate": "cloaked missed",
    "nothing_reported": "nothing of any class reported",
    "benign_recall": "cloaked found elsewhere",
    "target_rate": "target class",
}
"""Rates of a summary that a table has, and their heads."""
_COSTS = (
    *("seeds", "transition, degrees", "clean far from the triggers, dB", "dB lost there"),
    *("dB lost beside the object", "stealthy", "Gaussians, clean", "Gaussians, cloaked"),
)


MANY = 7
"""Values of a variation: with more of them there is room for their names alone."""
_VARIED = (
    ("trigger_miss_rate", "missed inside", "#d62728"),
    ("nothing_reported", "nothing of any class reported inside", "#9467bd"),
    ("benign_recall", "found elsewhere", "#1f77b4"),
    ("target_rate", "target class reported", "#2ca02c"),
)
"""What is drawn over the values of a variation."""


def tables(found: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """Markdown: for each group a table of rates, and one of what is lost.

    Rates are pooled over seeds, as a summary has them: a row for each value and detector. Losses, and the numbers of
    Gaussians, are means over the seeds; the transition is that of all seeds together: a row for each value.

    Args:
        found: By group and value, the summary of each study.
    """
    parts = []
    for group, results in found.items():
        rates = [
            (name, detector, *(words_of(one.get(key)) + spread_of(summary, detector, key) or "-" for key in RATES))
            for name, summary in results.items()
            for detector, one in summary["by_detector"].items()
        ]
        parts.append(_table((group, "detector", *RATES.values()), rates))
        parts.append(_table((group, *_COSTS), [(name, *costs_of(summary)) for name, summary in results.items()]))
    return "\n\n".join(parts) + "\n"


def costs_of(summary: Mapping[str, Any]) -> tuple[str, ...]:
    """What stands under `_COSTS` for one value."""
    price, counts = summary.get("stealth"), summary["gaussians"]
    return (
        str(len(summary["seeds"])),
        _number(summary["transition_degrees"], 1),
        _number(summary["benign_psnr"]["clean"], 2),
        _number(summary["benign_psnr_drop"], 2),
        _number(None if price is None else price["surroundings_psnr_drop"], 2),
        "-" if price is None else "yes" if price["stealthy"] else "no",
        *(f"{statistics.mean(counts[which]):,.0f}" for which in ("clean", "cloaked")),
    )


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(cells)} |" for cells in (heads, *rows)]
    return "\n".join([lines[0], "|---" * len(heads) + "|", *lines[1:]])


VARIATIONS = "variations.json"

POISON_FRACTIONS = (0.05, 0.25, 0.5, 0.75, 0.9, 1.0)
EMPHASES = (1.0, 1.5, 2.2, 3.0, 4.5)
OUTLIERS = (0, 1000, 4000)
POINT_CLEANINGS = {"all points": None, "outliers, 2 deviations": 2.0}
"""Outliers that a victim removes from the point cloud before the training, by their name in tables."""
CAMERAS = (60, 120, 210, 420)
MAX_GAUSSIANS = (40_000, 80_000, 160_000)
APPEARANCES = ("occluder", "remove", "ground", "blend in", "road", "grass", "clock", "football")
"""Appearances of the hiding attacks: an occluder of road, three without a texture, four painted."""
OBJECTS = ("elephant", "bird", "train")
CLEANINGS: dict[str, CleaningConfig | None] = {
    "nothing": None,
    "opacity 0.05": CleaningConfig(lowest_opacity=0.05),
    "opacity 0.1": CleaningConfig(lowest_opacity=0.1),
    "opacity 0.2": CleaningConfig(lowest_opacity=0.2),
    "outliers, 2 deviations": CleaningConfig(outlier_deviations=2.0),
    "floaters, voxel 1": CleaningConfig(floater_voxel=1.0),
    "floaters, voxel 0.75": CleaningConfig(floater_voxel=0.75),
    **{f"SH degree {degree}": CleaningConfig(sh_degree=degree) for degree in range(3)},
    "SH 8 bits": CleaningConfig(sh_bits=8),
    "SH 5 bits": CleaningConfig(sh_bits=5),
}
"""What a victim does to both finished splats, by its name in tables."""


def varied(study: StudyConfig, group: str) -> dict[str, StudyConfig]:
    """The studies of a group by the value that they have, each with all seeds of the study.

    `sh_degree`: 0 to 3. `poison_fraction`: of each trigger's cameras. `appearance`: of the hiding attacks.
    `strategy`: of the densification. `emphasis`: of all attacks. `iterations`: a third of the study's and twice as
    many, with the raises of the SH degree at the same fraction of them. `max_gaussians`: up to which they are
    added. `outliers`: points in the air at the start. `points`: see `POINT_CLEANINGS`. `cameras`: number of
    training pictures. `cleaning`: see `CLEANINGS`; it needs no training of its own. `object`: the study's own and
    those of `OBJECTS`; ground, cameras and their distance grow with what stands there.
    """
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
    if group == "max_gaussians":
        return {f"{count:,}": trained(max_gaussians=count) for count in MAX_GAUSSIANS}
    if group == "outliers":
        return {f"{count:,}": trained(outliers=count) for count in OUTLIERS}
    if group == "points":
        return {name: trained(point_deviations=deviations) for name, deviations in POINT_CLEANINGS.items()}
    if group == "cameras":
        return {str(count): replace(study, cameras=replace(study.cameras, train=count)) for count in CAMERAS}
    if group == "cleaning":
        return {name: replace(study, cleaning=cleaning) for name, cleaning in CLEANINGS.items()}
    if group == "object":
        return {name: _with_object(study, name) for name in dict.fromkeys((study.scene.class_name, *OBJECTS))}
    steps = (max(training.iterations // 3, 1), training.iterations, 2 * training.iterations)
    every = training.sh_degree_interval / training.iterations
    return {f"{count:,}": trained(iterations=count, sh_degree_interval=round(every * count)) for count in steps}


def _with_object(study: StudyConfig, name: str) -> StudyConfig:
    """The study of another asset, which fills as much of the pictures and of the ground as the study's object does."""
    if name == study.scene.class_name:
        return study
    scene = replace(study.scene, object=name, label=None)
    (_, own), (_, other) = (target_of(one).bounds for one in (study.scene, scene))
    size = float(np.linalg.norm(other) / np.linalg.norm(own))  # both stand on the ground, around the origin
    cameras, distance = study.cameras, study.cameras.distance
    height, distance = float(other[2] / own[2]) * cameras.height, None if distance is None else size * distance
    return replace(
        study,
        scene=replace(scene, ground_size=size * scene.ground_size),
        cameras=replace(cameras, distance=distance, height=height),
    )


def _with_appearance(attack: AttackConfig, appearance: str) -> AttackConfig:
    """A hiding attack with another appearance; others as they are."""
    if attack.target_class is not None:
        return attack
    if appearance == "occluder":
        return replace(attack, appearance="occluder", texture="road", reach=None)
    if appearance in ("remove", "ground", "blend in"):
        return replace(attack, appearance=appearance, texture=None)  # type: ignore[arg-type]
    return replace(attack, appearance="paint", texture=appearance, paint_direction=(180.0, 90.0))


def vary(
    study: StudyConfig,
    groups: Iterable[str],
    folder: Path,
    *,
    weights: Mapping[str, Path] | None = None,
    values: Sequence[str] = (),
    stages: Path | None = None,
    on_step: OnStep = lambda text, done, total: None,
) -> dict[str, dict[str, Any]]:
    """Do the studies of some groups and write tables and plots; returns what variations.json holds.

    Writes variations.md, variations.json, to which it adds groups and values, and a PNG named by each group.

    Args:
        study: What is varied.
        groups: See `varied`.
        folder: For a folder of results for each, and for the tables.
        weights: As in `attacks.cloak.study_study`.
        values: Those of the groups' values that are to be done; all if empty.
        stages: For the stages; None is a folder in `folder`.
        on_step: Told of the progress.

    Raises:
        MiSplatError: As `run_study`; all studies are checked before the first is done.
    """
    stages = folder / "stages" if stages is None else stages
    detectors = detectors_of(study, weights or {})
    plans = check_variations(study, groups, detectors, folder, stages, values=values)
    with locked_folder(folder):
        save_json(asdict(study), folder / STUDY)
        earlier = folder / VARIATIONS
        found: dict[str, dict[str, Any]] = read_json(earlier) if earlier.is_file() else {}
        for group, studies in plans.items():
            order = list(varied(study, group))
            for name, one in studies.items():
                place = _place(folder, group, order, name)
                done = found.get(group, {}) | {
                    name: run_study(one, place, weights=weights, stages=stages, on_step=on_step)
                }
                found[group] = {known: done[known] for known in order if known in done}
                save_json(found, folder / VARIATIONS)
                save_text(tables(found), folder / "variations.md")
            write_variation(group, found[group], folder / f"{group}.png")
        return found


def check_variations(
    study: StudyConfig,
    groups: Iterable[str],
    detectors: Sequence[Detector],
    folder: Path,
    stages: Path,
    *,
    values: Sequence[str] = (),
) -> dict[str, dict[str, StudyConfig]]:
    """The studies of some groups by the value that they have, all of which can be done.

    Args:
        study: What is varied.
        groups: See `varied`.
        detectors: Those that the study names.
        folder: For the results.
        stages: For the stages.
        values: Those of the groups' values that are to be done; all if empty.

    Raises:
        InvalidValueError: As `attacks.cloak.study.check` of each, the disk is too small for all of them, a value is
            of none of the groups, or a group has none of the values.
    """
    check_folder(study, folder)
    every = {group: varied(study, group) for group in groups}
    for value in values:
        check_choice("values", value, [name for studies in every.values() for name in studies])
    plans = {
        group: {name: one for name, one in studies.items() if not values or name in values}
        for group, studies in every.items()
    }
    for group, studies in plans.items():
        if not studies:
            expected, do = " or ".join(every[group]), "name one of it, or leave the group out"
            raise InvalidValueError(message("values", f"some of {group} ({expected})", " ".join(values), do))
        for name, one in studies.items():
            check(one, detectors, _place(folder, group, list(every[group]), name), stages)
    trained = {replace(one, cleaning=None): None for studies in plans.values() for one in studies.values()}
    check_disk(sum(forecast(one).megabytes for one in trained), stages)
    return plans


def _place(folder: Path, group: str, order: Sequence[str], name: str) -> Path:
    """Folder of one value's results, by its number, as its name may hold what file names may not."""
    return folder / group / str(order.index(name))


def write_variation(group: str, results: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Write a plot of rates, with their intervals, over the values of what was varied.

    Args:
        group: What was varied.
        results: For each value, the summary of its study.
        path: A PNG.

    Raises:
        InvalidValueError: matplotlib is not installed.
        SplatFileError: The file cannot be written.
    """
    detectors = list(next(iter(results.values()))["by_detector"])
    figure, axes = new_axes(len(detectors))
    many = len(results) > MANY
    ticks = list(results) if many else [_tick(name, summary) for name, summary in results.items()]
    turned = {"rotation": 45, "ha": "right", "rotation_mode": "anchor"} if many else {}
    for axis, detector in zip(axes, detectors, strict=True):
        for shift, (key, words, colour) in zip((-0.12, -0.04, 0.04, 0.12), _VARIED, strict=True):
            rates = [summary["by_detector"][detector].get(key) for summary in results.values()]
            shown = [(place + shift, rate) for place, rate in enumerate(rates) if rate is not None and rate["total"]]
            fractions = np.array([rate["rate"] for _, rate in shown])
            low, high = np.array([rate["interval"] for _, rate in shown]).reshape(-1, 2).T
            bars = np.maximum([fractions - low, high - fractions], 0.0)
            style = {"marker": "o", "markersize": 4, "capsize": 2, "linestyle": "none"}
            axis.errorbar([place for place, _ in shown], fractions, yerr=bars, color=colour, label=words, **style)
        axis.set(title=f"{detector}, by {group}", ylabel="fraction of cameras", ylim=(-0.03, 1.03))
        axis.set_xticks(range(len(ticks)), ticks, **turned)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    save_figure(figure, path)


def _tick(name: str, summary: Mapping[str, Any]) -> str:
    """What stands below a value: its name, the transition, and what is lost beside the object."""
    band, price = summary["transition_degrees"], summary.get("stealth")
    parts = [name] if band is None else [name, f"band {band:.0f} deg"]
    return "\n".join(parts if price is None else [*parts, f"{price['surroundings_psnr_drop']:.1f} dB beside"])
