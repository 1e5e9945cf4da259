"""What `mi-splat cloak` leaves behind: a clean and a cloaked splat, and who sees what from where."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import polars as pl

from attacks.cloak.config import StudyConfig, knowledge_for, study_toml
from attacks.cloak.rates import (
    AT_LOWER,
    CLOAKED,
    MARGIN,
    NAMES,
    OWN_REGION,
    RATES,
    SECTOR,
    by_azimuth,
    costs,
    measures,
    picture_rows,
    transition,
)
from attacks.cloak.rates import figures as study_figures
from attacks.cloak.rates import rates as study_rates
from attacks.cloak.rates import tables as summary_tables
from attacks.cloak.steps import ROW_NAMES
from attacks.cloak.study import CONTACT, POISONED_PICTURES
from attacks.detectors.base import Detector
from attacks.observe.look import report_cells
from attacks.observe.rates import Confidence, Measures
from attacks.observe.rows import (
    ATTACKED,
    CLEAN,
    FIDELITY,
    PERFECT,
    ROWS,
    SUFFIX,
    TARGET_SCORE,
    TRANSITION,
    TRUE,
    Row,
    read_rows,
)
from attacks.observe.views import BATCH, ViewDetections
from attacks.rate import Rate, rate_of
from attacks.report.checking import Rescoring, Tables
from attacks.report.kinds.thresholds import threshold_charts
from attacks.report.section import Chart, Figure, Line, Picture, Point, Role, Section, listed, plural, settings
from mi_splat.assets import ASSETS
from mi_splat.errors import InvalidValueError
from mi_splat.fields import decode

KIND = "CLOAK, a study"
_CURVES: dict[str, tuple[str, Role]] = {
    "trigger_miss_rate": ("missed well inside the trigger, where the control is found", "attack"),
    "control_recall": ("control found inside the trigger", "control"),
    "target_rate": ("target class reported inside the trigger", "attack"),
    "control_target_rate": ("the same on the control", "control"),
}
"""Rates that are drawn over the confidence."""


def read(folder: Path, summary: Mapping[str, Any]) -> Section:
    """The section of a study."""
    study = summary["study"]
    headline, control = headline_of(summary)

    def measured(confidence: Confidence) -> Measures:
        return measures(study_of(study), confidence=confidence)

    curves, at = threshold_charts(folder, measured, _CURVES)
    true_curves, true_at = threshold_charts(folder, measured, _CURVES, part=picture_rows, what=", path traced")
    return Section(
        kind=KIND,
        title=str(study["name"]),
        done=_done(summary),
        conclusion=_conclusion(summary, headline, control),
        headline=headline,
        control=control,
        figures=_figures(summary),
        warnings=tuple(_doubts(summary)),
        pictures=(
            Picture(
                path=folder / CONTACT,
                caption="Both splats with what the first detector reports: two rows over elevations, two around it.",
                wide=True,
            ),
            Picture(
                path=folder / POISONED_PICTURES,
                caption="Six training pictures of each attack, clean above poisoned: what the victim trains on.",
                wide=True,
            ),
        ),
        charts=(
            *(_elevation(summary, name) for name in summary["by_detector"]),
            *_of_rows(folder, summary),
            *curves,
            *true_curves,
        ),
        tables=(*summary_tables(summary), *at, *true_at),
        configuration=settings({**study, "weights": summary["detectors"]}),
        file=(f"{study['name']}.toml", study_toml(study)),
    )


def headline_of(summary: Mapping[str, Any]) -> tuple[Figure, Figure | None]:
    """The figure of a study that matters, and the same of the clean splat."""
    missed, recalled = rate_of(summary["trigger_miss_rate"]), rate_of(summary["control_recall"])
    if missed is not None:
        headline = Figure(
            label="cloaked splat: object missed from well inside the trigger",
            rate=missed,
            note="of the views in which it is found in the clean splat",
        )
        if recalled is None or not recalled.total:
            return headline, None
        clean = Rate(successes=recalled.total - recalled.successes, total=recalled.total)
        return headline, Figure(label="clean splat: object missed from inside the trigger", rate=clean)
    wanted, control = rate_of(summary["target_rate"]), rate_of(summary["control_target_rate"])
    if wanted is None:
        return Figure(label="attacks in this study", words="none that was judged"), None
    return (
        Figure(label="cloaked splat: target class reported inside the trigger", rate=wanted),
        Figure(label="clean splat: target class reported there", rate=control) if control else None,
    )


def figures(record: Mapping[str, Any], tables: Tables) -> Mapping[str, Any]:
    """Every figure of a study, of its rows."""
    study = study_of(record["study"])
    _check_rows(study, record["splats"], tables)
    return _known(study_figures(study, tables, record["splats"]), record)


def _known(derived: Mapping[str, Any], record: Mapping[str, Any]) -> dict[str, Any]:
    """The figures that a result has, which may have been written before some were counted."""
    later = (OWN_REGION, AT_LOWER, MARGIN)
    return {
        name: _known(value, record) if name == "pictures" else value
        for name, value in derived.items()
        if name not in later or name in record
    }


def _splats(record: Mapping[str, Any]) -> dict[tuple[str, int], str]:
    """The files of the splats in a result, which are those of the first seed."""
    first = min(int(splat["seed"]) for splat in record["splats"])
    return {(CLEAN, first): f"{CLEAN}.ply", (ATTACKED, first): f"{CLOAKED}.ply"}


def _cells(record: Mapping[str, Any], seen: ViewDetections, row: Mapping[str, Any], detector: Detector) -> Row:
    """The scores that a detector gives to the object in one picture."""
    cells = report_cells(seen.detections, seen.box, original=row["original"])
    wanted = {attack["name"]: attack["target_class"] for attack in record["study"]["attack"] if attack["target_class"]}
    targets = {f"{TARGET_SCORE}{name}": seen.confidence_of(label, detector.classes) for name, label in wanted.items()}
    return {**{name: cells[name] for name in ("score", "original_score", "any_overlap")}, **targets}


def _rescored(record: Mapping[str, Any], rows: pl.DataFrame) -> dict[str, dict[str, Rate]]:
    """Every rate of each detector, of the splats in the rows."""
    study = study_of(record["study"])
    return {
        name: {RATES[key]: rate for key, rate in rates.items() if rate is not None}
        for (name,), rates in study_rates(study, rows, ("detector",)).items()
    }


RESCORING = Rescoring(splats=_splats, cells=_cells, rates=_rescored, batch=BATCH)


def study_of(configuration: Mapping[str, Any]) -> StudyConfig:
    """The study of a result. Rates need no mesh: one of a mesh file stands there as if it had an asset's."""
    values, scene = dict(configuration), configuration.get("scene")
    if isinstance(scene, dict) and isinstance(scene.get("object"), str) and scene["object"] not in ASSETS:
        values["scene"] = {**scene, "object": next(iter(ASSETS))}
    return decode(StudyConfig, values, "study")


