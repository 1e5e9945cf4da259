"""What a study of DAGGER found: every figure, counted from rows and from what its
attacks say, and its tables.
"""

import functools
import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import polars as pl

from attacks.dagger.config import DaggerConfig
from attacks.dagger.result import verdict_figures
from attacks.observe.rates import (
    AIMS,
    CLUSTERS,
    OVER_CAMERAS,
    REPORTED,
    blocks_of,
    count,
    joint_views,
    transfer_measures,
    with_control,
)
from attacks.observe.rows import ATTACKED, CONTROLS, NOISE, ROWS
from attacks.rate import Rate, number, pooled
from attacks.studies.attack import CAMERAS
from attacks.studies.study_file import merged
from attacks.tables import Column, Table, cell, number_at, short_rate

AXIS = "attack.optimiser"
"""The axis over which attacks are compared."""
SHARED = "of_all_attacks"
"""Key of result.json under which stands what all attacks share."""
CAMERA = "camera"
"""The axis over which attacks from drawn cameras are pooled, too."""
POOLED = ("seed", "pair")
"""Axes over which looks are pooled; the attacks over the first alone."""
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

KINDS_OF = {"relabel": ("targeted", "untargeted"), "untargeted": ("untargeted",)}
"""What is counted of looks at attacks with an objective; of others whether that is
reached.
"""

RATES = {
    "rate": "success",
    "strict_rate": "strict",
    "unambiguous_rate": "unambiguous",
    "clean_rate": "clean_success",
    "noise_rate": "noise_success",
}
"""Rates over the views of a region, and the measures that they are."""

Record = Mapping[str, Any]


def shared_apart(attacks: Mapping[str, Record]) -> dict[str, Any]:
    """Attacks, and what all of them share of their settings and of what made them, once
    for all.
    """
    values = [
        {key: attack[key] for key in _SHARED if key in attack}
        for attack in attacks.values()
    ]
    common = functools.reduce(_common, values) if values else {}
    return {
        SHARED: common,
        "attacks": {name: _rest(attack, common) for name, attack in attacks.items()},
    }


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
        key: (
            _rest(value, common[key]) if isinstance(common.get(key), Mapping) else value
        )
        for key, value in table.items()
    }
    return {
        key: value
        for key, value in rest.items()
        if key not in common or (value != common[key] and value != {})
    }


def views_of(attack: Record) -> Literal["scene", "drawn", "region"]:
    """Where the views of an attack come from: the scene's cameras, those of a file,
    drawn by seed, or a region.
    """
    settings = attack["settings"]
    if settings.get("transformations"):
        return "region"
    if CAMERAS in settings:
        return "drawn"
    return "scene"


def figures(record: Record, tables: Mapping[str, pl.DataFrame]) -> dict[str, Any]:
    """Every figure of a study, of its rows, and of what its attacks say of
    themselves.
    """
    rows = tables[ROWS]
    attacks = attacks_of(record)
    if "condition" in rows.columns:
        looked = pl.col("condition").is_not_null()
    else:
        looked = pl.lit(value=False)
    judged = rows.filter(~looked)
    looks = rows.filter(looked)
    each = _of_attacks(attacks, judged)
    moving = {
        name: attacks[name] for name in each if views_of(attacks[name]) == "drawn"
    }
    still = {name: attacks[name] for name in each if name not in moving}
    grouped = [*_grouped(still, ("seed",)), *_grouped(moving, ("seed", CAMERA))]
    groups = [
        _group(part, labels, members, each, attacks, judged)
        for part, labels, members in grouped
    ]
    together = [
        {"part": part, "labels": labels, **_if_detected(members, attacks, judged)}
        for part, labels, members in _grouped(moving, (*POOLED, CAMERA))
    ]
    return {
        **{
            "attacks": each,
            "groups": groups,
            **({"together": together} if together else {}),
        },
        **{"smallest": _smallest(attacks, each), "looks": _looks(attacks, looks)},
    }


