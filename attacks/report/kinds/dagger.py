"""What `mi-splat dagger` leaves behind: an attack on one object."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import polars as pl

from attacks.dagger.figures import DETECTED, DRAWN
from attacks.figures.frame import Figures
from attacks.figures.rate import number, percent
from attacks.figures.result import Result
from attacks.figures.tables import Column, Group, Table, groups_of, label_at, rate_at
from attacks.objectives.relabel import Relabel
from attacks.objectives.suppression import GONE, Hide, Untargeted
from attacks.observe.rates import REPORTED, confidence_words
from attacks.observe.rows import ATTACKED, CLEAN, CONTROLS, NOISE, ROWS
from attacks.report.section import (
    Chart,
    Figure,
    Line,
    Picture,
    Point,
    Section,
    capital,
    listed,
    settings,
)
from mi_splat.errors import counted

_AIMS: dict[str, tuple[type[Any], str, str]] = {
    "relabel": (Relabel, "to {}", "report {}"),
    "hide": (Hide, "to nothing", "report nothing"),
    "untargeted": (Untargeted, "to anything else", "report something else"),
}
"""By its name an objective, and what the attacker wants as part of a title and of a
sentence.
"""
_DETECTORS: dict[str, Column[Group]] = {
    "detector": label_at("detector"),
    "attacked: success": rate_at("success", splat=ATTACKED),
    "random noise: success": rate_at("success", splat=NOISE),
    "no attack: success": rate_at("success", splat=CLEAN),
    "clean object detected": rate_at("found_clean"),
    "attacked object detected": rate_at("found_attacked"),
}
_CONDITIONS = (
    "scene",
    "selection",
    "cameras",
    "up",
    "reference",
    "background",
    "near",
    "scene_hash",
    "redraws",
)
_PICTURES = (
    (
        "detections.png",
        (
            "What the detector reports: before the attack on the left, after it on the"
            " right."
        ),
        True,
    ),
    ("difference.png", "What has changed, enlarged; grey is no change.", False),
    (
        "held_out.png",
        (
            "Held-out views all around: clean on the left of each pair, attacked on the"
            " right."
        ),
        True,
    ),
)
"""Files, their captions, and whether they are wide."""
IMAGE_PSNR = "PSNR of the images, attacked vs. clean"
OBJECT_PSNR = "PSNR on the object"
FEW_DRAWS = 5
"""Draws of noise from which on they say something."""


def read_attack(result: Result) -> Section:
    """The section of an attack, from chosen cameras or from all of a region."""
    record = result.record
    figures = result.figures
    config = record["config"]
    views = _views(result.tables[ROWS])
    drawn = record["story"] == DRAWN
    rate = figures.rate("success", splat=ATTACKED)
    noise = figures.rate("success", splat=NOISE)
    draws = figures.rate("reached", splat=NOISE).total
    wish = _wish(record, 2)
    title = _object_name(record, views)
    ball = _budget(record)
    many = counted(rate.total, "held-out view" if drawn else "view")
    held_out = ", held-out views" if drawn else ""
    control = control_of(config)
    conclusion = [_first_sentence(result, ball, many, wish)]
    if noise.total:
        conclusion.append(f"{capital(control)}: {noise.counts}.")
    conclusion.append(f"In the first view {_change(views[0], record['target'])}.")
    conclusion.append("Other cameras, detectors and renderers were not evaluated.")
    warnings = [*record["warnings"]]
    if 0 < draws < FEW_DRAWS:
        few = f"Few draws of noise: {draws}. Ask for more with --noise-draws"
        warnings.append(few)
    by_detector = groups_of(figures.where(scope=None), "detector")
    by_detector = [group for group in by_detector if group[0]["detector"] is not None]
    tables = [Table.of("Each detector", _DETECTORS, by_detector)]
    tables += _levels(record)
    if not drawn:
        tables.append(_table_of_views(views, record))
    level = (config["required_views"], "required")
    where = _where(config) if drawn else "chosen cameras"
    stated = {name: record[name] for name in _CONDITIONS if name in record}
    return Section(
        kind=f"DAGGER, from {where}",
        title=f"{title} {_wish(record, 1)}{f', from {where}' if drawn else ''}",
        done=_done(record, title, ball, many, drawn=drawn),
        conclusion=" ".join(conclusion),
        headline=Figure(
            label=f"attack success rate (ASR{held_out}): {wish}",
            rate=rate,
            note=_score(record, figures),
        ),
        control=Figure(label=f"{control}, on the same views", rate=noise),
        figures=tuple(_attack_figures(record, figures)),
        # of an ensemble, each detector has its own rate
        brief=(*_weights(record), IMAGE_PSNR, OBJECT_PSNR),
        warnings=warnings,
        pictures=tuple(
            Picture(path=result.folder / name, caption=caption, wide=wide)
            for name, caption, wide in _PICTURES
        ),
        charts=(
            *(_by_angle(figures, angle, level) for angle in ("azimuth", "elevation")),
            _search(record),
        ),
        tables=tables,
        configuration=settings({**config, **stated, "weights": _weights(record)}),
    )


def _budget(record: Mapping[str, Any]) -> str:
    """The budget of an attack, for a sentence."""
    psnr = record["config"].get("object_psnr")
    if psnr is not None:
        return f"a budget of {psnr:g} dB on the object's pixels"
    radii = ", ".join(f"{eps:g} over {name}" for name, eps in record["radius"].items())
    return f"a ball ({record['norm']}: {radii})"


def _weights(record: Mapping[str, Any]) -> dict[str, str]:
    return {one["detector"]: one["detector_fingerprint"] for one in record["detectors"]}


def _score(record: Mapping[str, Any], figures: Figures) -> str:
    score = figures.value("score", splat=ATTACKED) or 0.0
    return f"{'confidence' if record['target'] else 'score'} {percent(score)}"


def _done(
    record: Mapping[str, Any], title: str, ball: str, views: str, *, drawn: bool
) -> str:
    config = record["config"]
    budget = ""
    if config.get("image_psnr") is not None:
        budget = f"; PSNR of the images at least {config['image_psnr']:g} dB"
    unseen = (
        f"from {_where(config)}, which the search has never seen, " if drawn else ""
    )
    return (
        f"The Gaussians of one object ({title}: {record['object_gaussians']:,}"
        f" Gaussians, of which {record['changed_gaussians']:,} changed) were moved"
        f" within {ball}{budget}, in at most {counted(config['steps'], 'step')}. The"
        f" attacker knows the weights. {views} {unseen}evaluated the saved file in"
        f" 8-bit images. Success counts from a confidence of {_least_words(record)}."
    )


def _where(config: Mapping[str, Any]) -> str:
    """Where the cameras of a distribution are."""
    cameras = config["evaluation"]["cameras"]
    if "angle" not in cameras:
        return "all cameras of a region"
    return (
        f"up to {cameras['angle']:g} degrees and {percent(cameras['margin'])} of the"
        " distance around a chosen camera"
    )


def _levels(record: Mapping[str, Any]) -> Iterator[Table]:
    """What each level of a ladder has led to, if there is one."""
    columns: dict[str, Column[Mapping[str, Any]]] = {
        "PSNR of the object, dB": "object_psnr",
        "succeeds in the views that decide": lambda level: (
            "yes" if level["success"] else "no"
        ),
        "score there": "score",
        "steps": "steps",
    }
    if "levels" in record:
        yield Table.of("Levels, the quietest first", columns, record["levels"])


def _least_words(record: Mapping[str, Any]) -> str:
    """The confidence that success counts from, for a sentence."""
    stated = record["config"]["objective"].get("confidence")
    if stated is not None:
        return f"{stated:g}"
    thresholds = _thresholds(record)
    if record["target"] is None:
        thresholds = {name: min(GONE, one) for name, one in thresholds.items()}
    return confidence_words(thresholds)


def _thresholds(record: Mapping[str, Any]) -> dict[str, float]:
    """The confidence from which the detections of each detector count."""
    return {
        one["detector"]: one.get("threshold", REPORTED) for one in record["detectors"]
    }


def _first_sentence(result: Result, ball: str, views: str, wish: str) -> str:
    """Whether the attack succeeded, which needs a clean object that is detected."""
    figures = result.figures
    detectors = listed(list(_weights(result.record)))
    rate = figures.rate("success", splat=ATTACKED)
    detected = figures.rate("success", splat=ATTACKED, scope=DETECTED)
    if not detected.total:
        least = confidence_words(_thresholds(result.record))
        return (
            f"No success is counted: {detectors} did not detect the clean object at"
            f" confidence >= {least} in any of {views}. Within {ball} the attack made"
            f" {detectors} {wish} on the object in {rate.successes} of {views}."
        )
    succeeded = figures.rate("succeeded").successes
    verdict = "succeeded" if succeeded else "failed"
    needed = percent(result.record["config"]["required_views"])
    among = (
        f"{detected.successes} of {counted(detected.total, 'view')} in which the clean"
        " object is detected"
    )
    every = ""
    if detected.total != rate.total:
        every = f", and in {rate.successes} of all {views}"
    made = f"within {ball} it made {detectors} {wish} on the object"
    return f"The attack {verdict}: {made} in {among}{every} ({needed} required)."


def _views(rows: pl.DataFrame) -> list[dict[str, Any]]:
    """What each detector reports in each view of the clean and the attacked splat."""
    on = ["detector", "view"]
    clean = rows.filter(splat=CLEAN).select(
        *on,
        "original",
        before=pl.when(pl.col("original").is_not_null()).then("original_score"),
        target_before="target_score",
    )
    attacked = rows.filter(splat=ATTACKED).select(
        *on,
        "success",
        after=pl.when(pl.col("original").is_not_null()).then("original_score"),
        target_after="target_score",
    )
    return clean.join(attacked, on=on, maintain_order="left").to_dicts()


def _object_name(record: Mapping[str, Any], views: Sequence[Mapping[str, Any]]) -> str:
    """The name of the attacked object, or else the first class that was reported on
    it.
    """
    selection = record.get("selection")
    if isinstance(selection, Mapping) and "object" in selection:
        return str(selection["object"])
    originals = (str(view["original"]) for view in views if view["original"])
    return next(originals, "the selection")


def _wish(record: Mapping[str, Any], part: int) -> str:
    """What the attacker wants, as part of a title (1) or of a sentence (2)."""
    name = record["objective"]
    if name in _AIMS:
        words = _AIMS[name][part]
    else:
        words = ("", f"to its aim, {name}", f"reach its aim, {name},")[part]
    return str(words).format(record["target"])


def _change(view: Mapping[str, Any], target: str | None) -> str:
    """What a detector reported before and after an attack."""
    after = [f"{target} at {percent(view['target_after'])}"] if target else []
    if view["original"] not in (None, target):
        after.append(f"{view['original']} at {percent(view['after'])}")
    known = " and ".join(after) or "nothing known"
    return (
        f"{view['detector']} reported {_before(view, ' at ')} on the object before, and"
        f" {known} after it"
    )


def _before(view: Mapping[str, Any], between: str = " ") -> str:
    if view["original"]:
        return f"{view['original']}{between}{percent(view['before'])}"
    return "nothing"


def _attack_figures(record: Mapping[str, Any], figures: Figures) -> Iterator[Figure]:
    """Other rates, PSNR, the norm of the perturbation, steps and time."""
    detectors = list(_weights(record))
    for name in detectors if len(detectors) > 1 else ():
        rate = figures.rate("success", splat=ATTACKED, detector=name)
        yield Figure(label=name, rate=rate)
    clean = figures.rate("success", splat=CLEAN)
    yield Figure(label="clean object (no attack), on the same views", rate=clean)
    for name in CONTROLS:
        rate = figures.rate("success", splat=name)
        if name != NOISE and rate.total:
            yield Figure(label=f"{name}, on the same views", rate=rate)
    yield Figure(
        label="ASR, only where no other class is more confident",
        rate=figures.rate("unambiguous", splat=ATTACKED),
    )
    image = record["image"]
    note = "over all views (26 dB: visible; 40 dB: barely)"
    yield Figure(
        label=IMAGE_PSNR,
        words=number(record["image_psnr"], unit="dB"),
        note=note,
    )
    best = figures.value("best_score", splat=NOISE) or 0.0
    yield from Figure.each(
        {
            OBJECT_PSNR: number(image["psnr_object"], unit="dB"),
            **{
                f"{OBJECT_PSNR}, with {name}": _least(values)
                for name, values in record.get("control_psnr", {}).items()
            },
            "largest change outside the object, in [0, 1]": f"{image['outside']:.3f}",
            "Gaussians of the object that changed": (
                f"{record['changed_gaussians']:,} of {record['object_gaussians']:,}"
            ),
            **{
                f"norm of the perturbation, {name}": f"{used:.3g}"
                for name, used in record["used_in_file"].items()
            },
            "steps taken": f"{record['steps']} of {record['config']['steps']}",
            "best score of the control": percent(best),
            "time": number(record["seconds"], ".0f", "s"),
        }
    )


def control_of(config: Mapping[str, Any]) -> str:
    """What the control of an attack is called; before there were several it was noise
    of the attack's norm.
    """
    if "controls" in config:
        return "random noise that changes the object as much"
    return "random noise of the same norm"


def _least(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    if known:
        return number(min(known), unit="dB")
    return "-"


def _table_of_views(
    views: Sequence[Mapping[str, Any]], record: Mapping[str, Any]
) -> Table:
    """Every view as every detector sees it."""
    cameras = record.get("cameras") or []
    wanted = record["target"] or "target"
    lines = []
    for index, view in enumerate(views):
        name = cameras[index % len(cameras)] if cameras else f"view {index}"
        lines.append({**view, "camera": name})

    def confidence(key: str) -> Column[Mapping[str, Any]]:
        return lambda line: None if line[key] is None else percent(line[key])

    columns: dict[str, Column[Mapping[str, Any]]] = {
        "camera": "camera",
        "detector": "detector",
        "before": _before,
        "the same class after": confidence("after"),
        f"{wanted} before": confidence("target_before"),
        f"{wanted} after": confidence("target_after"),
        "success": "success",
    }
    return Table.of("Every view", columns, lines)


def _search(record: Mapping[str, Any]) -> Chart:
    """The score over the steps of the search, a line for each run."""
    runs: dict[int, list[Point]] = {}
    for line in record["trace"]:
        if "score" in line:
            runs.setdefault(line["restart"], []).append(
                Point(float(line["index"]), line["score"])
            )
    return Chart(
        title="The search",
        caption="Score at each step that was evaluated.",
        x_label="step",
        y_label="score",
        lines=tuple(
            Line(
                name=f"run {run}" if len(runs) > 1 else "score",
                role="attack",
                points=tuple(points),
            )
            for run, points in list(runs.items())[:6]
            if len(points) > 1
        ),
    )


def _by_angle(figures: Figures, angle: str, level: tuple[float, str]) -> Chart:
    line = Line.over("attacked", "attack", figures.where(scope=angle), "success")
    return Chart(
        title=f"Success by {angle}",
        caption=(
            "Held-out views in equal parts of the region; bands are 95 % intervals."
        ),
        x_label=f"{angle} of the camera, degrees",
        y_label="views with success",
        lines=(line,) if len(line.points) > 1 else (),
        level=level,
    )