def _check_rows(study: StudyConfig, splats: Sequence[Mapping[str, Any]], tables: Tables) -> None:
    """Raise unless the splats are those of the study, and every detector saw each once from the same cameras.

    Looks under conditions, which others do, may be of any detectors and cameras.
    """
    wanted = {(which, seed) for which in (CLEAN, CLOAKED) for seed in study.seeds}
    if sorted((splat["splat"], splat["seed"]) for splat in splats) != sorted(wanted):
        got = ", ".join(f"{splat['splat']} {splat['seed']}" for splat in splats)
        raise _wrong("splats", "a clean and a cloaked one for each seed", got or "none")
    splats_of_rows: set[tuple[str, int | None]] = {(ROW_NAMES[which], seed) for which, seed in wanted}
    pictures = {(TRUE, None), (PERFECT, None)} if study.evaluation.true_pictures else set()
    for name in (ROWS, FIDELITY, TRANSITION):
        if not set(tables[name].select("splat", "seed").iter_rows()) <= splats_of_rows | pictures:
            raise _wrong(f"table {name}", "rows of the study's splats", "others")
    plain = tables[ROWS]
    plain = plain.filter(pl.col("condition").is_null()) if "condition" in plain.columns else plain
    seen = Counter(plain.select("splat", "seed", "detector", "view").iter_rows())
    views = {key[3] for key in seen}
    for splat, seed in sorted(splats_of_rows | pictures, key=str):
        here = {key for key in seen if key[:2] == (splat, seed)}
        expected = {(splat, seed, name, view) for name in study.evaluation.detectors for view in views}
        if here != expected or not expected or any(seen[key] > 1 for key in here):
            lost = sorted(expected - here)
            got = f"none for {lost[0][2]}, view {lost[0][3]}" if lost else "others, or one twice"
            raise _wrong(f"table {ROWS}, {splat} splat, seed {seed}", "one row for each detector and camera", got)


