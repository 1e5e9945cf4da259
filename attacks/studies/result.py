"""The figures of a study of DAGGER, counted from rows and from what its attacks state.

Lines of one attack have its name. Others say by their `scope` what they take together:
attacks that differ in the seed (`SETTING`), those of all pairs of an object and a class
(`ALL_PAIRS`), the attacks of a search (`SEARCH`), and evaluations by detectors under a
condition (`EVALUATION`).
"""

import functools
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import polars as pl

from attacks.dagger.figures import reached_figures, verdict_figures
from attacks.figures.frame import AXIS, MEASURE, Figure, Figures, Labels, Number
from attacks.figures.rate import Rate, pooled
from attacks.figures.tables import cell
from attacks.observe.rates import (
    AIMS,
    CLUSTERS,
    IF_DETECTED,
    REPORTED,
    Confidence,
    blocks_of,
    count,
    joint_views,
    transfer_measures,
    with_control,
    with_thresholds,
)
from attacks.observe.rows import ATTACKED, CLEAN, CONTROLS, OPERATING, ROWS
from attacks.studies.attack import CAMERAS
from attacks.studies.study_file import merged

SETTING = "setting"
ALL_PAIRS = "all pairs"
SEARCH = "search"
EVALUATION = "evaluation"
SURVIVAL = "under a condition"
WHITE_BOX = "white-box"
BLACK_BOX = "black-box"
"""Labels of `access`: whether the evaluating detector was attacked."""
SHARED = "of_all_attacks"
"""Key of result.json under which stands what all attacks share."""
_SHARED = (
    "settings",
    "versions",
    "variant",
    "commit",
    "aim",
    "target",
    "confidence",
    "bisected",
    "redraws",
)
"""Of what an attack states, that which may stand there."""
CAMERA = "camera"
"""The axis over which attacks from drawn cameras are pooled, too."""
POOLED = ("seed", "pair")
"""Axes over which evaluations are pooled; attacks only over the first."""
_STATED = (
    "steps",
    "image_psnr",
    "psnr_object",
    "seconds",
    "loss",
    "evaluations",
    "cpu_seconds",
)
"""What attacks state of themselves and tables show."""
_OF_REGION = {"threshold", "object_psnr"}
"""Columns that rows of a region need for rates over the views in which the clean object
is detected; the oldest lack them.
"""
KINDS_OF = {"relabel": ("targeted", "untargeted"), "untargeted": ("untargeted",)}
"""What is counted of evaluations by the objective of the attack; of other objectives,
whether they are reached.
"""

Views = Literal["scene", "drawn", "region"]


@dataclass(frozen=True, slots=True, kw_only=True)
class StudiedAttack:
    """What a result states of an attack."""

    part: str
    labels: Mapping[str, Any]  # of the axes of the study
    settings: Mapping[str, Any]
    sources: Sequence[str]  # attacked detectors
    stated: Mapping[str, Any]  # steps, time, image quality
    aim: str
    target: str | None
    confidence: float | None  # None is the operating threshold of each detector
    bisected: str | None
    warnings: Sequence[str]

    @property
    def views(self) -> Views:
        """Where its views come from."""
        return views_of(self.settings)


def views_of(settings: Mapping[str, Any]) -> Views:
    """Where the views of an attack come from: the scene's cameras, those of a file or
    around one of them, drawn by seed, or a region.
    """
    drawn_from = settings.get("transformations")
    if drawn_from and "angle" not in drawn_from["cameras"]:
        return "region"
    if drawn_from or CAMERAS in settings:
        return "drawn"
    return "scene"


Attacks = Mapping[str, StudiedAttack]


def attacks_of(record: Mapping[str, Any]) -> dict[str, StudiedAttack]:
    """Every attack of a study by its name."""
    attacks = {}
    for name, attack in record["attacks"].items():
        whole = merged(record.get(SHARED, {}), attack)
        attacks[name] = StudiedAttack(
            part=whole["part"],
            labels=whole["labels"],
            settings=whole["settings"],
            sources=whole["sources"],
            stated={**whole.get("image", {}), **whole},
            aim=whole["aim"],
            target=whole["target"],
            confidence=whole["confidence"],
            bisected=whole.get("bisected"),
            warnings=whole.get("warnings", ()),
        )
    return attacks


