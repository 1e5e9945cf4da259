"""The result of a study: one table of rows for all of it, what each attack says of itself, and the figures."""

import dataclasses
import functools
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from attacks.dagger.config import DaggerConfig
from attacks.dagger.result import verdict_figures
from attacks.observe.rates import (
    AIMS,
    CLUSTERS,
    REPORTED,
    blocks_of,
    count,
    joint_views,
    transfer_measures,
    with_control,
)
from attacks.observe.rows import ATTACKED, ROWS, column_of, frame_of
from attacks.rate import Rate
from attacks.studies.plan import Attempt, write_study
from attacks.studies.study_file import Study
from attacks.studies.table import SHARED, attacks_of, markdown
from attacks.studies.zoo import AXIS
from mi_splat import provenance
from mi_splat.io.folders import RECORD
from mi_splat.io.parsing import read_json
from mi_splat.ledger import Done, Job
from mi_splat.ledger.plans import Result

STORY = "study"
POOLED = ("seed", "pair")
"""Axes over which looks are pooled; the attacks over the first alone."""
_STATED = (
    *("steps", "image_psnr", "image", "noise_psnr", "used", "used_in_file", "changed_gaussians", "object_gaussians"),
    *("clamped_fraction", "redraws", "warnings", "seconds", "versions", "variant", "commit"),
    *("evaluations", "cpu_seconds", "loss"),
)
"""What an attack says of itself that does not follow from rows."""
_SHARED = ("settings", "versions", "variant", "commit", "aim", "target", "confidence", "bisected", "redraws")
"""Of what an attack states, that which may stand there."""
_NAME_DIGITS = 12

KINDS_OF = {"relabel": ("targeted", "untargeted"), "untargeted": ("untargeted",)}
"""What is counted of looks at attacks with an objective; of others whether that is reached."""

RATES = {
    "rate": "success",
    "strict_rate": "strict",
    "unambiguous_rate": "unambiguous",
    "clean_rate": "clean_success",
    "noise_rate": "noise_success",
}
"""Rates over the views of a region, and the measures that they are."""

Record = Mapping[str, Any]
Tables = Mapping[str, pl.DataFrame]


@dataclass(frozen=True, kw_only=True, eq=False)
class DaggerAttempt(Attempt):
    """An attack as jobs."""

    scene: Path
    job: Job
    looks: Mapping[str, Job]


def write_result(
    study: Study, done: Sequence[tuple[DaggerAttempt, Done]], results: Mapping[str, Result], out: Path
) -> list[Path]:
    """Write result.json, rows.csv.xz, study.toml and table.md into a folder that is there."""
    named = list(zip(_names(done), done, strict=True))
    rows = frame_of(_whole([row for name, (attempt, result) in named for row in _rows(name, attempt, result, results)]))
    record = {
        "story": STORY,
        **study.named,
        **_apart({name: _attack(attempt, result) for name, (attempt, result) in named}),
        "seeds": sorted({attempt.job.config.attack.seed for attempt, _ in done}),
        "detectors": _detectors(done),
        **provenance.origin(),
    }
    record = merged_figures(record, figures(record, {ROWS: rows}))
    return write_study(study, record, markdown(record), {ROWS: rows}, out, indent=None)


def _names(done: Sequence[tuple[DaggerAttempt, Done]]) -> list[str]:
    """What rows call each attack: the first digits of its key, with a number from the second part on that has it."""
    keys = [result.key[:_NAME_DIGITS] for _, result in done]
    earlier = [keys[:number].count(key) for number, key in enumerate(keys)]
    return [f"{key}-{count + 1}" if count else key for key, count in zip(keys, earlier, strict=True)]


def _rows(name: str, attempt: DaggerAttempt, result: Done, results: Mapping[str, Result]) -> Iterable[dict[str, Any]]:
    """Every row of an attack and of the looks at it."""
    config = attempt.job.config
    ids = {"attack": name, "sources": "+".join(config.detectors), "seed": config.attack.seed}
    yield from ({**ids, **row} for row in result.rows)
    for look in attempt.looks:
        looked = results.get(look)
        yield from ({**ids, **row} for row in (looked.rows if isinstance(looked, Done) else ()))