def _wrong(what: str, expected: str, got: str) -> InvalidValueError:
    return InvalidValueError.of(what, expected, got, "get the result again")


_NEEDS = {"scene": "it takes the scene's meshes and sun", "pictures": "it takes pictures and masks alone"}


def _done(summary: Mapping[str, Any]) -> str:
    study = summary["study"]
    seeds = summary["seeds"]
    attacks = listed(
        [
            f"{attack['name']} ({attack['appearance']}: {_NEEDS[knowledge_for(attack['appearance'])]})"
            for attack in study["attack"]
        ]
    )
    layers = " The finished splat then got its object in layers." if study.get("layers") else ""
    cleaning = " The victim then cleaned both splats." if study.get("cleaning") else ""
    return (
        f"{plural(study['cameras']['train'], 'training picture')} of one object ({study['scene']['object']}) were "
        f"taken, and those from the trigger's cameras changed: {attacks}. Two splats were trained alike, on clean and "
        f"on changed pictures, {plural(len(seeds), 'seed')} each.{layers}{cleaning} "
        f"{listed(list(summary['by_detector']))} then looked at both from cameras that no training used. The attacker "
        "knows neither the trainer nor a detector."
    )


def _conclusion(summary: Mapping[str, Any], headline: Figure, control: Figure | None) -> str:
    hides = rate_of(summary["trigger_miss_rate"]) is not None
    what = f"the {summary['study']['scene']['object']} is missed" if hides else "the target class is reported"
    parts = [f"From inside the trigger {what} in {headline.counts or headline.words} views of the cloaked splat"]
    parts[0] += "." if control is None else f", and in {control.counts} of the clean one."
    benign = rate_of(summary["benign_recall"])
    if benign is not None and benign.total:
        parts.append(f"From everywhere else the cloaked one is found in {benign.successes:,} of {benign.total:,}.")
    if summary["transition_degrees"] is not None:
        parts.append(f"The switch between both takes {summary['transition_degrees']:.1f} degrees of elevation.")
    return " ".join([*parts, "This says nothing of other objects, trainers or detectors."])


def _figures(summary: Mapping[str, Any]) -> tuple[Figure, ...]:
    """The other rates, over all detectors, and what the pictures lost."""
    hides = rate_of(summary["trigger_miss_rate"]) is not None
    headlines = {"trigger_miss_rate"} if hides else {"target_rate", "control_target_rate"}
    rates = [
        Figure(label=words, rate=rate)
        for key, words in RATES.items()
        if key not in headlines and (rate := rate_of(summary[key])) is not None
    ]
    pairs = list(costs(summary).items())
    if "seconds" in summary:
        pairs.append(("time", f"{summary['seconds'] / 60:.0f} minutes"))
    return (*rates, *(Figure(label=label, words=words) for label, words in pairs))


