"""What `mi-splat dagger` and `dagger-eot` leave behind: one object, from chosen cameras or from all of a region."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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
from attacks.rate import Rate, percent
from attacks.report.rescoring import Rescoring
from attacks.report.section import Chart, Figure, Line, Picture, Point, Section, doubts_of
from attacks.report.wording import listed, number, plural, pooled, settings
from attacks.tables import Table, cell
from mi_splat.errors import InvalidValueError, message

Result = Mapping[str, Any]

_AIMS: dict[str, type[Any]] = {"relabel": Relabel, "hide": Hide, "untargeted": Untargeted}
_RATES = {
    "success": "attacked: success",
    "noise": "random noise: success",
    "clean": "no attack: success",
    "found_clean": "clean object found",
    "found_attacked": "attacked object found",
}
_CONDITIONS = ("scene", "selection", "cameras", "reference", "background", "near", "scene_hash", "redraws")
FEW_DRAWS = 5
"""Draws of noise from which on they say something."""


def read_fixed(folder: Path, result: Result) -> Section:
    """The section of an attack from chosen cameras.

    Args:
        folder: Where it lies.
        result: Its result.json.
    """
    rate = pooled(Rate.of(one["success"]) for one in result["rates"].values())
    noise = Rate(successes=result["noise"]["successes"], total=result["noise"]["draws"])
    names, config = list(result["rates"]), result["config"]
    few = [f"Few draws of noise: {noise.total}. Ask for more with --noise-draws"] if 0 < noise.total < FEW_DRAWS else []
    return Section(
        kind="DAGGER, from chosen cameras",
        title=f"{thing(result)} {wish(result)}",
        done=(
            f"The Gaussians of one object ({thing(result)}: {result['object_gaussians']:,} Gaussians, of which "
            f"{result['changed_gaussians']:,} changed) were moved within {ball(result)}, in at most "
            f"{plural(config['steps'], 'step')}, to make {listed(names)} {verb(result)} from "
            f"{plural(len(result['views']) // len(names), 'camera')}. The attacker knows the detector's weights. "
            "Success was judged on the saved file, rendered again, in 8-bit pictures."
        ),
        conclusion=_of_first_view(result, rate, noise),
        headline=Figure(
            label=f"views with the aim reached: {verb(result)}",
            rate=rate,
            note=f"{'confidence' if result['target'] else 'score'} {percent(result['score'])}",
        ),
        control=Figure(label="random noise of the same size, draws with the same success", rate=noise)
        if noise.total
        else None,
        figures=tuple(_figures(result, "PSNR; 26 is easily seen, 40 hardly")),
        warnings=(*result["warnings"], *doubts_of(rate, noise, what="views"), *few),
        pictures=_pictures(folder, result["views"][0]),
        charts=tuple(_search(result)),
        tables=(_views(result),),
        configuration=_configuration(result),
    )


def read_drawn(folder: Path, result: Result) -> Section:
    """The section of an attack on all cameras of a region.

    Args:
        folder: Where it lies.
        result: Its result.json.
    """
    rate, noise, clean = (Rate.of(result[name]) for name in ("rate", "noise_rate", "clean_rate"))
    config, names = result["config"], list(result["rates"])
    needed, budget = config["required_views"], config["image_psnr"]
    asked = "" if budget is None else f", while the pictures keep {budget:g} dB"
    control = f" Random noise of the same size: {noise.successes} of {noise.total}." if noise.total else ""
    sure = Figure(label="success without another class of more confidence", rate=Rate.of(result["unambiguous_rate"]))
    return Section(
        kind="DAGGER, from all cameras of a region",
        title=f"{thing(result)} {wish(result)}, all cameras",
        done=(
            f"The Gaussians of one object ({result['object_gaussians']:,}, of which {result['changed_gaussians']:,} "
            f"changed) were moved within {ball(result)}{asked}, in {plural(config['steps'], 'step')} over random "
            f"cameras of a region, to make {listed(names)} {verb(result)}. The attacker knows the weights. "
            f"{plural(rate.total, 'view')} that the search has never seen judged the saved file, in 8-bit pictures."
        ),
        conclusion=(
            f"From cameras that the search has not seen, the attack {'holds' if result['success'] else 'does not hold'}"
            f": {rate.successes} of {plural(rate.total, 'view')}, where {percent(needed)} are asked for.{control} This "
            "says nothing of detectors that were not attacked."
        ),
        headline=Figure(label=f"held-out views with the aim reached: {verb(result)}", rate=rate),
        control=Figure(label="random noise of the same size, on the same views", rate=noise) if noise.total else None,
        figures=(
            Figure(label="no attack, on the same views", rate=clean),
            sure,
            *_figures(result, "PSNR of the mean squared error over all views; 26 is easily seen, 40 hardly"),
        ),
        warnings=(*result["warnings"], *doubts_of(rate, noise, what="held-out views")),
        pictures=(
            Picture(
                path=folder / "held_out.png",
                caption="Held-out views all around: clean on the left of each pair, attacked on the right.",
                alt=f"Pairs of pictures with boxes; the aim is reached in {rate.successes} of {rate.total} views",
                wide=True,
            ),
        ),
        charts=(*_by_angles(result, needed), *_search(result)),
        tables=(
            Table(
                caption="Each detector on the held-out views",
                head=("rate", *names),
                rows=tuple(
                    (words, *(cell(one[key]) for one in result["rates"].values())) for key, words in _RATES.items()
                ),
            ),
        ),
        configuration=_configuration(result),
    )


def _configuration(result: Result) -> tuple[tuple[str, str], ...]:
    weights = {one["detector"]: one["detector_fingerprint"] for one in result["detectors"]}
    conditions = {name: result[name] for name in _CONDITIONS if name in result}
    return settings({**result["config"], **conditions, "weights": weights})


def thing(result: Result) -> str:
    """The name of the attacked object, or else the first class that was reported on it."""
    selection = result.get("selection")
    if isinstance(selection, Mapping) and "object" in selection:
        return str(selection["object"])
    return next((str(one["original"]) for one in result["rates"].values() if one.get("original")), "the selection")


def wish(result: Result) -> str:
    """What the attacker wants, as part of a title."""
    return {"relabel": f"to {result['target']}", "hide": "to nothing"}.get(result["objective"], "to anything else")


def verb(result: Result) -> str:
    """What a detector shall do."""
    wanted = {"relabel": f"report {result['target']}", "hide": "report nothing"}
    return wanted.get(result["objective"], "report something else")


def ball(result: Result) -> str:
    """The budget in words."""
    radii = ", ".join(f"{eps:g} over {name}" for name, eps in result["radius"].items())
    return f"a ball ({result['norm']}: {radii})"


def _of_first_view(result: Result, rate: Rate, noise: Rate) -> str:
    view = result["views"][0]
    before = f"{view['original']} at {percent(view['clean_confidence'])}" if view["original"] else "nothing"
    after = [f"{result['target']} at {percent(view['target_confidence'])}"] if result["target"] else []
    if view["original"] not in (None, result["target"]):
        after.append(f"{view['original']} at {percent(view['original_confidence'])}")
    control = f" Random noise of the same size had the same success in {noise.successes} of {noise.total} draws."
    return (
        f"The attack {'reached' if result['success'] else 'did not reach'} its aim, {rate.successes} of "
        f"{plural(rate.total, 'view')}. In the first view {view['detector']} reported {before} on the object before, "
        f"and {' and '.join(after) or 'nothing known'} after it.{control if noise.total else ''} This says nothing of "
        "other cameras, detectors or renderers."
    )


def _figures(result: Result, psnr: str) -> Iterator[Figure]:
    """Figures that are not counted: what the pictures lost, the size of the change, steps and time."""
    image, noise = result["image"], [one for one in result["noise_psnr"] if one is not None]
    changed = f"{result['changed_gaussians']:,} of {result['object_gaussians']:,}"
    pairs = [
        ("the same on the object", number(image["psnr_object"], unit="dB")),
        ("the same with the noise", number(noise[0], unit="dB") if noise else "-"),
        ("largest change beside the object (1 is all)", f"{image['outside']:.3f}"),
        ("Gaussians changed, of the object's", changed),
        *((f"size of the change, {name}", f"{used:.3g}") for name, used in result["used_in_file"].items()),
        ("steps taken", f"{result['steps']} of {result['config']['steps']}"),
        ("best score of the noise", percent(max(result["noise"]["scores"], default=0.0))),
        ("time", number(result["seconds"], ".0f", "s")),
    ]
    yield Figure(label="pictures, attacked against clean", words=number(result["image_psnr"], unit="dB"), note=psnr)
    yield from (Figure(label=label, words=words) for label, words in pairs)


def _pictures(folder: Path, view: Mapping[str, Any]) -> tuple[Picture, ...]:
    said = f"before: {_seen(view['clean'])}; after: {_seen(view['attacked'])}"
    return (
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
    )


def _seen(detections: Sequence[Mapping[str, Any]], least: float = 0.3) -> str:
    reports = [f"{one['label']} {percent(one['score'])}" for one in detections if one["score"] >= least]
    return ", ".join(reports) or "nothing"


def _views(result: Result) -> Table:
    """Every view as every detector sees it."""
    names, wanted = result.get("cameras") or [], result["target"] or "target"
    rows = tuple(
        (
            str(names[place % len(names)]) if names else f"view {place}",
            view["detector"],
            f"{view['original']} {percent(view['clean_confidence'])}" if view["original"] else "nothing",
            percent(view["original_confidence"]),
            *(
                "-" if view[key] is None else percent(view[key])
                for key in ("target_confidence_clean", "target_confidence")
            ),
            "yes" if view["success"] else "no",
        )
        for place, view in enumerate(result["views"])
    )
    head = ("camera", "detector", "before", "the same class after", f"{wanted} before", f"{wanted} after", "success")
    return Table(caption="Every view", head=head, rows=rows)


def _search(result: Result) -> Iterator[Chart]:
    """The score over the steps of the search, a line for each run."""
    runs: dict[int, list[Point]] = {}
    for line in result["trace"]:
        if "score" in line:
            runs.setdefault(line["restart"], []).append(Point(float(line["index"]), line["score"]))
    if max(map(len, runs.values()), default=0) < 2:
        return
    confidence = result["config"]["objective"].get("confidence")
    is_confidence = result["story"] == "dagger" and result["objective"] == "relabel" and confidence is not None
    level = (confidence, "enough for success") if is_confidence else None
    lines = [(f"run {run}" if len(runs) > 1 else "score", points) for run, points in runs.items()]
    yield Chart(
        title="The search",
        caption="Score at each step that was judged.",
        x_label="step",
        y_label="score",
        lines=tuple(Line(name=name, role="attack", points=tuple(points)) for name, points in lines[:6]),
        level=level,
    )


def _by_angles(result: Result, needed: float) -> Iterator[Chart]:
    for angle in ("azimuth", "elevation"):
        parts = [part for part in result[f"by_{angle}"] if part["total"]]
        if len(parts) > 1:
            points = tuple(Point.of((part["from"] + part["to"]) / 2, Rate.of(part)) for part in parts)
            yield Chart(
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


def objective_of(record: Result) -> Objective:
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


def _splats(record: Result) -> dict[tuple[str, int], str]:
    return {(ATTACKED, int(record["seed"])): "attacked.ply"}


def _cells(record: Result, seen: ViewDetections, row: Mapping[str, Any], detector: Detector) -> Row:
    """What a detector says of an attacked picture: whether the aim is reached."""
    if seen.box is None:
        raise InvalidValueError(message(CAMERAS, "a box of the object in each view", "none", "get the result again"))
    classes = tuple(detector.classes)
    target = Target(box=seen.box, label=record["target"], classes=classes, original=row["original"])
    return verdict_cells(objective_of(record).verdict(seen.detections, target))


def _rescored(record: Result, rows: pl.DataFrame) -> dict[str, dict[str, Rate]]:
    """How often the aim is reached with each detector."""
    names = {"success": "the aim is reached", "unambiguous": "so, and no other class has more confidence"}
    measures = {words: Measure(holds=pl.col(name)) for name, words in names.items()}
    return {name: rates for (name,), rates in count(rows.filter(splat=ATTACKED), measures, ("detector",)).items()}


RESCORING = Rescoring(splats=_splats, cells=_cells, rates=_rescored, batch=1)
"""One picture at a time, as attacks are judged: the same bits."""