def _whole(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows without the columns that some of them lack and none may."""
    names = dict.fromkeys(name for row in rows for name in row)
    kept = [name for name in names if column_of(name).optional or all(row.get(name) is not None for row in rows)]
    return [{name: row.get(name) for name in kept} for row in rows]


def _attack(attempt: DaggerAttempt, result: Done) -> dict[str, Any]:
    """What is known of an attack besides its rows."""
    record, config = record_of(result), attempt.job.config
    return {
        "part": attempt.point.part,
        "labels": dict(attempt.point.labels),
        "bisected": attempt.point.bisected,
        "sources": list(config.detectors),
        "aim": config.objective.name,
        "target": config.objective.label,
        "confidence": config.objective.confidence,
        "seed": config.attack.seed,
        "settings": {"scene": str(attempt.scene), **dataclasses.asdict(config)},
        "key": result.key,
        **{name: record[name] for name in _STATED if name in record},
    }


def _apart(attacks: Mapping[str, Record]) -> dict[str, Any]:
    """Attacks, and what all of them share of their settings and of what made them, once for all."""
    values = [{key: attack[key] for key in _SHARED if key in attack} for attack in attacks.values()]
    common = functools.reduce(_common, values) if values else {}
    return {SHARED: common, "attacks": {name: _rest(attack, common) for name, attack in attacks.items()}}


def _common(first: Record, other: Record) -> dict[str, Any]:
    """What two tables have alike, at any depth."""
    alike = {}
    for key in first.keys() & other.keys():
        if isinstance(first[key], Mapping) and isinstance(other[key], Mapping):
            alike[key] = _common(first[key], other[key])
        elif first[key] == other[key]:
            alike[key] = first[key]
    return {key: alike[key] for key in first if key in alike}


def _rest(table: Record, common: Record) -> dict[str, Any]:
    """A table without what it has in common with others."""
    rest = {
        key: _rest(value, common[key]) if isinstance(common.get(key), Mapping) else value
        for key, value in table.items()
    }
    return {key: value for key, value in rest.items() if key not in common or (value != common[key] and value != {})}


def _detectors(done: Sequence[tuple[DaggerAttempt, Done]]) -> dict[str, str]:
    """Fingerprints of the weights of every detector attacked, by its name."""
    marks: dict[str, str] = {}
    for _, result in done:
        marks |= {detector["detector"]: detector["detector_fingerprint"] for detector in record_of(result)["detectors"]}
    return marks


def record_of(done: Done) -> dict[str, Any]:
    """What an attack says of itself."""
    return read_json(done.folder / RECORD)


def merged_figures(record: Record, derived: Record) -> dict[str, Any]:
    """A record with figures at their places."""
    attacks = {name: {**attack, **derived["attacks"].get(name, {})} for name, attack in record["attacks"].items()}
    return {**record, **derived, "attacks": attacks}


def figures(record: Record, tables: Tables) -> dict[str, Any]:
    """Every figure of a study, of its rows, and of what its attacks say of themselves."""
    rows, attacks = tables[ROWS], attacks_of(record)
    looked = pl.col("condition").is_not_null() if "condition" in rows.columns else pl.lit(value=False)
    judged, looks = rows.filter(~looked), rows.filter(looked)
    each = _of_attacks(attacks, judged)
    grouped = _grouped({name: attacks[name] for name in each}, ("seed",))
    groups = [_group(part, labels, members, each, attacks, judged) for part, labels, members in grouped]
    return {"attacks": each, "groups": groups, "smallest": _smallest(attacks, each), "looks": _looks(attacks, looks)}


def _of_attacks(attacks: Record, judged: pl.DataFrame) -> dict[str, dict[str, Any]]:
    """Whether each attack has its aim: in enough fixed views, or in enough of the views of a region."""
    each: dict[str, dict[str, Any]] = {}
    for name, rows in ((str(name), rows) for (name,), rows in judged.group_by("attack", maintain_order=True)):
        config = attacks[name]["settings"]["attack"]
        attacked = rows.filter(splat=ATTACKED)
        if "held_out" in config:
            rates = count(joint_views(rows), AIMS)[()]
            held = rates["success"].fraction >= config["required_views"] - 1e-9
            each[name] = {"success": held, **{key: rates[name].as_dict() for key, name in RATES.items()}}
        else:
            needed = {key: config[key] for key in ("required_views", "required_detectors")}
            told = verdict_figures(rows, attacks[name]["sources"], DaggerConfig(**needed))
            noise = told["noise"]
            best = max(noise["scores"], default=None)
            each[name] = {**told, "noise": {"successes": noise["successes"], "draws": noise["draws"], "best": best}}
        each[name]["original_after"] = attacked["original_score"].max()
    return each


Group = tuple[str, dict[str, Any], list[str]]
"""Part, labels, and names of the attacks."""


def _grouped(attacks: Record, pooled: Sequence[str]) -> list[Group]:
    """Attacks that differ in nothing but some axes."""
    groups: dict[tuple[Any, ...], Group] = {}
    for name, attack in attacks.items():
        labels = {axis: label for axis, label in attack["labels"].items() if axis not in pooled}
        groups.setdefault((attack["part"], *labels.items()), (attack["part"], labels, []))[2].append(name)
    return list(groups.values())


def _group(
    part: str,
    labels: Record,
    members: Sequence[str],
    each: Mapping[str, Record],
    attacks: Record,
    judged: pl.DataFrame,
) -> dict[str, Any]:
    """What attacks that differ in the seed alone have reached."""
    known = [each[name] for name in members]
    stated = [{**attacks[name].get("image", {}), **attacks[name]} for name in members]
    group: dict[str, Any] = {"part": part, "labels": labels, "attacks": len(members)}
    group |= {name: _median(stated, name) for name in ("steps", "image_psnr", "psnr_object", "seconds")}
    group["original_after"] = _median(known, "original_after")
    if AXIS in labels and _known(stated, "loss"):
        group |= {name: _median(stated, name) for name in ("loss", "evaluations", "cpu_seconds")}
        group["optimiser"] = attacks[members[0]]["settings"]["attack"]["optimiser"]
    if "rate" in known[0]:
        rates = _pooled(judged.filter(pl.col("attack").is_in(members)), several=len(members) > 1)
        return {**group, **{key: rates[name].as_dict() for key, name in RATES.items()}}
    aims = ("success", "strict", "unambiguous")
    frame = pl.DataFrame([{"splat": ATTACKED, **{key: attack[key] for key in aims}} for attack in known])
    rates = count(frame, {key: AIMS[key] for key in aims})[()]
    noise = [attack["noise"] for attack in known]
    return {
        **group,
        **{key: rate.as_dict() for key, rate in rates.items()},
        "score": _median(known, "score"),
        "score_least": min(_known(known, "score"), default=None),
        "noise_successes": sum(_known(noise, "successes")),
        "noise_draws": sum(_known(noise, "draws")),
        "noise_best": max(_known(noise, "best"), default=None),
    }


def _known(lines: Sequence[Record], name: str) -> list[Any]:
    return [line[name] for line in lines if line.get(name) is not None]


def _median(lines: Sequence[Record], name: str) -> Any:
    values = _known(lines, name)
    return statistics.median(values) if values else None


def _pooled(rows: pl.DataFrame, *, several: bool) -> dict[str, Rate]:
    """Rates over the views of a region; of several seeds with the interval of blocks of cameras and seeds."""
    views = joint_views(rows)
    if not several:
        return count(views, AIMS)[()]
    blocks = rows.select("attack", "view", block=blocks_of("azimuth", "elevation")).unique(maintain_order=True)
    return count(views.join(blocks, on=("attack", "view"), maintain_order="left"), AIMS, clusters=CLUSTERS)[()]


def _smallest(attacks: Record, each: Mapping[str, Record]) -> list[dict[str, Any]]:
    """The smallest value that sufficed and the largest that did not, of every search."""
    lines = []
    for field in dict.fromkeys(attack["bisected"] for attack in attacks.values() if attack.get("bisected")):
        searched = {name: attack for name, attack in attacks.items() if attack.get("bisected") == field}
        for part, labels, members in _grouped(searched, (field,)):
            values = {attacks[name]["labels"][field]: each[name]["success"] for name in members}
            smallest = min((value for value, success in values.items() if success), default=None)
            not_enough = max((value for value, success in values.items() if not success), default=None)
            line = {"part": part, "labels": labels, "field": field}
            lines.append({**line, "smallest": smallest, "not_enough": not_enough})
    return lines


def _aim(attack: Record) -> str:
    """The objective of an attack by its name; results of before it was written had no others."""
    return str(attack.get("aim", "relabel" if attack["target"] else "untargeted"))


def _looks(attacks: Record, looks: pl.DataFrame) -> list[dict[str, Any]]:
    """How often attacks that differ in pair and seed alone deceive each detector under each condition."""
    lines = []
    rows = with_control(looks.with_columns(pl.col("target_score").fill_null(0.0))) if len(looks) else looks
    for part, labels, members in _grouped(attacks, POOLED) if len(looks) else ():
        mine = rows.filter(pl.col("attack").is_in(members))
        first = attacks[members[0]]
        confidence = first["confidence"] if first["target"] else REPORTED
        by = ("condition", "detector")
        medians = mine.filter(splat=ATTACKED).group_by(by).agg(pl.col("target_score").median())
        scores = {(condition, detector): score for condition, detector, score in medians.iter_rows()}
        measures = transfer_measures(confidence, kinds=KINDS_OF.get(_aim(first), ("reached",)))
        for (condition, detector), rates in count(mine, measures, by).items():
            lines.append(
                {
                    "part": part,
                    "labels": labels,
                    "condition": condition,
                    "detector": detector,
                    "white_box": detector in first["sources"],
                    "target_score": scores[condition, detector] if first["target"] else None,
                    **{name: rate.as_dict() for name, rate in rates.items()},
                }
            )
    return lines