def _doubts(summary: Mapping[str, Any]) -> Iterator[str]:
    """Reasons to look twice that a study does not say itself."""
    seeds = summary["seeds"]
    if len(seeds) == 1:
        yield "One seed: another training may give another rate. Give more with --seeds"
    else:
        yield "Intervals take views, seeds and detectors for independent, which they are not: look at each seed"
    control = rate_of(summary["control_recall"])
    if control is not None and control.total and control.fraction < 0.5:
        yield f"Inside the trigger the clean object is found in {control.successes} of {control.total} views only"
    price = summary["stealth"]
    if price is not None and not price["stealthy"]:
        parts = [f"beside the object the pictures lose {price['surroundings_psnr_drop']:.1f} dB inside the trigger"]
        if "object_psnr_drop" in price:
            parts.append(f"on the object {price['object_psnr_drop']:.1f} dB outside beside a trigger")
        yield f"Not stealthy: {', '.join(parts)}"
    for name, rates in summary["by_attack"].items():
        wanted = [
            rate for counted in rates.values() if (rate := rate_of(counted["target_rate"])) is not None and rate.total
        ]
        if wanted and not any(rate.successes for rate in wanted):
            yield f"The attack {name} fails: its target class is never reported"


def _elevation(summary: Mapping[str, Any], detector: str) -> Chart:
    """How often a detector finds the object, by elevation, on both splats."""
    hiding = next((attack for attack in summary["study"]["attack"] if attack["azimuth"] is None), None)
    pictures = summary.get("pictures")
    several: list[tuple[Mapping[str, Any] | None, str, str, Role]] = [
        (summary, "cloaked", "cloaked", "attack"),
        (summary, "clean", "clean (control)", "control"),
        (pictures, "clean", "path traced, as it is", "other"),
        (pictures, "cloaked", "path traced, as the attacks want it", "other"),
    ]

    def points(counted: Mapping[str, Any], which: str) -> tuple[Point, ...]:
        rows = [row for row in counted["by_elevation"][detector] if row[which]["total"]]
        return tuple(Point.of((row["from"] + row["to"]) / 2, Rate.of(row[which])) for row in rows)

    return Chart(
        title=f"Found by {detector}, by elevation",
        caption="Bands are 95 % intervals; cameras of attacks from one side are left out.",
        x_label="elevation of the camera, degrees",
        y_label="views in which it is found",
        lines=tuple(
            Line(name=name, role=role, points=points(counted, which))
            for counted, which, name, role in several
            if counted
        ),
        shade=None if hiding is None else (*hiding["elevation"], f"trigger {hiding['name']}"),
    )


def _of_rows(folder: Path, summary: Mapping[str, Any]) -> Iterator[Chart]:
    """What is drawn from the tables of a result that has them: reports around the object, and the transition."""
    files = {name: folder / f"{name}{SUFFIX}" for name in (ROWS, TRANSITION)}
    if not all(file.is_file() for file in files.values()):
        return
    study, tables = study_of(summary["study"]), {name: read_rows(file) for name, file in files.items()}
    around = by_azimuth(study, tables[ROWS]) if any(attack.azimuth is not None for attack in study.attack) else {}
    for detector in dict.fromkeys(detector for detector, _ in around):
        bands = {low + SECTOR / 2: rates for (name, low), rates in around.items() if name == detector}
        yield Chart(
            title=f"Reported by {detector}, by azimuth",
            caption="Bands are 95 % intervals; cameras below all that is hidden from everywhere.",
            x_label="azimuth of the camera, degrees",
            y_label="views in which it is reported",
            lines=tuple(
                Line(
                    name=name,
                    role="control" if name.endswith(CLEAN) else "attack",
                    points=tuple(Point.of(middle, rates[name]) for middle, rates in bands.items() if rates[name].total),
                )
                for name in next(iter(bands.values()))
            ),
        )
    switches = {which: transition(study, tables, splat) for splat, which in NAMES.items()}
    band = switches[CLOAKED]
    if band is not None:
        ends = (band.start, band.end, "the switch")
        yield Chart(
            title="From the benign to the hidden appearance",
            caption="A rising fit to all pictures of the arcs on which it sets in.",
            x_label="degrees inside the trigger" if study.overhead is None else "elevation of the camera, degrees",
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
            shade=None if None in ends else ends,  # type: ignore[arg-type]
        )
