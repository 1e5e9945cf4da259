"""A finished attack of DAGGER as an artifact: every detection before and after is a row."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from attacks.artifacts.contents import Contents, read_object
from attacks.artifacts.dagger_results import broken, cameras_of, contents_of, mask_of, objective_of, splat_of
from attacks.artifacts.detection_rows import DETECTION, OBJECT, detection_cells, detections_of, object_box
from attacks.artifacts.packed import Kind, Outcome, Packed
from attacks.artifacts.rows import Column, Row, Table
from attacks.dagger.report import confidences
from attacks.dagger.result import STILL_REPORTED
from attacks.detectors.base import Detections
from attacks.objectives import Target, Verdict, confidence, joint_verdict, reached_by
from mi_splat.io.folders import RECORD as RESULT

ROWS, NOISE = "rows", "noise"
CLEAN, ATTACKED = "clean", "attacked"
_STATED = (
    *("image_psnr", "image", "steps", "used", "used_in_file", "changed_gaussians", "object_gaussians"),
    *("clamped_fraction", "warnings"),
)
_OF_VIEW = (
    *("detector", "success", "unambiguous", "original", "clean_confidence", "original_confidence"),
    *("target_confidence", "target_confidence_clean"),
)
_COLUMNS = (
    Column(name="view", kind="whole", meaning="number of the camera in cameras.json, from 0"),
    Column(name="detector", kind="text", meaning="name of the detector"),
    Column(name="scene", kind="text", meaning="clean or attacked"),
    Column(name="original", kind="text", meaning="what the detector calls the clean object", optional=True),
    *(Column(name=name, kind="number", unit="pixels", meaning=f"{name} of the object's box") for name in OBJECT),
    *DETECTION,
)
_NOISE_COLUMNS = (
    Column(name="draw", kind="whole", meaning="number of the draw of random noise, from 0"),
    Column(name="view", kind="whole", meaning="number of the camera in cameras.json, from 0"),
    Column(name="detector", kind="text", meaning="name of the detector"),
    Column(name="success", kind="truth", meaning="whether the aim is reached with the noise"),
    Column(name="score", kind="number", meaning="how near the aim is, in [0, 1]"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class _View:
    """One view as one detector sees it, put together from its rows."""

    number: int
    detector: str
    target: Target
    clean: Detections
    attacked: Detections
    verdict: Verdict

    @property
    def strict(self) -> bool:
        """Whether the aim is reached, and the object's own class is gone."""
        own = self.target.original
        return self.verdict.success and (own is None or self.confidence(own, attacked=True) < STILL_REPORTED)

    def confidence(self, label: str | None, *, attacked: bool) -> float:
        found = self.attacked if attacked else self.clean
        return confidence(found, self.target.box, labels=None if label is None else [label])