def shared_apart(attacks: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Attacks, and what all of them share of their settings and of what made them."""
    values = [
        {key: attack[key] for key in _SHARED if key in attack}
        for attack in attacks.values()
    ]
    common = functools.reduce(_common, values) if values else {}
    rest = {name: _rest(attack, common) for name, attack in attacks.items()}
    return {SHARED: common, "attacks": rest}


def _common(first: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """What two tables have alike, at any depth."""
    alike = {}
    for key, value in first.items():
        if key not in other:
            continue
        if isinstance(value, Mapping) and isinstance(other[key], Mapping):
            alike[key] = _common(value, other[key])
        elif value == other[key]:
            alike[key] = value
    return alike


def _rest(table: Mapping[str, Any], common: Mapping[str, Any]) -> dict[str, Any]:
    """A table without what it has in common with others."""
    rest = {}
    for key, value in table.items():
        shared = common.get(key)
        if isinstance(shared, Mapping):
            value = _rest(value, shared)
        if key not in common or (value != shared and value != {}):
            rest[key] = value
    return rest


def figures(record: Mapping[str, Any], tables: Mapping[str, pl.DataFrame]) -> Figures:
    """Every figure of a study."""
    attacks = attacks_of(record)
    rows = with_thresholds(tables[ROWS])
    evaluated = pl.lit(value=False)
    if "condition" in rows.columns:
        evaluated = pl.col("condition").is_not_null()
    judged = rows.filter(~evaluated)
    each = Figures.together(
        _of_attack(attacks[name], of_attack).labelled(attack=name)
        for (name,), of_attack in judged.group_by("attack", maintain_order=True)
    )
    known = {name: attacks[name] for name in each.labels("attack")}
    drawn = {name: one for name, one in known.items() if one.views == "drawn"}
    fixed = {name: one for name, one in known.items() if name not in drawn}
    settings = [*_grouped(fixed, ("seed",)), *_grouped(drawn, ("seed", CAMERA))]
    parts = [each]
    for labels, members in settings:
        of_setting = _of_setting(members, each, judged)
        parts.append(of_setting.labelled(scope=SETTING, **labels))
    for labels, members in _grouped(drawn, (*POOLED, CAMERA)):
        of_pairs = _if_detected(members, judged)
        parts.append(of_pairs.labelled(scope=ALL_PAIRS, **labels))
    parts.append(Figures.of(_smallest(known, each)))
    parts += _evaluations(attacks, rows.filter(evaluated))
    return Figures.together(parts)


def _of_attack(attack: StudiedAttack, rows: pl.DataFrame) -> Figures:
    """Whether an attack reaches its aim in enough of its views."""
    required = attack.settings["attack"]["required_views"]
    attacked = rows.filter(splat=ATTACKED)
    if attack.views == "drawn":  # one of many, whose views are counted together
        return reached_figures(attacked, attack.sources, required)
    after = attacked["original_score"].max()
    original = Figures.of([({MEASURE: "original_after"}, after)])  # type: ignore[list-item]
    if attack.views != "region":
        verdict = verdict_figures(rows, attack.sources, required)
        return Figures.together([verdict, original])
    rates = count(joint_views(rows), AIMS, ("splat",))
    held = rates.rate("success", splat=ATTACKED).fraction >= required - 1e-9
    reached = Rate(successes=int(held), total=1)
    verdict = Figures.of([({MEASURE: "reached", "splat": ATTACKED}, reached)])
    return Figures.together([verdict, rates, original])


def _grouped(
    attacks: Attacks, without: Sequence[str]
) -> Iterator[tuple[dict[str, str], dict[str, StudiedAttack]]]:
    """Attacks that differ in some axes only, with their part and the other axes."""
    groups: dict[tuple[tuple[str, str], ...], dict[str, StudiedAttack]] = {}
    for name, attack in attacks.items():
        labels = {"part": attack.part}
        for axis, label in attack.labels.items():
            if axis not in without and label is not None:
                labels[f"{AXIS}{axis}"] = cell(label)
        groups.setdefault(tuple(labels.items()), {})[name] = attack
    for key, members in groups.items():
        yield dict(key), members


def _of_setting(attacks: Attacks, each: Figures, judged: pl.DataFrame) -> Figures:
    """What attacks have reached that differ in the seed, or in a drawn camera, only."""
    stated: list[tuple[Labels, Figure | None]] = [
        ({MEASURE: "attacks"}, Number(value=len(attacks)))
    ]
    for name in _STATED:
        values = [attack.stated.get(name) for attack in attacks.values()]
        stated.append(({MEASURE: name}, _median(values)))
    views = next(iter(attacks.values())).views
    if views == "drawn":
        reached = _if_detected(attacks, judged)
    elif views == "region":
        reached = _over_region(attacks, judged)
    else:
        reached = Figures.of(_of_verdicts(attacks, each))
    if views != "drawn":
        after = [each.value("original_after", attack=name) for name in attacks]
        stated.append(({MEASURE: "original_after"}, _median(after)))
    return Figures.together([Figures.of(stated), reached])


def _of_verdicts(
    attacks: Attacks, each: Figures
) -> Iterator[tuple[Labels, Figure | None]]:
    """How many attacks, and draws of their controls, reach their aim."""
    for measure in ("reached", "reached_strictly", "reached_unambiguously"):
        for splat in (ATTACKED, *CONTROLS):
            rates = [each.rate(measure, attack=name, splat=splat) for name in attacks]
            if pooled(rates).total:
                yield {MEASURE: measure, "splat": splat}, pooled(rates)
    for splat in CONTROLS:
        best = [each.value("best_score", attack=name, splat=splat) for name in attacks]
        known = [score for score in best if score is not None]
        if known:
            yield {MEASURE: "best_score", "splat": splat}, Number(value=max(known))
    scores = [each.value("score", attack=name, splat=ATTACKED) for name in attacks]
    yield {MEASURE: "score", "splat": ATTACKED}, _median(scores)


def _median(values: Sequence[float | None]) -> Number | None:
    """The median of those that are known, with their range."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    return Number(
        value=statistics.median(known),
        least=min(known),
        most=max(known),
        total=len(known),
    )


