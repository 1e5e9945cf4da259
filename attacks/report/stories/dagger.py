"""What `mi-splat dagger` leaves behind: one object, some cameras, one or several detectors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import polars as pl

from attacks.detectors.base import Detector
from attacks.objectives import Hide, Objective, Relabel, Target, Untargeted
from attacks.observe.look import verdict_cells
from attacks.observe.places import CAMERAS
from attacks.observe.rates import Measure, count
from attacks.observe.rows import ATTACKED, Row
from attacks.observe.views import ViewDetections
from attacks.rate import Rate
from attacks.report.rescoring import Rescoring
from attacks.report.section import Chart, Figure, Line, Picture, Point, Section, Table, doubts_of, shown
from attacks.report.wording import listed, number, percent, plural, sentence, settings
from mi_splat.errors import InvalidValueError, message

KIND = "DAGGER, from chosen cameras"
_AIMS: dict[str, type[Any]] = {"relabel": Relabel, "hide": Hide, "untargeted": Untargeted}


def read(folder: Path, result: Mapping[str, Any]) -> Section:
    """The section of a result.

    Args:
        folder: Where it lies.
        result: Its result.json.
    """
    views, config = result["views"], result["config"]
    rate = Rate(successes=sum(view["success"] for view in views), total=len(views))
    noise = Rate(successes=result["noise"]["successes"], total=result["noise"]["draws"])
    names = [one["detector"] for one in result["detectors"]]
    cameras = len(views) // len(names)
    return Section(
        kind=KIND,
        title=f"{thing(result)} {wish(result)}",
        folder=str(folder),
        done=(
            f"The Gaussians of one object ({thing(result)}: {result['object_gaussians']:,} Gaussians, of which "
            f"{result['changed_gaussians']:,} changed) were moved within {ball(result)}, in at most "
            f"{plural(config['steps'], 'step')}, to make {listed(names)} {verb(result)} from "
            f"{plural(cameras, 'camera')}. The attacker knows the detector's weights. Success was judged on the saved "
            "file, rendered again, in 8-bit pictures."
        ),
        conclusion=_conclusion(result, rate, noise),
        headline=Figure(
            label=f"views with the aim reached: {verb(result)}",
            rate=rate,
            note=f"confidence {percent(result['score'])}" if result["target"] else f"score {percent(result['score'])}",
        ),
        control=Figure(label="random noise of the same size, draws with the same success", rate=noise)
        if noise.total
        else None,
        figures=_figures(result),
        warnings=tuple(
            sentence(text) for text in (*result["warnings"], *doubts_of(rate, noise, what="views"), *_few_draws(noise))
        ),
        pictures=_pictures(folder, result),
        charts=_charts(result),
        tables=(_views(result),),
        configuration=settings({**config, **_conditions(result)}),
    )


def objective_of(record: Mapping[str, Any]) -> Objective:
    """The aim of an attack.

    Raises:
        InvalidValueError: It is none of this version's.
    """
    try:
        aim: Objective = _AIMS[str(record["objective"])](**record["config"]["objective"])
    except (KeyError, TypeError) as error:
        expected, do = f"the settings of one of {', '.join(_AIMS)}", "get the result again"
        raise InvalidValueError(message("objective", expected, repr(error), do)) from error
    return aim


def _splats(record: Mapping[str, Any]) -> dict[tuple[str, int], str]:
    return {(ATTACKED, int(record["seed"])): "attacked.ply"}


def _cells(record: Mapping[str, Any], seen: ViewDetections, row: Mapping[str, Any], detector: Detector) -> Row:
    """What a detector says of an attacked picture: whether the aim is reached."""
    if seen.box is None:
        raise InvalidValueError(message(CAMERAS, "a box of the object in each view", "none", "get the result again"))
    classes = tuple(detector.classes)
    target = Target(box=seen.box, label=record["target"], classes=classes, original=row["original"])
    return verdict_cells(objective_of(record).verdict(seen.detections, target))


def _rescored(record: Mapping[str, Any], rows: pl.DataFrame) -> dict[str, dict[str, Rate]]:
    """How often the aim is reached, by each detector and by all at once."""
    attacked = rows.filter(splat=ATTACKED)
    names = {"success": "the aim is reached", "unambiguous": "so, and no other class has more confidence"}
    measures = {words: Measure(holds=pl.col(name)) for name, words in names.items()}
    return {name: rates for (name,), rates in count(attacked, measures, ("detector",)).items()}


RESCORING = Rescoring(splats=_splats, cells=_cells, rates=_rescored, batch=1)
"""One picture at a time, as attacks are judged: the same bits."""


def thing(result: Mapping[str, Any]) -> str:
    """The attacked object in a word or two."""
    return object_of(result, result["views"], otherwise="the selection")


def object_of(result: Mapping[str, Any], seen: Iterable[Mapping[str, Any]], *, otherwise: str) -> str:
    """The name of the attacked object, or else the first class that was reported on it.

    Args:
        result: A result.json.
        seen: Its views or its detectors, with the class in `original`.
        otherwise: What it is called if nothing was reported.
    """
    selection = result.get("selection")
    if isinstance(selection, Mapping) and "object" in selection:
        return str(selection["object"])
    return next((str(one["original"]) for one in seen if one.get("original")), otherwise)


def wish(result: Mapping[str, Any]) -> str:
    """What the attacker wants, as part of a title."""
    return {"relabel": f"to {result['target']}", "hide": "to nothing"}.get(result["objective"], "to anything else")


def verb(result: Mapping[str, Any]) -> str:
    """What a detector shall do."""
    return {"relabel": f"report {result['target']}", "hide": "report nothing"}.get(
        result["objective"], "report something else"
    )


def ball(result: Mapping[str, Any]) -> str:
    """The budget in words."""
    radii = ", ".join(f"{eps:g} over {name}" for name, eps in result["radius"].items())
    return f"a ball ({result['norm']}: {radii})"


def _few_draws(noise: Rate) -> list[str]:
    return [f"Few draws of noise: {noise.total}. Ask for more with --noise-draws."] if 0 < noise.total < 5 else []


def _conclusion(result: Mapping[str, Any], rate: Rate, noise: Rate) -> str:
    view, outcome = result["views"][0], "reached its aim" if result["success"] else "did not reach its aim"
    before = f"{view['original']} at {percent(view['clean_confidence'])}" if view["original"] else "nothing"
    after = _after(view, result["target"])
    control = (
        f" Random noise of the same size had the same success in {noise.successes} of {noise.total} draws."
        if noise.total
        else ""
    )
    return (
        f"The attack {outcome}, {rate.successes} of {plural(rate.total, 'view')}. In the first view "
        f"{view['detector']} reported {before} on the object before, and {after} after it.{control} This says nothing "
        "of other cameras, detectors or renderers."
    )


def _after(view: Mapping[str, Any], target: str | None) -> str:
    words = [f"{target} at {percent(view['target_confidence'])}"] if target else []
    if view["original"] not in (None, target):
        words.append(f"{view['original']} at {percent(view['original_confidence'])}")
    return " and ".join(words) or "nothing known"


def _figures(result: Mapping[str, Any]) -> tuple[Figure, ...]:
    image = result["image"]
    pairs = [
        ("pictures, attacked against clean", number(result["image_psnr"], unit="dB")),
        ("the same on the object", number(image["psnr_object"], unit="dB")),
        ("largest change beside the object (1 is all)", f"{image['outside']:.3f}"),
        ("Gaussians changed, of the object's", f"{result['changed_gaussians']:,} of {result['object_gaussians']:,}"),
        *((f"size of the change, {name}", f"{used:.3g}") for name, used in result["used_in_file"].items()),
        ("steps taken", f"{result['steps']} of {result['config']['steps']}"),
        ("best score of the noise", percent(max(result["noise"]["scores"], default=0.0))),
        ("time", number(result["seconds"], ".0f", "s")),
    ]
    notes = {"pictures, attacked against clean": "PSNR; 26 is easily seen, 40 hardly"}
    return tuple(Figure(label=label, words=words, note=notes.get(label, "")) for label, words in pairs)


def _conditions(result: Mapping[str, Any]) -> dict[str, Any]:
    """What else a result depends on."""
    names = ("scene", "selection", "cameras", "background", "near", "scene_hash")
    found = {name: result[name] for name in names if name in result}
    weights = {one["detector"]: one["detector_fingerprint"] for one in result["detectors"]}
    return {**found, "weights": weights}


def _pictures(folder: Path, result: Mapping[str, Any]) -> tuple[Picture, ...]:
    view = result["views"][0]
    said = f"before: {_seen(view['clean'])}; after: {_seen(view['attacked'])}"
    return shown(
        [
            Picture(
                path=folder / "detections.png",
                caption="What the detector reports: before the attack on the left, after it on the right.",
                alt=f"The same picture twice with boxes, {said}",
                wide=True,
            ),
            Picture(
                path=folder / "difference.png",
                caption="What has changed, enlarged; grey is no change.",
                alt="The difference of both pictures: it lies on the object",
            ),
        ]
    )


def _seen(detections: Sequence[Mapping[str, Any]], least: float = 0.3) -> str:
    found = [f"{one['label']} {percent(one['score'])}" for one in detections if one["score"] >= least]
    return ", ".join(found) or "nothing"


def _views(result: Mapping[str, Any]) -> Table:
    rows = []
    names = result.get("cameras") or []
    for place, view in enumerate(result["views"]):
        camera = str(names[place % len(names)]) if names else f"view {place}"
        clean = f"{view['original']} {percent(view['clean_confidence'])}" if view["original"] else "nothing"
        target = "-" if view["target_confidence"] is None else percent(view["target_confidence"])
        before = view.get("target_confidence_clean")
        rows.append(
            (
                camera,
                view["detector"],
                clean,
                percent(view["original_confidence"]),
                "-" if before is None else percent(before),
                target,
                "yes" if view["success"] else "no",
            )
        )
    wanted = result["target"] or "target"
    head = ("camera", "detector", "before", "the same class after", f"{wanted} before", f"{wanted} after", "success")
    return Table(caption="Every view", head=head, rows=tuple(rows))


def _charts(result: Mapping[str, Any]) -> tuple[Chart, ...]:
    runs: dict[int, list[Point]] = {}
    for line in result["trace"]:
        runs.setdefault(line["restart"], []).append(Point(float(line["index"]), line["score"]))
    if max(map(len, runs.values()), default=0) < 2:
        return ()
    confidence = result["config"].get("objective", {}).get("confidence")
    level = None if confidence is None or result["objective"] != "relabel" else (confidence, "enough for success")
    lines = tuple(
        Line(name="score" if len(runs) == 1 else f"run {run}", role="attack", points=tuple(points))
        for run, points in runs.items()
    )
    return (
        Chart(
            title="The search",
            caption="Score at each step: the confidence in what is wanted that enough views reach.",
            x_label="step",
            y_label="score",
            lines=lines[:6],
            level=level,
        ),
    )
