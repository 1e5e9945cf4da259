"""Scoring the splats of a study of CLOAK again: needs the splats, the cameras and a detector, and nothing else."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from attacks.artifacts.checking import Checked
from attacks.artifacts.cloak import splat_file
from attacks.artifacts.cloak_rows import observed_of
from attacks.artifacts.contents import CAMERAS, read_object
from attacks.artifacts.figures import Line
from attacks.artifacts.study_results import study_of
from attacks.cloak.study.config import StudyConfig
from attacks.cloak.study.markdown import ROWS
from attacks.cloak.study.observations import Observation, ObservedSplat, observation_of
from attacks.cloak.study.rates import pairs, rates
from attacks.detectors.base import Detector
from attacks.evaluation.rates import Rate
from attacks.evaluation.views import detect_views
from mi_splat.cameras import Camera
from mi_splat.cli.camera_records import recorded_cameras
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import load_splat
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene, scene_hash

RATE_TOLERANCE = 0.02
"""How far a rate may move: another machine rounds otherwise, and a score near the threshold crosses it."""

OnView = Callable[[int, int], None]
"""Told how many pictures were looked at, and of how many."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Places:
    """What cameras.json says.

    Attributes:
        cameras: The cameras by number.
        boxes: (4,) pixels of the object in each; None where it does not show.
        settings: Of the renderer.
    """

    cameras: tuple[Camera, ...]
    boxes: tuple[Tensor | None, ...]
    settings: RenderSettings


def rescore(
    checked: Checked,
    detectors: Sequence[Detector],
    *,
    splats: Path | None = None,
    every: int = 1,
    rate_tolerance: float = RATE_TOLERANCE,
    on_view: OnView = lambda done, total: None,
) -> list[Line]:
    """Render the splats of an artifact, let detectors look, and say how every rate moved.

    Args:
        checked: The artifact, of a study of CLOAK.
        detectors: Those of the artifact or others.
        splats: Folder with the splats; None takes those in the artifact.
        every: Looks from each so manieth camera; the rates of the rows are then those of the same cameras.
        rate_tolerance: How far a rate may move.
        on_view: Told of the progress.

    Returns:
        A line for each detector and rate; grey for a detector that the artifact does not have.

    Raises:
        InvalidValueError: The artifact is of another kind, a splat is not there or another one, or cameras.json is
            broken.
    """
    if checked.contents.kind != "cloak":
        do = "look at the splat itself with mi-splat evaluate"
        raise InvalidValueError(message(str(checked.found.folder), "a study of CLOAK", checked.contents.kind, do))
    study = study_of(checked.contents.configuration, "configuration")
    before = observed_of(study, checked.contents.splats, checked.contents.tables)
    places, scenes = _places(checked.found.folder / CAMERAS), _scenes(checked, splats)
    views = sorted({one.view for item in before for one in item.observations})
    if len(views) > len(places.cameras) or views[-1:] != [len(places.cameras) - 1]:
        raise _wrong(CAMERAS, f"{len(views)} cameras, those of the rows", len(places.cameras))
    chosen, done = views[::every], 0
    total, after = len(chosen) * len(detectors) * len(scenes), []
    for item, scene in zip(before, scenes, strict=True):
        seen = []
        for observation in _look(study, scene, places, chosen, detectors):
            seen.append(observation)
            on_view(done := done + 1, total)
        after.append(replace(item, observations=tuple(seen)))
    return [line for one in detectors for line in _moved(study, (before, after), one, checked, rate_tolerance)]


def _look(
    study: StudyConfig, scene: GaussianScene, places: Places, views: Sequence[int], detectors: Sequence[Detector]
) -> Sequence[Observation] | Any:
    """What detectors report of one splat from some of the cameras."""
    found = detect_views(
        scene,
        [places.cameras[view] for view in views],
        detectors,
        render=Renderer(places.settings),
        boxes=[places.boxes[view] for view in views],
    )
    for one in found:
        yield replace(observation_of(study, one), view=views[one.view])