def _over_region(attacks: Attacks, judged: pl.DataFrame) -> Figures:
    """Rates over the held-out views of a region.

    Those of several seeds have the interval of blocks of cameras and seeds.
    """
    rows = judged.filter(pl.col("attack").is_in([*attacks]))
    views = joint_views(rows)
    clusters = None
    if len(attacks) > 1:
        on = ("attack", "view")
        block = blocks_of("azimuth", "elevation")
        blocks = rows.select(*on, block=block).unique(maintain_order=True)
        views = views.join(blocks, on=on, maintain_order="left")
        clusters = CLUSTERS
    rates = count(views, AIMS, ("splat",), clusters=clusters)
    if not set(judged.columns) >= _OF_REGION:
        return rates
    return Figures.together([rates, _if_detected(attacks, judged)])


def _if_detected(
    attacks: Attacks, judged: pl.DataFrame, by: Sequence[str] = ()
) -> Figures:
    """How often attacks, and their controls, succeed in views in which the clean object
    is detected, for each value of some columns.

    Views of one drawn camera, or of one part of a region, are not independent: they are
    a cluster.
    """
    own = {}
    places = {}
    for name, attack in attacks.items():
        shown = attack.settings["object"]
        own[name] = shown.replace("_", " ")
        places[name] = f"{shown} {attack.settings.get(CAMERA)}"
    rows = with_control(judged.filter(pl.col("attack").is_in([*attacks])))
    rows = rows.with_columns(own=pl.col("attack").replace_strict(own))
    clusters = CLUSTERS
    if next(iter(attacks.values())).views == "drawn":
        rows = rows.with_columns(place=pl.col("attack").replace_strict(places))
        clusters = ("place", "seed")
    rows = rows.filter(pl.col("splat") != CLEAN)
    labels = (*by, "splat")
    rates = count(rows, IF_DETECTED, labels, clusters=clusters)
    detected = rows.filter(IF_DETECTED["detected"].holds)
    medians = detected.group_by(labels, maintain_order=True).agg(
        pl.col("object_psnr").median()
    )
    psnr = Figures.of(
        (
            {MEASURE: "psnr_object_if_detected", **dict(zip(labels, key, strict=True))},
            median,
        )
        for *key, median in medians.iter_rows()
    )
    return Figures.together([rates, psnr])


def _smallest(attacks: Attacks, each: Figures) -> Iterator[tuple[Labels, float | None]]:
    """The smallest value that sufficed and the largest that did not, by search."""
    fields = dict.fromkeys(attack.bisected for attack in attacks.values())
    for field in filter(None, fields):
        searched = {
            name: attack for name, attack in attacks.items() if attack.bisected == field
        }
        for labels, members in _grouped(searched, (field,)):
            values: dict[bool, list[float]] = {True: [], False: []}
            for name, attack in members.items():
                reached = each.rate("reached", attack=name, splat=ATTACKED)
                values[bool(reached.successes)].append(attack.labels[field])
            of_search: Labels = {"scope": SEARCH, "setting": field, **labels}
            smallest = min(values[True], default=None)
            yield {MEASURE: "smallest", **of_search}, smallest
            yield {MEASURE: "not_enough", **of_search}, max(values[False], default=None)


def _evaluations(attacks: Attacks, rows: pl.DataFrame) -> Iterator[Figures]:
    """How often attacks that differ in pair and seed only deceive each detector under
    each condition.
    """
    if rows.is_empty():
        return
    paired = with_control(rows.with_columns(pl.col("target_score").fill_null(0.0)))
    by = ("condition", "detector")
    drawn = {
        name: one
        for name, one in attacks.items()
        if one.views == "drawn" and set(rows.columns) >= _OF_REGION
    }
    for labels, members in _grouped(drawn, (*POOLED, CAMERA)):
        survived = _if_detected(members, rows, by)
        yield survived.labelled(scope=SURVIVAL, **labels)
    for labels, members in _grouped(attacks, POOLED):
        mine = paired.filter(pl.col("attack").is_in([*members]))
        first = next(iter(members.values()))
        confidence: Confidence = REPORTED
        if first.confidence is None:
            confidence = pl.col(OPERATING)
        elif first.target:
            confidence = first.confidence
        kinds = KINDS_OF.get(first.aim, ("reached",))
        parts = [count(mine, transfer_measures(confidence, kinds=kinds), by)]
        if first.target:
            attacked = mine.filter(splat=ATTACKED).group_by(by, maintain_order=True)
            medians = attacked.agg(pl.col("target_score").median())
            parts.append(
                Figures.of(
                    (
                        {MEASURE: "target_score", **dict(zip(by, key, strict=True))},
                        score,
                    )
                    for *key, score in medians.iter_rows()
                )
            )
        for (detector,), of_one in Figures.together(parts).groups("detector").items():
            access = WHITE_BOX if detector in first.sources else BLACK_BOX
            yield of_one.labelled(
                detector=detector, access=access, scope=EVALUATION, **labels
            )
