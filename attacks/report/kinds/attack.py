"""What `mi-splat dagger` leaves behind: one object, from chosen cameras or from all of a region."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import polars as pl

from attacks.aims import PluggedObjective
from attacks.detectors.base import Detector
from attacks.objectives import Hide, Objective, Relabel, Target, Untargeted
from attacks.observe.look import verdict_cells
from attacks.observe.rates import Measure, count
from attacks.observe.rows import ATTACKED, Row
from attacks.observe.views import CAMERAS, ViewDetections
from attacks.rate import Rate, number, percent
from attacks.report.checking import Rescoring
from attacks.report.section import Chart, Figure, Line, Picture, Point, Section, listed, plural, settings
from attacks.tables import Table
from mi_splat.errors import InvalidValueError

Record = Mapping[str, Any]

_AIMS: dict[str, tuple[type[Any], str, str]] = {
    "relabel": (Relabel, "to {}", "report {}"),
    "hide": (Hide, "to nothing", "report nothing"),
    "untargeted": (Untargeted, "to anything else", "report something else"),
}
"""By its name an aim, and what the attacker wants as part of a title and of a sentence."""
_RATES = {
    "success": "attacked: success",
    "noise": "random noise: success",
    "clean": "no attack: success",
    "found_clean": "clean object found",
    "found_attacked": "attacked object found",
}
_CONDITIONS = ("scene", "selection", "cameras", "up", "reference", "background", "near", "scene_hash", "redraws")
_PICTURES = (
    ("detections.png", "What the detector reports: before the attack on the left, after it on the right.", True),
    ("difference.png", "What has changed, enlarged; grey is no change.", False),
    ("held_out.png", "Held-out views all around: clean on the left of each pair, attacked on the right.", True),
)
"""Files, their captions, and whether they are wide."""
FEW_DRAWS = 5
"""Draws of noise from which on they say something."""


def read(folder: Path, record: Record) -> Section:
    """The section of an attack, from chosen cameras or from all of a region."""
    rate, noise, draws = Rate.of(record["rate"]), Rate.of(record["noise_rate"]), record["noise"]["draws"]
    config, names, drawn = record["config"], list(record["rates"]), "by_azimuth" in record
    needed, budget = config["required_views"], config.get("image_psnr")
    views, wish, title = (
        plural(rate.total, "held-out view" if drawn else "view"),
        _wish(record, 2),
        _object_name(record),
    )
    radii = ", ".join(f"{eps:g} over {name}" for name, eps in record["radius"].items())
    ball = f"a ball ({record['norm']}: {radii})"
    conclusion = [
        f"The attack {'succeeded' if record['success'] else 'failed'}: within {ball} it made {listed(names)} {wish} on "
        f"the object in {rate.successes} of {views}, where {percent(needed)} are asked for.",
        f"Random noise of the same size: {noise.counts}." if noise.total else "",
        f"In the first view {_change(record['views'][0], record['target'])}.",
        "This says nothing of other cameras, detectors or renderers.",
    ]
    return Section(
        kind=f"DAGGER, from {'all cameras of a region' if drawn else 'chosen cameras'}",
        title=f"{title} {_wish(record, 1)}{', all cameras' if drawn else ''}",
        done=(
            f"The Gaussians of one object ({title}: {record['object_gaussians']:,} Gaussians, of which "
            f"{record['changed_gaussians']:,} changed) were moved within {ball}"
            f"{'' if budget is None else f', while the pictures keep {budget:g} dB'}, in at most "
            f"{plural(config['steps'], 'step')}. The attacker knows the weights. {views} "
            f"{'that the search has never seen ' if drawn else ''}judged the saved file in 8-bit pictures."
        ),
        conclusion=" ".join(filter(None, conclusion)),
        headline=Figure(
            label=f"{'held-out ' if drawn else ''}views with the aim reached: {wish}",
            rate=rate,
            note=f"{'confidence' if record['target'] else 'score'} {percent(record['score'])}",
        ),
        control=Figure(label="random noise of the same size, on the same views", rate=noise),
        figures=tuple(_figures(record)),
        warnings=(
            *record["warnings"],
            *([f"Few draws of noise: {draws}. Ask for more with --noise-draws"] if 0 < draws < FEW_DRAWS else []),
        ),
        pictures=tuple(Picture(path=folder / name, caption=caption, wide=wide) for name, caption, wide in _PICTURES),
        charts=(*(_by_angle(record, angle, needed) for angle in ("azimuth", "elevation")), _search(record)),
        tables=(
            Table.of(
                "Each detector",
                {"rate": "rate", **{name: name for name in names}},
                [
                    {"rate": words, **{name: record["rates"][name][key] for name in names}}
                    for key, words in _RATES.items()
                ],
            ),
            *(() if drawn else (_views(record),)),
        ),
        configuration=settings(
            {
                **config,
                **{name: record[name] for name in _CONDITIONS if name in record},
                "weights": {judged["detector"]: judged["detector_fingerprint"] for judged in record["detectors"]},
            }
        ),
    )


def _object_name(record: Record) -> str:
    """The name of the attacked object, or else the first class that was reported on it."""
    selection = record.get("selection")
    if isinstance(selection, Mapping) and "object" in selection:
        return str(selection["object"])
    return next(
        (str(rates["original"]) for rates in record["rates"].values() if rates.get("original")), "the selection"
    )


def _wish(record: Record, part: int) -> str:
    """What the attacker wants, as part of a title (1) or of a sentence (2)."""
    name = record["objective"]
    words = _AIMS[name][part] if name in _AIMS else ("", f"to its aim, {name}", f"reach its aim, {name},")[part]
    return str(words).format(record["target"])


def _change(view: Record, target: str | None) -> str:
    """What a detector reported before and after an attack."""
    before = f"{view['original']} at {percent(view['clean_confidence'])}" if view["original"] else "nothing"
    after = [f"{target} at {percent(view['target_confidence'])}"] if target else []
    if view["original"] not in (None, target):
        after.append(f"{view['original']} at {percent(view['original_confidence'])}")
    known = " and ".join(after) or "nothing known"
    return f"{view['detector']} reported {before} on the object before, and {known} after it"


def _figures(record: Record) -> Iterator[Figure]:
    """Other rates, what the pictures lost, the size of the change, steps and time."""
    for name, rates in record["rates"].items() if len(record["rates"]) > 1 else ():
        yield Figure(label=name, rate=Rate.of(rates["success"]))
    yield Figure(label="no attack, on the same views", rate=Rate.of(record["clean_rate"]))
    yield Figure(label="success without another class of more confidence", rate=Rate.of(record["unambiguous_rate"]))
    image, noise = record["image"], [value for value in record["noise_psnr"] if value is not None]
    note = "PSNR of the mean squared error over all views; 26 is easily seen, 40 hardly"
    yield Figure(label="pictures, attacked against clean", words=number(record["image_psnr"], unit="dB"), note=note)
    for label, words in {
        "the same on the object": number(image["psnr_object"], unit="dB"),
        "the same with the noise": number(noise[0], unit="dB") if noise else "-",
        "largest change beside the object (1 is all)": f"{image['outside']:.3f}",
        "Gaussians changed, of the object's": f"{record['changed_gaussians']:,} of {record['object_gaussians']:,}",
        **{f"size of the change, {name}": f"{used:.3g}" for name, used in record["used_in_file"].items()},
        "steps taken": f"{record['steps']} of {record['config']['steps']}",
        "best score of the noise": percent(max(record["noise"]["scores"], default=0.0)),
        "time": number(record["seconds"], ".0f", "s"),
    }.items():
        yield Figure(label=label, words=words)


def _views(record: Record) -> Table:
    """Every view as every detector sees it."""
    names, wanted = record.get("cameras") or [], record["target"] or "target"
    lines = [
        {
            **{key: None if value is None else percent(value) for key, value in view.items() if "confidence" in key},
            "camera": str(names[number % len(names)]) if names else f"view {number}",
            "detector": view["detector"],
            "before": f"{view['original']} {percent(view['clean_confidence'])}" if view["original"] else "nothing",
            "success": view["success"],
        }
        for number, view in enumerate(record["views"])
    ]
    columns = {
        **{name: name for name in ("camera", "detector", "before")},
        "the same class after": "original_confidence",
        f"{wanted} before": "target_confidence_clean",
        f"{wanted} after": "target_confidence",
        "success": "success",
    }
    return Table.of("Every view", columns, lines)


def _search(record: Record) -> Chart:
    """The score over the steps of the search, a line for each run."""
    runs: dict[int, list[Point]] = {}
    for line in record["trace"]:
        if "score" in line:
            runs.setdefault(line["restart"], []).append(Point(float(line["index"]), line["score"]))
    if max(map(len, runs.values()), default=0) < 2:
        runs = {}
    confidence = record["config"]["objective"].get("confidence")
    is_confidence = record["story"] == "dagger" and record["objective"] == "relabel" and confidence is not None
    return Chart(
        title="The search",
        caption="Score at each step that was judged.",
        x_label="step",
        y_label="score",
        lines=tuple(
            Line(name=f"run {run}" if len(runs) > 1 else "score", role="attack", points=tuple(points))
            for run, points in list(runs.items())[:6]
        ),
        level=(confidence, "enough for success") if is_confidence else None,
    )


def _by_angle(record: Record, angle: str, needed: float) -> Chart:
    parts = [part for part in record.get(f"by_{angle}", ()) if part["total"]]
    points = tuple(Point.of((part["from"] + part["to"]) / 2, Rate.of(part)) for part in parts if len(parts) > 1)
    return Chart(
        title=f"Success by {angle}",
        caption=(
            "Held-out views in equal parts of the region; bands are 95 % intervals. "
            f"Of all views {percent(needed)} are asked for."
        ),
        x_label=f"{angle} of the camera, degrees",
        y_label="views with success",
        lines=(Line(name="attacked", role="attack", points=points),),
        level=(needed, "asked for"),
    )


# Scoring again


def objective_of(record: Record) -> Objective:
    """The aim of an attack."""
    try:
        name, values = str(record["objective"]), record["config"]["objective"]
        if name not in _AIMS and "kind" not in values:
            do = "score it again in the program that made it, or bring the objective as a plug-in"
            raise InvalidValueError.of(f"objective {name[:40]}", "one that is known by its name", "functions", do)
        aim: Objective = _AIMS.get(name, (PluggedObjective,))[0](**values)
    except (KeyError, TypeError) as error:
        expected, do = f"the settings of one of {', '.join(_AIMS)}", "get the result again"
        raise InvalidValueError.of("objective", expected, repr(error), do) from error
    return aim


def _cells(record: Record, seen: ViewDetections, row: Record, detector: Detector) -> Row:
    """What a detector says of an attacked picture: whether the aim is reached."""
    if seen.box is None:
        raise InvalidValueError.of(CAMERAS, "a box of the object in each view", "none", "get the result again")
    classes = tuple(detector.classes)
    target = Target(box=seen.box, label=record["target"], classes=classes, original=row["original"])
    return verdict_cells(objective_of(record).verdict(seen.detections, target))


def _rescored(record: Record, rows: pl.DataFrame) -> dict[str, dict[str, Rate]]:
    """How often the aim is reached with each detector."""
    names = {"success": "the aim is reached", "unambiguous": "so, and no other class has more confidence"}
    measures = {words: Measure(holds=pl.col(name)) for name, words in names.items()}
    return {name: rates for (name,), rates in count(rows.filter(splat=ATTACKED), measures, ("detector",)).items()}


RESCORING = Rescoring(
    splats=lambda record: {(ATTACKED, int(record["seed"])): "attacked.ply"}, cells=_cells, rates=_rescored, batch=1
)
"""One picture at a time, as attacks are judged: the same bits."""