def _moved(
    study: StudyConfig,
    observed: tuple[Sequence[ObservedSplat], Sequence[ObservedSplat]],
    detector: Detector,
    checked: Checked,
    tolerance: float,
) -> list[Line]:
    """A line for each rate of one detector."""
    before, after = observed
    views = {one.view for item in after for one in item.observations}
    same = [replace(item, observations=tuple(one for one in item.observations if one.view in views)) for item in before]
    old, new = (rates(study, pairs(which, detector.name)) for which in (same, after))
    known = checked.contents.detectors.get(detector.name)
    lines = []
    for name, words in ROWS.items():
        now, then = new[name], old[name]
        if now is None or then is None:
            continue
        if known is None:
            lines.append(
                Line(name=f"{detector.name}, {words}", words=f"{_said(now)}; not in the artifact", passed=None)
            )
            continue
        moved = abs(now.fraction - then.fraction) if now.total and then.total else float(now.total != then.total)
        other = "" if known == detector.fingerprint else "; other weights than the artifact's"
        said = f"{_said(then)} in the rows, {_said(now)} now: moved by {moved:.1%}, may move by {tolerance:.1%}{other}"
        lines.append(Line(name=f"{detector.name}, {words}", words=said, passed=moved <= tolerance))
    return lines


def _said(rate: Rate) -> str:
    return f"{rate.successes}/{rate.total}"


def _places(path: Path) -> Places:
    """The cameras of an artifact."""
    values = read_object(path)
    cameras = recorded_cameras(path)
    try:
        entries = values["cameras"]
        boxes = tuple(_box(entry["box"]) for entry in entries)
        background = tuple(float(part) for part in values["background"])
        near = float(values["near"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise _wrong(str(path), "cameras, boxes, background and near", repr(error)) from error
    if cameras is None or list(cameras) != [str(number) for number in range(len(entries))]:
        raise _wrong(str(path), "cameras that are numbered from 0", "others")
    settings = RenderSettings(background=background, near=near)  # type: ignore[arg-type]  # it checks them
    return Places(cameras=tuple(cameras.values()), boxes=boxes, settings=settings)


def _box(value: Any) -> Tensor | None:
    if value is None:
        return None
    x0, y0, x1, y1 = map(float, value)
    if not all(map(math.isfinite, (x0, y0, x1, y1))):
        raise ValueError(f"the box {value}")
    return torch.tensor([x0, y0, x1, y1])


def _scenes(checked: Checked, splats: Path | None) -> list[GaussianScene]:
    """The splats of an artifact, each known by its hash."""
    first = min(int(entry["seed"]) for entry in checked.contents.splats)
    found = []
    for entry in checked.contents.splats:
        path = _splat_path(checked.found.folder, splats, entry, is_first=entry["seed"] == first)
        scene = load_splat(path)
        if scene_hash(scene) != entry["hash"]:
            expected = f"the {entry['splat']} splat, seed {entry['seed']} (hash {str(entry['hash'])[:16]})"
            raise _wrong(str(path), expected, f"another (hash {scene_hash(scene)[:16]})")
        found.append(scene)
    return found


def _splat_path(folder: Path, splats: Path | None, entry: Mapping[str, Any], *, is_first: bool) -> Path:
    """The file of a splat: in the artifact, or by the same name or that of a study's results in another folder."""
    name = Path(splat_file(entry)).name
    places = [folder / splat_file(entry)] if splats is None else [splats / name]
    if splats is not None and is_first:
        places.append(splats / f"{entry['splat']}.ply")
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        do = "pass the folder with the splats"
        raise InvalidValueError(message(str(places[0]), "a splat of the artifact", "none", do)).hinted("--splats")
    return path


def _wrong(what: str, expected: str, got: object) -> InvalidValueError:
    return InvalidValueError(message(what, expected, got, "get the artifact again"))