def _of_attacks(attacks: Record, judged: pl.DataFrame) -> dict[str, dict[str, Any]]:
    """Whether each attack has its aim: in enough fixed views, or in enough of the views
    of a region.
    """
    each: dict[str, dict[str, Any]] = {}
    for name, rows in (
        (str(name), rows)
        for (name,), rows in judged.group_by("attack", maintain_order=True)
    ):
        config = attacks[name]["settings"]["attack"]
        attacked = rows.filter(splat=ATTACKED)
        views = views_of(attacks[name])
        if views == "region":
            rates = count(joint_views(rows), AIMS)[()]
            held = rates["success"].fraction >= config["required_views"] - 1e-9
            seen = {key: rates[measure].as_dict() for key, measure in RATES.items()}
            each[name] = {"success": held, **seen}
        else:
            needed = DaggerConfig(required_views=config["required_views"])
            told = verdict_figures(rows, attacks[name]["sources"], needed)
            if views == "drawn":
                each[name] = {key: told[key] for key in ("success", "strict")}
                continue
            noise = told["noise"]
            best = max(noise["scores"], default=None)
            each[name] = {
                **told,
                "noise": {
                    "successes": noise["successes"],
                    "draws": noise["draws"],
                    "best": best,
                },
            }
        each[name]["original_after"] = attacked["original_score"].max()
    return each


Group = tuple[str, dict[str, Any], list[str]]
"""Part, labels, and names of the attacks."""


def _grouped(attacks: Record, pooled: Sequence[str]) -> list[Group]:
    groups: dict[tuple[Any, ...], Group] = {}
    for name, attack in attacks.items():
        labels = {
            axis: label
            for axis, label in attack["labels"].items()
            if axis not in pooled
        }
        groups.setdefault(
            (attack["part"], *labels.items()), (attack["part"], labels, [])
        )[2].append(name)
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
    group |= {
        name: _median(stated, name)
        for name in ("steps", "image_psnr", "psnr_object", "seconds")
    }
    if views_of(attacks[members[0]]) == "drawn":
        return {**group, **_if_detected(members, attacks, judged)}
    group["original_after"] = _median(known, "original_after")
    if AXIS in labels and _known(stated, "loss"):
        group |= {
            name: _median(stated, name)
            for name in ("loss", "evaluations", "cpu_seconds")
        }
    if "rate" in known[0]:
        rates = _pooled(
            judged.filter(pl.col("attack").is_in(members)), several=len(members) > 1
        )
        group |= {key: rates[name].as_dict() for key, name in RATES.items()}
        if set(judged.columns) >= _CONDITION:
            group["if_detected"] = _if_detected(members, attacks, judged)
        return group
    aims = ("success", "strict", "unambiguous")
    frame = pl.DataFrame(
        [{"splat": ATTACKED, **{key: attack[key] for key in aims}} for attack in known]
    )
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


def _if_detected(
    members: Sequence[str], attacks: Record, judged: pl.DataFrame
) -> dict[str, Any]:
    """How often attacks, and their controls, succeed in views in which the clean object
    is detected.

    Views of one drawn camera, or of one part of a region, are not independent: they are
    a cluster.
    """
    settings = {name: attacks[name]["settings"] for name in members}
    own = {name: of["object"].replace("_", " ") for name, of in settings.items()}
    rows = with_control(judged.filter(pl.col("attack").is_in(members)))
    rows = rows.with_columns(own=pl.col("attack").replace_strict(own))
    clusters = CLUSTERS
    if views_of(attacks[members[0]]) == "drawn":
        places = {
            name: f"{of['object']} {of['camera']}" for name, of in settings.items()
        }
        rows = rows.with_columns(place=pl.col("attack").replace_strict(places))
        clusters = ("place", "seed")
    rates = count(rows, OVER_CAMERAS, clusters=clusters)[()]
    median = pl.col("object_psnr").filter(OVER_CAMERAS["found"].holds).median()
    psnr = dict(rows.group_by("splat").agg(median).iter_rows())
    lines = {
        splat: {
            "psnr_object": psnr[splat],
            **{key: rates[f"{splat} {key}"].as_dict() for key in _REACHED},
        }
        for splat in (ATTACKED, *CONTROLS)
        if splat in psnr
    }
    return {"found": rates["found"].as_dict(), **lines.pop(ATTACKED), "controls": lines}


_REACHED = ("strict", "success", "lost")
_CONDITION = {"threshold", "object_psnr"}
"""Columns that rows of a region need for rates conditioned on the clean object; the
oldest have not.
"""


def _known(lines: Sequence[Record], name: str) -> list[Any]:
    return [line[name] for line in lines if line.get(name) is not None]


def _median(lines: Sequence[Record], name: str) -> Any:
    values = _known(lines, name)
    if values:
        return statistics.median(values)
    return None


