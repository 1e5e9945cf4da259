"""What `mi-splat cloak` leaves behind: who sees what of both splats from where."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict

import polars as pl

from attacks.cloak.config import StudyConfig, knowledge_for
from attacks.cloak.figures import ELEVATION, by_azimuth, measures
from attacks.cloak.recorded import study_of
from attacks.cloak.study import CONTACT, POISONED_PICTURES, study_toml
from attacks.cloak.tables import NAMES, RATES, costs, tables
from attacks.cloak.transition import transition
from attacks.figures.frame import MEASURE, Figures
from attacks.figures.rate import Rate, percent
from attacks.figures.result import Result
from attacks.observe.rates import Confidence, Measures
from attacks.observe.rows import (
    ATTACKED,
    CLEAN,
    PATH,
    ROWS,
    TARGET_SCORE,
    TRANSITION,
)
from attacks.poisons.base import MANIFEST, footprint_of
from attacks.report.kinds.detectors import threshold_charts
from attacks.report.section import (
    Chart,
    Figure,
    Line,
    Picture,
    Point,
    Role,
    Section,
    listed,
    settings,
)
from mi_splat.errors import counted
from mi_splat.io.parsing import read_json

_CURVES: dict[str, tuple[str, Role]] = {
    "trigger_miss_rate": (
        "missed well inside the trigger, where the control is found",
        "attack",
    ),
    "control_recall": ("control detected inside the trigger", "control"),
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
        "Six training images of each attack, clean above poisoned: what the victim"
        " trains on."
    ),
}
_NEEDS = {
    "scene": "it takes the scene's meshes and sun",
    "pictures": "it takes only images and masks",
}


def read_cloak(result: Result) -> Section:
    """The section of one study."""
    record = result.record
    figures = result.figures
    study = study_of(record)
    headline, control = headline_of(figures)

    def measured(confidence: Confidence) -> Measures:
        return measures(study, confidence=confidence)

    curves, at = threshold_charts(result.tables.get(ROWS), measured, _CURVES)
    time = {}
    if "seconds" in record:
        time["time"] = f"{record['seconds'] / 60:.0f} minutes"
    return Section(
        kind="CLOAK, a study",
        title=study.name,
        done=_done(study),
        conclusion=_conclusion(study, figures, headline, control),
        headline=headline,
        control=control,
        figures=(
            *_rates(figures),
            *_footprint(result),
            *Figure.each({**costs(figures), **time}),
        ),
        warnings=tuple(_doubts(study, figures)),
        pictures=tuple(
            Picture(path=result.folder / name, caption=words, wide=True)
            for name, words in _PICTURES.items()
        ),
        charts=(
            *_along_path(result.tables, study),
            *(_elevation(study, figures, name) for name in study.evaluation.detectors),
            *_around(result.tables, study),
            *_switch(result.tables, study),
            *curves,
        ),
        tables=(*tables(figures), *at),
        configuration=settings({**record["study"], "weights": record["detectors"]}),
        file=(f"{study.name}.toml", study_toml(asdict(study))),
    )


def _footprint(result: Result) -> Iterator[Figure]:
    """How much of the training images the poison changed, if its manifest is there."""
    path = result.folder / MANIFEST
    if not path.is_file():
        return
    changed, count, pixels = footprint_of(read_json(path))
    words = f"{changed} of {count}; {percent(pixels)} of all training pixels"
    yield Figure(label="training images that the poison changed", words=words)


def headline_of(figures: Figures) -> tuple[Figure, Figure | None]:
    """The figure of a study that matters, and the same of the clean splat."""
    missed = figures.find("trigger_miss_rate")
    if isinstance(missed, Rate):
        headline = Figure(
            label="attacked splat: object missed well inside the trigger",
            rate=missed,
            note="of the views in which it is detected in the clean splat",
        )
        found = figures.rate("control_recall")
        if not found.total:
            return headline, None
        label = "clean splat: object missed inside the trigger"
        return headline, Figure(label=label, rate=found.failures)
    wanted = figures.find("target_rate")
    if not isinstance(wanted, Rate):
        words = "none that was evaluated"
        return Figure(label="attacks in this study", words=words), None
    label = "cloaked splat: target class reported inside the trigger"
    control = figures.rate("control_target_rate")
    return (
        Figure(label=label, rate=wanted),
        Figure(label="clean splat: target class reported there", rate=control),
    )


def _hides(figures: Figures) -> bool:
    return figures.find("trigger_miss_rate") is not None


def _done(study: StudyConfig) -> str:
    attacks = [
        f"{one.name} ({one.appearance}: {_NEEDS[knowledge_for(one.appearance)]})"
        for one in study.attack
    ]
    layers = ""
    if study.layers:
        layers = " The finished splat then got its object in layers."
    return (
        f"{counted(study.cameras.train, 'training image')} of one object"
        f" ({study.scene.class_name}) were taken, and those from the trigger's cameras"
        f" changed: {listed(attacks)}. Two splats were trained alike, on clean and on"
        f" changed images, {counted(len(study.seeds), 'seed')} each.{layers}"
        f" {listed(list(study.evaluation.detectors))} then evaluated both from cameras"
        " that no training used. The attacker knows neither the trainer nor a detector."
    )


def _conclusion(
    study: StudyConfig, figures: Figures, headline: Figure, control: Figure | None
) -> str:
    what = "the target class is reported"
    if _hides(figures):
        what = f"the {study.scene.class_name} is missed"
    views = headline.counts or headline.words
    first = f"From inside the trigger {what} in {views} views of the cloaked splat"
    clean = "" if control is None else f", and in {control.counts} of the clean one"
    parts = [f"{first}{clean}."]
    benign = figures.rate("benign_recall")
    if benign.total:
        parts.append(
            f"From all other cameras the attacked one is detected in {benign.counts}."
        )
    width = figures.value("transition_degrees")
    if width is not None:
        parts.append(f"The switch between both takes {width:.1f} degrees of elevation.")
    parts.append("This says nothing of other objects, trainers or detectors.")
    return " ".join(parts)


def _rates(figures: Figures) -> Iterator[Figure]:
    """The other rates, over all detectors."""
    headlines = ["target_rate", "control_target_rate"]
    if _hides(figures):
        headlines = ["trigger_miss_rate"]
    for measure, words in RATES.items():
        rate = figures.find(measure)
        if measure not in headlines and isinstance(rate, Rate):
            yield Figure(label=words, rate=rate)


def _doubts(study: StudyConfig, figures: Figures) -> Iterator[str]:
    """Reasons to look twice that a study does not say itself."""
    if len(study.seeds) == 1:
        yield (
            "One seed: another training may give another rate. Give more with --seeds"
        )
    else:
        yield (
            "Intervals take views, seeds and detectors for independent, which they are"
            " not: look at each seed"
        )
    control = figures.rate("control_recall")
    if control.total and control.fraction < 0.5:
        yield (
            f"Inside the trigger the clean object is detected in {control.counts} views"
            " only"
        )
    if figures.value("stealthy") == 0:
        drop = figures.value("surroundings_psnr_drop")
        parts = [f"around the object the images lose {drop:.1f} dB inside the trigger"]
        lost = figures.value("object_psnr_drop")
        if lost is not None:
            parts.append(f"on the object {lost:.1f} dB just outside a trigger")
        yield f"Not stealthy: {', '.join(parts)}"
    for attack in study.attack:
        rates = figures.rates("target_rate", trigger=attack.name)
        wanted = [rate for rate in rates if rate.total]
        if wanted and not any(rate.successes for rate in wanted):
            yield f"The attack {attack.name} fails: its target class is never reported"


def _along_path(
    tables: Mapping[str, pl.DataFrame], study: StudyConfig
) -> Iterator[Chart]:
    """Confidence of each detector along the path over the object, on both splats."""
    if PATH not in tables:
        return
    lines: dict[str, tuple[Role, str, str]] = {
        "clean (control)": ("control", CLEAN, "original_score"),
        "cloaked": ("attack", ATTACKED, "original_score"),
    }
    for one in study.attack:
        if one.target_class:
            column = f"{TARGET_SCORE}{one.name}"
            lines[f"{one.target_class}, cloaked"] = ("other", ATTACKED, column)
    for (detector,), seen in tables[PATH].group_by("detector", maintain_order=True):
        highest = pl.col("elevation") == pl.col("elevation").max()
        top = seen.filter(highest)["view"].min()
        rising = pl.col("view") < top
        along = pl.when(rising).then("elevation").otherwise(180 - pl.col("elevation"))
        drawn = []
        for name, (role, splat, column) in lines.items():
            shown = seen.filter(pl.col(column).is_not_null(), splat=splat)
            points = shown.select(along, column).iter_rows()
            drawn.append(
                Line(name=name, role=role, points=tuple(Point(*p) for p in points))
            )
        yield Chart(
            title=f"Confidence of {detector} along a path",
            caption=(
                "The camera rises from the ground, passes over the object and comes"
                " down behind it; first seed."
            ),
            x_label="degrees along the path, 90 overhead",
            y_label="confidence on the object",
            lines=tuple(drawn),
            level=(study.evaluation.confidence, "counts from here"),
        )


def _elevation(study: StudyConfig, figures: Figures, detector: str) -> Chart:
    """How often a detector finds the object, by elevation, on both splats."""
    around = [attack for attack in study.attack if attack.azimuth is None]
    shade = None
    if around:
        shade = (*around[0].elevation, f"trigger {around[0].name}")
    bands = figures.where(scope=ELEVATION, detector=detector)
    several: tuple[tuple[str, str, Role], ...] = (
        (ATTACKED, "cloaked", "attack"),
        (CLEAN, "clean (control)", "control"),
    )
    return Chart(
        title=f"Found by {detector}, by elevation",
        caption=(
            "Bands are 95 % intervals; cameras of attacks from one side are left out."
        ),
        x_label="elevation of the camera, degrees",
        y_label="views in which it is found",
        lines=tuple(
            Line.over(name, role, bands, "found", splat=splat)
            for splat, name, role in several
        ),
        shade=shade,
    )


def _around(tables: Mapping[str, pl.DataFrame], study: StudyConfig) -> Iterator[Chart]:
    """What is reported around the object, of attacks from one side."""
    is_sided = any(attack.azimuth is not None for attack in study.attack)
    if ROWS not in tables or not is_sided:
        return
    counts = by_azimuth(study, tables[ROWS])
    shown = study.scene.class_name
    for detector in counts.labels("detector"):
        of_detector = counts.where(detector=detector)
        lines = []
        for name in of_detector.labels(MEASURE):
            for splat in (ATTACKED, CLEAN):
                if splat == ATTACKED or name == shown:
                    role: Role = "control" if splat == CLEAN else "attack"
                    title = f"{name}, {NAMES[splat]}"
                    lines.append(Line.over(title, role, of_detector, name, splat=splat))
        yield Chart(
            title=f"Reported by {detector}, by azimuth",
            caption=(
                "Bands are 95 % intervals; cameras below all that is hidden from"
                " everywhere."
            ),
            x_label="azimuth of the camera, degrees",
            y_label="views in which it is reported",
            lines=tuple(lines),
        )


def _switch(tables: Mapping[str, pl.DataFrame], study: StudyConfig) -> Iterator[Chart]:
    """The transition from the benign to the hidden appearance."""
    if TRANSITION not in tables:
        return
    fits = {splat: transition(study, tables, splat) for splat in NAMES}
    band = fits[ATTACKED]
    if band is None:
        return
    ends = None
    if band.start is not None and band.end is not None:
        ends = (band.start, band.end, "the switch")
    lines = []
    for splat, fit in fits.items():
        if fit is not None:
            points = map(Point, fit.angles, fit.fitted)
            role: Role = "control" if splat == CLEAN else "attack"
            lines.append(Line(name=NAMES[splat], role=role, points=tuple(points)))
    x_label = "elevation of the camera, degrees"
    if study.overhead is None:
        x_label = "degrees inside the trigger"
    yield Chart(
        title="From the benign to the hidden appearance",
        caption="A rising fit to all images of the arcs on which it sets in.",
        x_label=x_label,
        y_label="part of the way",
        lines=tuple(lines),
        shade=ends,
    )