def pack(folder: Path, stages: Path | None) -> Packed:
    """What an artifact of a finished attack holds; the arguments are those of `attacks.artifacts.packed.Pack`.

    Raises:
        InvalidValueError: The folder holds no such result.
    """
    result = read_object(folder / RESULT)
    try:
        tables = tables_of(result)
        fingerprints = {one["detector"]: one["detector_fingerprint"] for one in result["detectors"]}
        contents = contents_of(
            result,
            tables,
            fingerprints,
            _STATED if NOISE in tables else (*_STATED, "noise"),
            folder=folder,
        )
        cameras = cameras_of(result, dict(_numbered(result)[: len(result["views"]) // len(fingerprints)]))
        figures = figures_of(result, tables)
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise broken(folder / RESULT, error) from error
    files = mask_of(result, folder)
    return Packed(contents=contents, figures=figures, cameras=cameras, files=files, splats=splat_of(folder))


def tables_of(result: Mapping[str, Any]) -> dict[str, Table]:
    """The rows of an attack, and those of its control if the result holds them.

    Args:
        result: Its result.json.
    """
    numbered = _numbered(result)
    tables = {ROWS: Table(columns=_COLUMNS, rows=tuple(row for i, view in numbered for row in _rows(view, i)))}
    noise = tuple(row for i, view in numbered for row in _noise_rows(view, i))
    return {**tables, NOISE: Table(columns=_NOISE_COLUMNS, rows=noise)} if noise else tables


def figures_of(result: Mapping[str, Any], tables: Mapping[str, Table]) -> dict[str, Any]:
    """The figures of an attack that its rows have to give.

    Args:
        result: Its result.json.
        tables: From `tables_of`.
    """
    figures = {key: result[key] for key in ("success", "unambiguous", "strict", "score", "target_confidence")}
    figures["views"] = [{key: view[key] for key in _OF_VIEW} for view in result["views"]]
    return {**figures, "noise": result["noise"]} if NOISE in tables else figures


def _numbered(result: Mapping[str, Any]) -> list[tuple[int, Mapping[str, Any]]]:
    """The views with the number of their camera: those of each detector follow each other."""
    per_detector = len(result["views"]) // len(result["detectors"])
    return [(i % per_detector, view) for i, view in enumerate(result["views"])]


def derive(contents: Contents) -> Mapping[str, Any]:
    """What the attack reached, of its rows alone.

    Raises:
        InvalidValueError: The rows are not those of the attack.
    """
    objective, label = objective_of(contents.configuration), contents.configuration.get("target")
    try:
        config = contents.configuration["config"]
        views = list(_views(contents))
        by_detector = {name: [view for view in views if view.detector == name] for name in contents.detectors}
        verdicts = [
            joint_verdict([view.verdict for view in own], config["required_views"]) for own in by_detector.values()
        ]
        whole = joint_verdict(verdicts, config["required_detectors"])
        reached = [
            reached_by([view.confidence(label, attacked=True) for view in own], config["required_views"])
            for own in by_detector.values()
        ]
        figures = {
            "success": whole.success,
            "unambiguous": whole.unambiguous,
            "strict": _strict(by_detector, config),
            "score": whole.score,
            "target_confidence": None if objective.label is None else reached_by(reached, config["required_detectors"]),
            "views": [_of_view(view, label) for view in views],
        }
        return {**figures, "noise": _noise_of(contents)} if NOISE in contents.tables else figures
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise broken("rows", error) from error


def _strict(by_detector: Mapping[str, Sequence[_View]], config: Mapping[str, Any]) -> bool:
    """As `attacks.dagger.result.Result.strict`."""
    joint = [
        joint_verdict([replace(view.verdict, success=view.strict) for view in own], config["required_views"])
        for own in by_detector.values()
    ]
    return joint_verdict(joint, config["required_detectors"]).success


def _noise_of(contents: Contents) -> dict[str, Any]:
    """The control: what each draw of noise reached over all views and detectors."""
    config, draws = contents.configuration["config"], dict[Any, dict[Any, list[Verdict]]]()
    for row in contents.tables[NOISE].rows:
        success, score = bool(row["success"]), float(row["score"] or 0.0)
        own = draws.setdefault(row["draw"], {}).setdefault(row["detector"], [])
        own.append(Verdict(success=success, score=score, unambiguous=success))
    verdicts = [
        joint_verdict(
            [joint_verdict(own, config["required_views"]) for own in by_detector.values()], config["required_detectors"]
        )
        for _, by_detector in sorted(draws.items())
    ]
    return {
        "scores": [verdict.score for verdict in verdicts],
        "successes": sum(verdict.success for verdict in verdicts),
        "draws": len(verdicts),
    }


def _of_view(view: _View, label: str | None) -> dict[str, Any]:
    original = view.target.original
    return {
        "detector": view.detector,
        "success": view.verdict.success,
        "unambiguous": view.verdict.unambiguous,
        **confidences(view.confidence, original, label),
    }


def _views(contents: Contents) -> Iterator[_View]:
    """The views of each detector, in the order of the rows."""
    objective, groups = objective_of(contents.configuration), dict[tuple[Any, Any], list[Row]]()
    for row in contents.tables[ROWS].rows:
        groups.setdefault((row["detector"], row["view"]), []).append(row)
    for (detector, number), rows in groups.items():
        clean, attacked = ([row for row in rows if row["scene"] == scene] for scene in (CLEAN, ATTACKED))
        if not clean or not attacked or len(clean) + len(attacked) != len(rows):
            raise ValueError(f"{detector}: rows of a clean and an attacked scene are needed")
        seen = detections_of(attacked)
        original, box = rows[0]["original"], object_box(rows[0])
        if box is None:
            raise ValueError(f"{detector}: a view without a box of the object")
        target = Target(
            box=box,
            label=contents.configuration.get("target"),
            classes=tuple(seen.labels),
            original=None if original is None else str(original),
        )
        verdict = objective.verdict(seen, target)
        yield _View(
            number=number, detector=detector, target=target, clean=detections_of(clean), attacked=seen, verdict=verdict
        )


def _rows(view: Mapping[str, Any], number: int) -> Iterator[Row]:
    """A row for each detection of one view, clean and attacked; one with an empty detection where there is none."""
    place = {"view": number, "detector": view["detector"], "original": view["original"]}
    corners = dict(zip(OBJECT, view["box"], strict=True))
    for scene in (CLEAN, ATTACKED):
        for found in view[scene] or [None]:
            yield {**place, "scene": scene, **corners, **detection_cells(found, view["box"])}


def _noise_rows(view: Mapping[str, Any], number: int) -> Iterator[Row]:
    """A row for each draw of noise in one view; none of an older result, which does not hold them."""
    held = zip(view.get("noise_successes", ()), view.get("noise_scores", ()), strict=True)
    for draw, (success, score) in enumerate(held):
        yield {"draw": draw, "view": number, "detector": view["detector"], "success": success, "score": score}


def outcomes(contents: Contents) -> list[Outcome]:
    """What the rows say of the attacked splat."""
    return [
        Outcome(
            view=view.number,
            detector=view.detector,
            original=view.target.original,
            success=view.verdict.success,
            unambiguous=view.verdict.unambiguous,
        )
        for view in _views(contents)
    ]


def columns(contents: Contents) -> Mapping[str, Sequence[Column]]:
    """The tables of such an artifact."""
    return {ROWS: _COLUMNS, NOISE: _NOISE_COLUMNS}


KIND = Kind(pack=pack, derive=derive, columns=columns, further=(NOISE,), outcomes=outcomes)