def _pooled(rows: pl.DataFrame, *, several: bool) -> dict[str, Rate]:
    """Rates over the views of a region; of several seeds with the interval of blocks of
    cameras and seeds.
    """
    views = joint_views(rows)
    if not several:
        return count(views, AIMS)[()]
    blocks = rows.select(
        "attack", "view", block=blocks_of("azimuth", "elevation")
    ).unique(maintain_order=True)
    return count(
        views.join(blocks, on=("attack", "view"), maintain_order="left"),
        AIMS,
        clusters=CLUSTERS,
    )[()]


def _smallest(attacks: Record, each: Mapping[str, Record]) -> list[dict[str, Any]]:
    """The smallest value that sufficed and the largest that did not, of every
    search.
    """
    lines = []
    for field in dict.fromkeys(
        attack["bisected"] for attack in attacks.values() if attack.get("bisected")
    ):
        searched = {
            name: attack
            for name, attack in attacks.items()
            if attack.get("bisected") == field
        }
        for part, labels, members in _grouped(searched, (field,)):
            values = {
                attacks[name]["labels"][field]: each[name]["success"]
                for name in members
            }
            smallest = min(
                (value for value, success in values.items() if success), default=None
            )
            not_enough = max(
                (value for value, success in values.items() if not success),
                default=None,
            )
            line = {"part": part, "labels": labels, "field": field}
            lines.append({**line, "smallest": smallest, "not_enough": not_enough})
    return lines


def _aim(attack: Record) -> str:
    """The objective of an attack by its name; results of before it was written had no
    others.
    """
    return str(attack.get("aim", "relabel" if attack["target"] else "untargeted"))


def _looks(attacks: Record, looks: pl.DataFrame) -> list[dict[str, Any]]:
    """How often attacks that differ in pair and seed alone deceive each detector under
    each condition.
    """
    lines = []
    if len(looks):
        rows = with_control(looks.with_columns(pl.col("target_score").fill_null(0.0)))
    else:
        rows = looks
    for part, labels, members in _grouped(attacks, POOLED) if len(looks) else ():
        mine = rows.filter(pl.col("attack").is_in(members))
        first = attacks[members[0]]
        confidence = first["confidence"] if first["target"] else REPORTED
        by = ("condition", "detector")
        medians = (
            mine.filter(splat=ATTACKED)
            .group_by(by)
            .agg(pl.col("target_score").median())
        )
        scores = {
            (condition, detector): score
            for condition, detector, score in medians.iter_rows()
        }
        measures = transfer_measures(
            confidence, kinds=KINDS_OF.get(_aim(first), ("reached",))
        )
        for (condition, detector), rates in count(mine, measures, by).items():
            lines.append(
                {
                    "part": part,
                    "labels": labels,
                    "condition": condition,
                    "detector": detector,
                    "white_box": detector in first["sources"],
                    "target_score": (
                        scores[condition, detector] if first["target"] else None
                    ),
                    **{name: rate.as_dict() for name, rate in rates.items()},
                }
            )
    return lines


def tables(record: Record) -> Iterator[Table]:
    """All tables of a study: what its attacks have reached, the smallest that suffices,
    and what others see.
    """
    for title, groups in by_part(record["groups"]).items():
        compared = list(comparison(title, groups))
        if "found" in groups[0]:
            yield over_cameras(title, groups, record["together"])
            continue
        columns = {**_axes(groups), **_columns_of(groups[0])}
        yield from compared or [Table.of(title or "The attacks", columns, groups)]
    for title, searched in by_part(record["smallest"]).items():
        caption = f"The smallest that suffices{f': {title}' if title else ''}"
        yield Table.of(caption, {**_axes(searched), **_OF_SEARCHES}, searched)
    for title, looks in by_part(record["looks"]).items():
        for kind, meaning in KINDS.items():
            if kind in looks[0]:
                yield _matrix(f"{meaning}{f': {title}' if title else ''}", looks, kind)


def over_cameras(
    title: str, groups: Sequence[Record], together: Sequence[Record]
) -> Table:
    """Attacks from drawn cameras, and below them those of all pairs together."""
    sums = [
        {**line, "labels": {"pair": "all", **line["labels"]}}
        for line in together
        if line["part"] == title
    ]
    lines = [*groups, *(sums if len(groups) > len(sums) else ())]
    columns: dict[str, Column[Any]] = {
        **_axes(lines),
        "clean object detected": short_rate("found"),
        "strict": short_rate("strict", interval=True),
        "target class": short_rate("success"),
        "dB on the object": number_at("psnr_object", form=".1f"),
    }
    for name in dict.fromkeys(name for line in lines for name in line["controls"]):
        columns |= {
            f"{name}: {head}": short_rate("controls", name, key)
            for head, key in (
                ("strict", "strict"),
                ("target class", "success"),
                ("own class lost", "lost"),
            )
        }
        columns[f"{name}: dB on the object"] = number_at(
            "controls", name, "psnr_object", form=".1f"
        )
    return Table.of(title or "The attacks", columns, lines)


