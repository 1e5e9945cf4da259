"""What one detector reports from held-out cameras: on a splat, under any condition, or in pictures that are there."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl
import torch
from torch import Tensor

from attacks.cloak.config import AttackConfig, StudyConfig
from attacks.cloak.kinds.parts import StepConfig
from attacks.cloak.kinds.rendering import settings_of
from attacks.cloak.kinds.true_pictures import read_pictures
from attacks.cloak.layers import object_rows
from attacks.cloak.setup import Setup
from attacks.detectors.base import Detector
from attacks.detectors.registry import load_detector
from attacks.observe.conditions import Condition, Shown, SunTable, Viewing, condition_of, rendered
from attacks.observe.look import look, report_cells, seen_from
from attacks.observe.rows import (
    DEPTH,
    DETECTION_BOX,
    DETECTIONS,
    POISON_DEPTH,
    ROWS,
    SUFFIX,
    TARGET_SCORE,
    Cell,
    frame_with,
    write_rows,
)
from attacks.observe.views import ViewDetections
from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat
from mi_splat.metrics import psnr
from mi_splat.rendering import Renderer
from mi_splat.scene import GaussianScene

if TYPE_CHECKING:
    from mi_splat.ledger import Out

_NONE = frame_with((), ("detector", "view", "label", "score", *DETECTION_BOX, "iou"))
"""Detections, before there is one."""
_NOTHING = GaussianScene(*(torch.zeros(0, *shape) for shape in ((3,), (3,), (4,), (), (1, 3))))
"""The splat of pictures that are there already."""
WEIGHTS = "weights"
"""Name of the input that is a file of weights; without it a detector has its usual ones."""
NO_ATTACK = (AttackConfig(name="none", elevation=(1.0, 90.0)),)
"""The attacks of a job in which none has a part."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenConfig(StepConfig):
    """Which detector judges which splat or pictures, under which condition, from which cameras.

    Attributes:
        every: Each so manieth of the held-out cameras looks.
        detector: Name of the detector.
        fingerprint: Of its weights.
        condition: How the splat is looked at, see `attacks.observe.conditions`; "" is as the victim does.
        sun: The street of a condition that is an hour.
        package: Which package brings the condition, with its version; empty for this project.
    """

    detector: str
    fingerprint: str
    every: int = 1
    condition: str = ""
    sun: SunTable | None = None
    package: str = ""


def run(config: SeenConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Write a row for each camera and one for each detection; inputs are a `splat`, or `pictures` in its place.

    Under a condition that is no street a row has the PSNR to what the victim sees from there.
    """
    setup = Setup(config.study(inputs))
    cameras = setup.held_out_cameras[:: config.every]
    detector = checked_detector(config, inputs)
    errors, done = dict[Camera, float | None](), itertools.count(1)

    def cells(seen: ViewDetections) -> dict[str, Cell]:
        out.progress(f"{detector.name} looks", next(done), len(cameras))
        return {
            **observation_cells(setup.study, seen, detector.classes),
            **({"psnr": errors[seen.camera]} if errors else {}),
        }

    if "pictures" in inputs:
        pictures = dict(zip(cameras, read_pictures(inputs["pictures"]).images, strict=True))
        splat, condition = _NOTHING, rendered("", lambda scene, camera: pictures[camera])
    else:
        splat, condition = load_splat(inputs["splat"]), _condition(config, setup, errors)
    if not any(map(condition.holds, cameras)):
        do = "raise it, or take more cameras by a smaller every"
        raise InvalidValueError.of("sun.north", f"one of {len(cameras)} cameras south of it", "none", do)
    looked = look([condition], {"": splat}, cameras, [detector], boxes=setup.box, cells=cells)
    rows, detections = (
        table.drop("splat", *(() if config.condition else ("condition",)), strict=False).with_columns(
            view=pl.col("view") * config.every
        )
        for table in (looked.rows, pl.concat([_NONE, looked.detections], how="diagonal"))
    )
    write_rows(rows, out / f"{ROWS}{SUFFIX}")
    write_rows(detections, out / f"{DETECTIONS}{SUFFIX}")


def _condition(config: SeenConfig, setup: Setup, errors: dict[Camera, float | None]) -> Condition:
    """How the splat is looked at; keeps the PSNR of each picture to the victim's, dB, None where they are the same."""
    study = setup.study
    settings = settings_of(study)
    viewing = Viewing(
        settings=settings,
        centre=study.centre,
        alone=lambda splat: splat.select(object_rows(study, splat, setup.target)),
        sun=config.sun,
    )
    condition, usual = condition_of(config.condition, viewing), Renderer(settings)
    if not config.condition or config.sun is not None:
        return condition

    def show(before: GaussianScene) -> Shown:
        shown, render = condition.show(before)

        def picture(scene: GaussianScene, camera: Camera) -> Tensor:
            image = render(scene, camera)
            value = float(psnr(image.clamp(0, 1), usual(before, camera).clamp(0, 1)))
            errors[camera] = value if math.isfinite(value) else None
            return image

        return shown, picture

    return replace(condition, show=show)


def observation_cells(study: StudyConfig, seen: ViewDetections, classes: Sequence[str]) -> dict[str, Cell]:
    """Where a camera is to the triggers, and what is reported on the object: the cells that rates count."""
    attacks = () if study.attack == NO_ATTACK else study.attack
    centre, wanted = study.centre, {attack.name: attack.target_class for attack in attacks if attack.target_class}
    report = report_cells(seen.detections, seen.box, original=study.scene.class_name)
    del report["target"], report["target_score"]
    return {
        **seen_from(centre)(seen),
        **{f"{DEPTH}{a.name}": a.cone.angle_to_edge(seen.camera, centre=centre) for a in attacks},
        **{f"{POISON_DEPTH}{a.name}": a.poisoned_cone.angle_to_edge(seen.camera, centre=centre) for a in attacks},
        **report,
        **{f"{TARGET_SCORE}{name}": seen.confidence_of(label, classes) for name, label in wanted.items()},
    }


def checked_detector(config: SeenConfig, inputs: Mapping[str, Path]) -> Detector:
    """The detector that a job asks for."""
    detector = loaded(config.detector, inputs.get(WEIGHTS))
    if detector.fingerprint != config.fingerprint:
        do = "give the same weights to every process"
        raise InvalidValueError.of(f"weights of {detector.name}", config.fingerprint, detector.fingerprint, do)
    return detector


@cache
def loaded(name: str, weights: Path | None = None) -> Detector:
    """A detector, loaded once in a process."""
    return load_detector(name, weights=weights)
