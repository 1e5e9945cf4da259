"""What `mi-splat cloak` and studies of CLOAK leave behind: who sees what of both splats
from where.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import polars as pl

from attacks.cloak import rates as cloak_rates
from attacks.cloak import tables as cloak_tables
from attacks.cloak.config import StudyConfig, knowledge_for, recorded_study
from attacks.cloak.steps import ROW_NAMES
from attacks.cloak.study import CONTACT, POISONED_PICTURES, study_toml
from attacks.observe.rates import Confidence, Measures
from attacks.observe.rows import (
    ATTACKED,
    CLEAN,
    FIDELITY,
    PATH,
    ROWS,
    TARGET_SCORE,
    TRANSITION,
)
from attacks.rate import FEW, Rate, rate_of, spread
from attacks.report.checking import Tables, read_tables
from attacks.report.kinds.detectors import threshold_charts
from attacks.report.section import (
    Chart,
    Figure,
    Line,
    Picture,
    Point,
    Role,
    Section,
    capital,
    listed,
    settings,
    shared,
)
from attacks.studies import cloak as studies
from mi_splat.errors import InvalidValueError, counted

Record = Mapping[str, Any]

_CURVES: dict[str, tuple[str, Role]] = {
    "trigger_miss_rate": (
        "missed well inside the trigger, where the control is found",
        "attack",
    ),
    "control_recall": ("control found inside the trigger", "control"),
    "target_rate": ("target class reported inside the trigger", "attack"),
    "control_target_rate": ("the same on the control", "control"),
}
"""Rates that are drawn over the confidence."""
_PICTURES = {
    CONTACT: (
        "Both splats with what the first detector reports: two rows along a path over"
        " the object, two around it."
    ),
    POISONED_PICTURES: (
        "Six training pictures of each attack, clean above poisoned: what the victim"
        " trains on."
    ),
}


def read_cloak(folder: Path, summary: Record) -> Section:
    """The section of one study."""
    study = summary["study"]
    headline, control = headline_of(summary)

    def measured(confidence: Confidence) -> Measures:
        return cloak_rates.measures(study_of(study), confidence=confidence)

    tables = read_tables(folder, (ROWS, TRANSITION, PATH))
    rows = tables.get(ROWS)
    curves, at = threshold_charts(rows, measured, _CURVES)
    return Section(
        kind="CLOAK, a study",
        title=str(study["name"]),
        done=_done(summary),
        conclusion=_conclusion(summary, headline, control),
        headline=headline,
        control=control,
        figures=_figures(summary),
        warnings=tuple(_doubts(summary)),
        pictures=tuple(
            Picture(path=folder / name, caption=words, wide=True)
            for name, words in _PICTURES.items()
        ),
        charts=(
            *_along_path(tables, study),
            *(_elevation(summary, name) for name in summary["by_detector"]),
            *_charts_of_rows(tables, study),
            *curves,
        ),
        tables=(*cloak_tables.tables(summary), *at),
        configuration=settings({**study, "weights": summary["detectors"]}),
        file=(f"{study['name']}.toml", study_toml(asdict(study_of(study)))),
    )


def headline_of(summary: Record) -> tuple[Figure, Figure | None]:
    """The figure of a study that matters, and the same of the clean splat."""
    missed = rate_of(summary["trigger_miss_rate"])
    recalled = rate_of(summary["control_recall"])
    if missed is not None:
        headline = Figure(
            label="cloaked splat: object missed from well inside the trigger",
            rate=missed,
            note="of the views in which it is found in the clean splat",
        )
        if recalled is None or not recalled.total:
            return headline, None
        return headline, Figure(
            label="clean splat: object missed from inside the trigger",
            rate=recalled.failures,
        )
    wanted = rate_of(summary["target_rate"])
    control = rate_of(summary["control_target_rate"])
    if wanted is None:
        return Figure(label="attacks in this study", words="none that was judged"), None
    return (
        Figure(
            label="cloaked splat: target class reported inside the trigger", rate=wanted
        ),
        (
            Figure(label="clean splat: target class reported there", rate=control)
            if control
            else None
        ),
    )


# Its figures, derived again from its rows


def cloak_figures(record: Record, tables: Tables) -> Record:
    """Every figure of a study, of its rows."""
    study = study_of(record["study"])
    _check_rows(study, record["splats"], tables)
    return _known(cloak_rates.figures(study, tables, record["splats"]), record)


def _known(derived: Record, record: Record) -> dict[str, Any]:
    """The figures that a result has, which may have been written before some were
    counted.
    """
    later = (cloak_rates.OWN_REGION, cloak_rates.AT_LOWER, cloak_rates.MARGIN)
    return {
        name: value
        for name, value in derived.items()
        if name not in later or name in record
    }


def study_of(configuration: Record) -> StudyConfig:
    """The study of a result."""
    return recorded_study(configuration, "study")


def _check_rows(study: StudyConfig, splats: Sequence[Record], tables: Tables) -> None:
    """Raise unless the splats are those of the study, and every detector saw each once
    from the same cameras.

    Looks under conditions, which others do, may be of any detectors and cameras.
    """
    wanted = {
        (which, seed) for which in (CLEAN, cloak_rates.CLOAKED) for seed in study.seeds
    }
    if sorted((splat["splat"], splat["seed"]) for splat in splats) != sorted(wanted):
        got = ", ".join(f"{splat['splat']} {splat['seed']}" for splat in splats)
        raise _wrong("splats", "a clean and a cloaked one for each seed", got or "none")
    splats_of_rows = {(ROW_NAMES[which], seed) for which, seed in wanted}
    for name in (ROWS, FIDELITY, TRANSITION):
        if not set(tables[name].select("splat", "seed").iter_rows()) <= splats_of_rows:
            raise _wrong(f"table {name}", "rows of the study's splats", "others")
    plain = tables[ROWS]
    if "condition" in plain.columns:
        plain = plain.filter(pl.col("condition").is_null())
    else:
        plain = plain
    seen = Counter(plain.select("splat", "seed", "detector", "view").iter_rows())
    views = {key[3] for key in seen}
    for splat, seed in sorted(splats_of_rows):
        here = {key for key in seen if key[:2] == (splat, seed)}
        expected = {
            (splat, seed, name, view)
            for name in study.evaluation.detectors
            for view in views
        }
        if here != expected or not expected or any(seen[key] > 1 for key in here):
            lost = sorted(expected - here)
            if lost:
                got = f"none for {lost[0][2]}, view {lost[0][3]}"
            else:
                got = "others, or one twice"
            raise _wrong(
                f"table {ROWS}, {splat} splat, seed {seed}",
                "one row for each detector and camera",
                got,
            )


def _wrong(what: str, expected: str, got: str) -> InvalidValueError:
    return InvalidValueError.of(what, expected, got, "get the result again")


# What a page says of it

_NEEDS = {
    "scene": "it takes the scene's meshes and sun",
    "pictures": "it takes pictures and masks alone",
}


def _done(summary: Record) -> str:
    study = summary["study"]
    attacks = (
        f"{one['name']} ({one['appearance']}:"
        f" {_NEEDS[knowledge_for(one['appearance'])]})"
        for one in study["attack"]
    )
    if study.get("layers"):
        layers = " The finished splat then got its object in layers."
    else:
        layers = ""
    return (
        f"{counted(study['cameras']['train'], 'training picture')} of one object"
        f" ({study['scene']['object']}) were taken, and those from the trigger's"
        f" cameras changed: {listed(list(attacks))}. Two splats were trained alike, on"
        f" clean and on changed pictures, {counted(len(summary['seeds']), 'seed')}"
        f" each.{layers} {listed(list(summary['by_detector']))} then looked at both"
        " from cameras that no training used. The attacker knows neither the trainer"
        " nor a detector."
    )


def _conclusion(summary: Record, headline: Figure, control: Figure | None) -> str:
    hides = rate_of(summary["trigger_miss_rate"]) is not None
    if hides:
        what = f"the {summary['study']['scene']['object']} is missed"
    else:
        what = "the target class is reported"
    parts = [
        f"From inside the trigger {what} in {headline.counts or headline.words} views"
        " of the cloaked splat"
    ]
    parts[0] += (
        "." if control is None else f", and in {control.counts} of the clean one."
    )
    benign = rate_of(summary["benign_recall"])
    if benign is not None and benign.total:
        parts.append(
            f"From everywhere else the cloaked one is found in {benign.counts}."
        )
    if summary["transition_degrees"] is not None:
        parts.append(
            f"The switch between both takes {summary['transition_degrees']:.1f} degrees"
            " of elevation."
        )
    return " ".join(
        [*parts, "This says nothing of other objects, trainers or detectors."]
    )


def _figures(summary: Record) -> tuple[Figure, ...]:
    """The other rates, over all detectors, and what the pictures lost."""
    hides = rate_of(summary["trigger_miss_rate"]) is not None
    if hides:
        headlines = {"trigger_miss_rate"}
    else:
        headlines = {"target_rate", "control_target_rate"}
    rates = [
        Figure(label=words, rate=rate)
        for key, words in cloak_rates.RATES.items()
        if key not in headlines and (rate := rate_of(summary[key])) is not None
    ]
    if "seconds" in summary:
        time = {"time": f"{summary['seconds'] / 60:.0f} minutes"}
    else:
        time = {}
    return (*rates, *Figure.each({**cloak_tables.costs(summary), **time}))


def _doubts(summary: Record) -> Iterator[str]:
    """Reasons to look twice that a study does not say itself."""
    if len(summary["seeds"]) == 1:
        yield "One seed: another training may give another rate. Give more with --seeds"
    else:
        yield (
            "Intervals take views, seeds and detectors for independent, which they are"
            " not: look at each seed"
        )
    control = rate_of(summary["control_recall"])
    if control is not None and control.total and control.fraction < 0.5:
        yield (
            f"Inside the trigger the clean object is found in {control.counts} views"
            " only"
        )
    price = summary["stealth"]
    if price is not None and not price["stealthy"]:
        parts = [
            f"beside the object the pictures lose {price['surroundings_psnr_drop']:.1f}"
            " dB inside the trigger"
        ]
        if "object_psnr_drop" in price:
            parts.append(
                f"on the object {price['object_psnr_drop']:.1f} dB outside beside a"
                " trigger"
            )
        yield f"Not stealthy: {', '.join(parts)}"
    for name, rates in summary["by_attack"].items():
        wanted = [
            rate
            for one in rates.values()
            if (rate := rate_of(one["target_rate"])) is not None and rate.total
        ]
        if wanted and not any(rate.successes for rate in wanted):
            yield f"The attack {name} fails: its target class is never reported"


def _along_path(tables: Tables, study: Record) -> Iterator[Chart]:
    """Confidence of each detector along the path over the object, on both splats."""
    lines: dict[str, tuple[Role, str, str]] = {
        "clean (control)": ("control", CLEAN, "original_score"),
        "cloaked": ("attack", ATTACKED, "original_score"),
    }
    for one in study["attack"]:
        if one["target_class"]:
            lines[f"{one['target_class']}, cloaked"] = (
                "other",
                ATTACKED,
                f"{TARGET_SCORE}{one['name']}",
            )
    for (detector,), seen in (
        tables[PATH].group_by("detector", maintain_order=True) if PATH in tables else ()
    ):
        top = seen.filter(pl.col("elevation") == pl.col("elevation").max())[
            "view"
        ].min()
        along = (
            pl.when(pl.col("view") < top)
            .then("elevation")
            .otherwise(180 - pl.col("elevation"))
        )
        yield Chart(
            title=f"Confidence of {detector} along a path",
            caption=(
                "The camera rises from the ground, passes over the object and comes"
                " down behind it; first seed."
            ),
            x_label="degrees along the path, 90 overhead",
            y_label="confidence on the object",
            lines=tuple(
                Line(name=name, role=role, points=tuple(map(Point, *points)))
                for name, (role, splat, column) in lines.items()
                if len(
                    shown := seen.filter(
                        pl.col("splat") == splat, pl.col(column).is_not_null()
                    )
                )
                for points in [
                    (shown.select(x=along)["x"].to_list(), shown[column].to_list())
                ]
            ),
            level=(float(study["evaluation"]["confidence"]), "counts from here"),
        )


def _elevation(summary: Record, detector: str) -> Chart:
    """How often a detector finds the object, by elevation, on both splats."""
    hiding = next(
        (attack for attack in summary["study"]["attack"] if attack["azimuth"] is None),
        None,
    )
    several: tuple[tuple[str, str, Role], ...] = (
        ("cloaked", "cloaked", "attack"),
        ("clean", "clean (control)", "control"),
    )
    return Chart(
        title=f"Found by {detector}, by elevation",
        caption=(
            "Bands are 95 % intervals; cameras of attacks from one side are left out."
        ),
        x_label="elevation of the camera, degrees",
        y_label="views in which it is found",
        lines=tuple(
            Line.over(
                name,
                role,
                ({**row, **row[which]} for row in summary["by_elevation"][detector]),
            )
            for which, name, role in several
        ),
        shade=(
            None
            if hiding is None
            else (*hiding["elevation"], f"trigger {hiding['name']}")
        ),
    )


def _charts_of_rows(tables: Tables, configuration: Record) -> Iterator[Chart]:
    """What is drawn from the tables of a result that has them: reports around the
    object, and the transition.
    """
    if not {ROWS, TRANSITION} <= set(tables):
        return
    study = study_of(configuration)
    one_sided = any(attack.azimuth is not None for attack in study.attack)
    around = cloak_rates.by_azimuth(study, tables[ROWS]) if one_sided else {}
    for detector in dict.fromkeys(detector for detector, _ in around):
        bands = {
            low + cloak_rates.SECTOR / 2: rates
            for (name, low), rates in around.items()
            if name == detector
        }
        yield Chart(
            title=f"Reported by {detector}, by azimuth",
            caption=(
                "Bands are 95 % intervals; cameras below all that is hidden from"
                " everywhere."
            ),
            x_label="azimuth of the camera, degrees",
            y_label="views in which it is reported",
            lines=tuple(
                Line(
                    name=name,
                    role="control" if name.endswith(CLEAN) else "attack",
                    points=tuple(
                        Point.of(middle, rates[name])
                        for middle, rates in bands.items()
                        if rates[name].total
                    ),
                )
                for name in next(iter(bands.values()))
            ),
        )
    switches = {
        which: cloak_rates.transition(study, tables, splat)
        for splat, which in cloak_rates.NAMES.items()
    }
    band = switches[cloak_rates.CLOAKED]
    if band is None:
        return
    if band.start is None or band.end is None:
        ends = None
    else:
        ends = (band.start, band.end, "the switch")
    yield Chart(
        title="From the benign to the hidden appearance",
        caption="A rising fit to all pictures of the arcs on which it sets in.",
        x_label=(
            "degrees inside the trigger"
            if study.overhead is None
            else "elevation of the camera, degrees"
        ),
        y_label="part of the way",
        lines=tuple(
            Line(
                name=which,
                role="control" if which == CLEAN else "attack",
                points=tuple(map(Point, switch.angles, switch.fitted)),
            )
            for which, switch in switches.items()
            if switch is not None
        ),
        shade=ends,
    )


# Studies of CLOAK with one thing varied at a time

_LINES: tuple[tuple[str, str, Role], ...] = (
    ("trigger_miss_rate", "cloaked missed, well inside", "attack"),
    ("nothing_reported", "nothing of any class reported, well inside", "attack"),
    ("benign_recall", "cloaked found, elsewhere", "control"),
    ("target_rate", "target class reported", "other"),
)


def read_study(folder: Path, record: Record) -> Section:
    """The section of a study with one thing varied at a time."""
    groups = studies.by_part(record)
    points = list(record["points"].values())
    headlines, controls = zip(*map(headline_of, points), strict=True)
    rates = [
        figure.rate
        for figure in headlines
        if figure.rate is not None and figure.rate.total
    ]
    controlled = [
        figure.rate
        for figure in controls
        if figure is not None and figure.rate is not None
    ]
    label = headlines[0].label
    seeds = sorted({len(point["seeds"]) for point in points})
    return Section(
        kind="CLOAK, one thing varied at a time",
        title=f"{record['name']}, varied" if len(points) > 1 else str(record["name"]),
        done=_variations(record, groups),
        conclusion=(
            f"{capital(label)}, over all values: {spread(rates)}. Compare values within"
            " one chart; where intervals overlap, the study cannot tell them"
            f" apart.{_conditions(points)}{_pooled(record)}"
        ),
        headline=Figure(
            label=f"{label}, lowest to highest", words=spread(rates, intervals=False)
        ),
        control=Figure(
            label="clean splats, the same", words=spread(controlled, intervals=False)
        ),
        figures=Figure.each(
            {
                "studies": str(len(points)),
                "seeds of each": " to ".join(
                    map(str, dict.fromkeys((seeds[0], seeds[-1])))
                ),
            }
        ),
        warnings=tuple(_warnings(points, rates, seeds[0])),
        charts=tuple(
            _chart(group, values, detector)
            for group, values in groups.items()
            for detector in dict.fromkeys(
                name for point in values.values() for name in point["by_detector"]
            )
        ),
        tables=(*studies.pooled_tables(record), *studies.tables(groups)),
        configuration=shared(
            [{**point["study"], "weights": point["detectors"]} for point in points]
        ),
    )


def _warnings(
    points: Sequence[Record], rates: Sequence[Rate], fewest_seeds: int
) -> Iterator[str]:
    """Reasons to look twice at a study of several points."""
    if fewest_seeds == 1:
        yield "Variations were done with one seed: small differences may be chance"
    else:
        yield (
            "Intervals of one value have cameras and seeds drawn anew: they say nothing"
            " of another object"
        )
    loud = [
        point
        for point in points
        if point.get("stealth") and not point["stealth"]["stealthy"]
    ]
    if loud:
        names = listed(
            [f"{point['part'].replace('_', ' ')} {point['value']}" for point in loud]
        )
        yield f"Not stealthy, since pictures lose too much beside the object: {names}"
    few = min((rate.total for rate in rates), default=0)
    if few < FEW:
        yield f"The rate of some values counts few views: {few}"


def _variations(record: Record, groups: Mapping[str, Record]) -> str:
    """What was done: what varied, and under which conditions the splats were looked at
    again.
    """
    count = len(record["points"])
    text = f"The study {record['name']} was done {counted(count, 'time')}"
    if count > 1:
        varied = listed([group.replace("_", " ") for group in groups])
        text += f", each with one setting changed and the rest as it is: {varied}"
    looks = {
        look["condition"]
        for point in record["points"].values()
        for look in point.get("looks", ())
    }
    if looks:
        more = (
            " Both splats were then looked at under"
            f" {counted(len(looks), 'other condition')}."
        )
    else:
        more = ""
    return f"{text}. Each has a clean splat as its control.{more}"


def study_figures_of_points(record: Record, tables: Tables) -> Record:
    """Every figure of each point, of its rows."""
    points = {}
    for title, point in record["points"].items():
        of_point = {
            name: table.filter(attack=title).drop("attack")
            for name, table in tables.items()
        }
        points[title] = cloak_figures(point, of_point)
    configs = {
        title: study_of(point["study"]) for title, point in record["points"].items()
    }
    return {"points": points, **studies.pooled(record["points"], configs, tables[ROWS])}


def _pooled(record: Record) -> str:
    """A sentence for each part that is one attack on several objects: what holds of all
    of them together.
    """
    texts = []
    for over in record.get("pooled", {}).values():
        missed = {
            name: rate_of(rates["trigger_miss_rate"])
            for name, rates in over["by_detector"].items()
        }
        by_name = listed(
            [
                f"{rate.words} ({name})"
                for name, rate in missed.items()
                if rate is not None and rate.total
            ]
        )
        if by_name:
            texts.append(
                f" Over {over['objects']} objects together it is missed in {by_name}."
            )
    return "".join(texts)


def _conditions(points: Sequence[Record]) -> str:
    """A sentence on what is seen under other conditions, if anything is."""
    looks = [
        look
        for point in points
        for look in point.get("looks", ())
        if "missed_cloaked" in look
    ]
    rates = [rate for look in looks if (rate := Rate.of(look["missed_cloaked"])).total]
    under = listed(list(dict.fromkeys(look["condition"] for look in looks)))
    if not rates:
        return ""
    return (
        f" Under {under} it is missed from well inside the trigger in {spread(rates)}."
    )


def _chart(group: str, values: Record, detector: str) -> Chart:
    rates = {
        value: point["by_detector"][detector]
        for value, point in values.items()
        if detector in point["by_detector"]
    }
    lines = [
        Line.of(name, role, [rate_of(one[key]) for one in rates.values()])
        for key, name, role in _LINES
    ]
    title = group.replace("_", " ")
    return Chart.bars(f"{title}, {detector}", (title, "views"), rates, *lines)