_OF_ATTACKS: dict[str, Column[Any]] = {
    "success": short_rate("success"),
    "strictly": short_rate("strict"),
    "confidence (least)": lambda line: (
        f"{number(line['score'], '.2f')} ({number(line['score_least'], '.2f')})"
    ),
    "original after": number_at("original_after"),
    "steps": "steps",
    "PSNR, dB": number_at("image_psnr", form=".1f"),
    "on the object": number_at("psnr_object", form=".1f"),
    "noise success": lambda line: f"{line['noise_successes']}/{line['noise_draws']}",
    "noise best": number_at("noise_best"),
}
_IF_DETECTED: dict[str, Column[Any]] = {
    "clean object detected": short_rate("if_detected", "found"),
    "strict, if detected": short_rate("if_detected", "strict", interval=True),
    "target class, if detected": short_rate("if_detected", "success"),
    "noise: strict": short_rate("if_detected", "controls", NOISE, "strict"),
    "noise: target class": short_rate("if_detected", "controls", NOISE, "success"),
    "noise: own class lost": short_rate("if_detected", "controls", NOISE, "lost"),
    "noise: dB on the object": number_at(
        "if_detected", "controls", NOISE, "psnr_object", form=".1f"
    ),
}
"""Of the views of a region in which the clean object is detected."""
_OF_VIEWS: dict[str, Column[Any]] = {
    "views": short_rate("rate", interval=True),
    "strictly": short_rate("strict_rate"),
    "noise": short_rate("noise_rate"),
    "clean": short_rate("clean_rate"),
    "PSNR, dB": number_at("image_psnr", form=".1f"),
    "on the object": number_at("psnr_object", form=".1f"),
    "steps": "steps",
    "seconds": number_at("seconds", form=".0f"),
}


def _columns_of(group: Record) -> dict[str, Column[Any]]:
    """What a table of groups such as this one shows."""
    if "rate" not in group:
        return _OF_ATTACKS
    if "if_detected" in group:
        return {**_IF_DETECTED, **_OF_VIEWS}
    return _OF_VIEWS


_OF_SEARCHES: dict[str, Column[Any]] = {
    "smallest": "smallest",
    "largest that does not": "not_enough",
}
KINDS = {
    "targeted": "The wanted class is reported",
    "untargeted": "The object's class is no longer reported",
    "reached": "The objective of the attack is reached",
}


def attacks_of(record: Record) -> dict[str, Any]:
    """Every attack of a study with all that is stated of it, by its name."""
    return {
        name: merged(record.get(SHARED, {}), attack)
        for name, attack in record["attacks"].items()
    }


def by_part(lines: Sequence[Record]) -> dict[str, list[Record]]:
    """Lines by the part of the study that they are of."""
    parts: dict[str, list[Record]] = {}
    for line in lines:
        parts.setdefault(line["part"], []).append(line)
    return parts


def _axes(lines: Sequence[Record]) -> dict[str, Column[Any]]:
    names = dict.fromkeys(name for line in lines for name in line["labels"])
    return {
        title_of(name): lambda line, name=name: line["labels"].get(name)  # type: ignore[misc]
        for name in names
    }


def title_of(axis: str) -> str:
    """What an axis is called at the head of a column."""
    return axis.removeprefix("attack.").replace("_", " ")


