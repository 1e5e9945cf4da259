"""What one detector reports from held-out cameras: on a splat, or in pictures that are there already."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

from attacks.cloak import setup
from attacks.cloak.config import EvaluationConfig, StudyConfig
from attacks.cloak.kinds.parts import SceneParts
from attacks.cloak.kinds.true_pictures import read_pictures
from attacks.detectors.base import Detector
from attacks.detectors.registry import load_detector
from attacks.observe.look import detection_rows, place_cells, report_cells, seen_from
from attacks.observe.rows import (
    DEPTH,
    DETECTION_BOX,
    DETECTIONS,
    POISON_DEPTH,
    ROWS,
    SUFFIX,
    TARGET_SCORE,
    Cell,
    Row,
    frame_of,
    frame_with,
    write_rows,
)
from attacks.observe.views import ViewDetections, detect_pictures
from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import load_splat
from mi_splat.rendering import Renderer, RenderSettings

if TYPE_CHECKING:
    from mi_splat.ledger import Out

DETECTION_COLUMNS = ("detector", "view", "label", "score", *DETECTION_BOX, "iou")
WEIGHTS = "weights"
"""Name of the input that is a file of weights; without it a detector has its usual ones."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenConfig:
    """Who looks at what, and from where.

    Attributes:
        parts: The scene, and the regions and target classes of all attacks.
        near: Near plane of a splat's pictures, world units.
        cameras: Held-out cameras, before those near a training camera are dropped.
        min_separation: Least angle to the nearest training camera, degrees.
        every: Each so manieth of those that are left looks.
        detector: Name of the detector.
        fingerprint: Of its weights.
    """

    parts: SceneParts
    near: float
    cameras: int
    min_separation: float
    detector: str
    fingerprint: str
    every: int = 1


def run(config: SeenConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Write a row for each camera and one for each detection; inputs are a `splat`, or `pictures` in its place.

    Raises:
        InvalidValueError: The detector has other weights than those that were asked for.
    """
    evaluation = EvaluationConfig(cameras=config.cameras, min_separation=config.min_separation)
    study = config.parts.study(inputs, evaluation=evaluation)
    target = setup.target_of(study.scene)
    cameras = setup.held_out_cameras(study, target)[:: config.every]
    detector = loaded(config.detector, inputs.get(WEIGHTS))
    if detector.fingerprint != config.fingerprint:
        do = "give the same weights to every process"
        raise InvalidValueError(message(f"weights of {detector.name}", config.fingerprint, detector.fingerprint, do))
    rows, detections = list[Row](), list[Row]()
    boxes = [setup.box_of(target, camera) for camera in cameras]
    for seen in detect_pictures(_picture(config, inputs, cameras), cameras, [detector], boxes=boxes):
        ids: dict[str, Cell] = {"detector": seen.detector, "view": seen.view}
        rows.append({**ids, **observation_cells(study, seen)})
        detections += detection_rows(ids, seen.detections, seen.box)
        out.progress(f"{detector.name} looks", len(rows), len(cameras))
    write_rows(frame_of(rows), out / f"{ROWS}{SUFFIX}")
    write_rows(frame_with(detections, DETECTION_COLUMNS), out / f"{DETECTIONS}{SUFFIX}")


def _picture(config: SeenConfig, inputs: Mapping[str, Path], cameras: Sequence[Camera]) -> Callable[[Camera], Tensor]:
    """What a camera sees: a picture that is there already, or one of the splat."""
    if "pictures" in inputs:
        return dict(zip(cameras, read_pictures(inputs["pictures"]).images, strict=True)).__getitem__
    scene = load_splat(inputs["splat"])
    render = Renderer(RenderSettings(background=config.parts.scene.background, near=config.near))
    return lambda camera: render(scene, camera)


def observation_cells(study: StudyConfig, seen: ViewDetections) -> dict[str, Cell]:
    """Where a camera is to the triggers, and what is reported on the object: the cells that rates count."""
    centre, wanted = setup.centre_of(study), [attack for attack in study.attack if attack.target_class]
    report = report_cells(seen.detections, seen.box, original=study.scene.class_name)
    del report["target"], report["target_score"]
    return {
        **place_cells(seen.camera, seen.box),
        **seen_from(centre)(seen),
        **{f"{DEPTH}{one.name}": one.cone.angle_to_edge(seen.camera, centre=centre) for one in study.attack},
        **{f"{POISON_DEPTH}{a.name}": a.poisoned_cone.angle_to_edge(seen.camera, centre=centre) for a in study.attack},
        **report,
        **{f"{TARGET_SCORE}{attack.name}": seen.confidence(attack.target_class) for attack in wanted},
    }


@cache
def loaded(name: str, weights: Path | None = None) -> Detector:
    """A detector, loaded once in a process.

    Raises:
        DetectorError: It cannot be loaded.
    """
    return load_detector(name, weights=weights)