def _matrix(caption: str, looks: Sequence[Record], kind: str) -> Table:
    """Who judges, and how, against what was attacked; the longer of the two downwards,
    and the noise of all of it.
    """
    judges = _names(looks, ("condition", "detector"))
    attacks = _names(looks, ("labels",))
    cells = {(attacks[id(look)], judges[id(look)]): look for look in looks}
    across, down = (dict.fromkeys(names.values()) for names in (attacks, judges))
    turned = len(across) > len(down)
    if turned:
        across, down = down, across

    def rate(row: str, column: str) -> str:
        look = cells.get((row, column) if turned else (column, row))
        star = " *" if look is not None and look["white_box"] and marked else ""
        if look is None:
            return "-"
        return Rate.of(look[kind]).short(interval=True) + star

    def noise(row: str) -> str:
        members = [
            look for look in looks if row == (attacks if turned else judges)[id(look)]
        ]
        return pooled(look[f"noise_{kind}"] for look in members).short()

    marked = len({look["detector"] for look in looks}) > 1
    columns: dict[str, Column[str]] = {
        "attacked, judged by" if turned else "judged by": lambda row: row or "all"
    }
    columns |= {
        name or "all": lambda row, name=name: rate(row, name)  # type: ignore[misc]
        for name in across
    }
    columns["random noise"] = noise
    note = " (a star: the detector that judges was attacked)" if marked else ""
    return Table.of(f"{caption}{note}", columns, down)


def _names(looks: Sequence[Record], keys: Sequence[str]) -> dict[int, str]:
    """What each look is called by some of its keys, those apart that are the same in
    all looks.
    """
    values: dict[int, dict[str, Any]] = {}
    for look in looks:
        parts = values.setdefault(id(look), {})
        for key in keys:
            parts |= look[key] if isinstance(look[key], Mapping) else {key: look[key]}
    several = [
        key
        for key in next(iter(values.values()))
        if len({parts.get(key) for parts in values.values()}) > 1
    ]
    return {
        name: ", ".join(
            _named(key, parts[key]) for key in several if parts.get(key) is not None
        )
        for name, parts in values.items()
    }


def _named(key: str, value: Any) -> str:
    if isinstance(value, str):
        return value
    return f"{title_of(key)} {cell(value)}"


# Several optimisers in one study


def comparison(title: str, groups: Sequence[Record]) -> Iterator[Table]:
    """Every optimiser against all else that varies; nothing for groups of one optimiser
    alone.

    A cell has the successes, and in brackets the median over seeds of the lowest loss.
    """
    members = by_attack(groups)
    after = f": {title}" if title else ""
    if not members:
        return
    cells = {(group["labels"][AXIS], _elsewhere(group)): group for group in groups}
    columns: dict[str, Column[str]] = {"attack": str}
    for other in dict.fromkeys(elsewhere for _, elsewhere in cells):
        columns[other or "all"] = lambda name, other=other: _reached(
            cells.get((name, other))
        )  # type: ignore[misc]
    columns["together"] = lambda name: Rate.of(
        together(members[name])["success"]
    ).short(interval=True)
    columns["random noise"] = lambda name: "{noise_successes}/{noise_draws}".format_map(
        together(members[name])
    )
    columns["looks"] = lambda name: _spread(members[name], "evaluations")
    columns["CPU seconds"] = lambda name: _spread(members[name], "cpu_seconds")
    yield Table.of(
        f"Attacks side by side{after} (successes; in brackets the lowest loss)",
        columns,
        members,
    )


def by_attack(groups: Sequence[Record]) -> dict[str, list[Record]]:
    """The groups of each optimiser; none where all have the same, or where the study is
    no comparison.
    """
    members: dict[str, list[Record]] = {}
    for group in groups if all(map(_is_comparable, groups)) else ():
        members.setdefault(str(group["labels"].get(AXIS)), []).append(group)
    if len(members) > 1:
        return members
    return {}


def together(groups: Sequence[Record]) -> Record:
    """The successes of several groups, and those of their noise."""
    noise = {
        key: sum(group[key] for group in groups)
        for key in ("noise_successes", "noise_draws")
    }
    return {"success": pooled(group["success"] for group in groups).as_dict(), **noise}


def _is_comparable(group: Record) -> bool:
    """Whether a group says whether its attacks succeed, and how low their loss is."""
    return "loss" in group and "success" in group


def _elsewhere(group: Record) -> str:
    return ", ".join(
        str(label) for axis, label in group["labels"].items() if axis != AXIS
    )


def _reached(group: Record | None) -> str:
    if group is None:
        return "-"
    return f"{Rate.of(group['success']).short()} ({group['loss']:.2f})"


def _spread(groups: Sequence[Record], key: str) -> str:
    """The mean of an optimiser's groups, with the smallest and the largest value where
    these differ.
    """
    values = [group[key] for group in groups if group.get(key) is not None]
    if not values:
        return "-"
    low, mean, high = (
        f"{value:.3g}"
        for value in (min(values), sum(values) / len(values), max(values))
    )
    if low == high:
        return low
    return f"{mean} ({low} to {high})"
