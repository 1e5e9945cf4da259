"""What one detector reports from a study's cameras: on a splat, under any condition, or
in images that are there.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl
import torch
from torch import Tensor

from attacks.cloak.config import AttackConfig, LayersConfig
from attacks.cloak.kinds.pictures import read_pictures
from attacks.cloak.layers import object_rows
from attacks.cloak.setup import SET, Setup
from attacks.cloak.triggers import Trigger
from attacks.detectors.base import Detector
from attacks.detectors.registry import load_detector
from attacks.observe.conditions import (
    Condition,
    Shown,
    SunTable,
    Viewing,
    condition_of,
    rendered,
)
from attacks.observe.observations import observe, report_cells, seen_from
from attacks.observe.rows import (
    DEPTH,
    DETECTION_BOX,
    DETECTIONS,
    PATH,
    POISON_DEPTH,
    ROWS,
    SUFFIX,
    TARGET_SCORE,
    Cell,
    frame_with,
    write_rows,
)
from attacks.observe.views import ViewDetections
from mi_splat.cameras.camera import Camera
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat
from mi_splat.maths.metrics import psnr
from mi_splat.scene import GaussianScene

if TYPE_CHECKING:
    from mi_splat.ledger import Out

_NO_DETECTIONS = frame_with(
    (), ("detector", "view", "label", "score", *DETECTION_BOX, "iou")
)
_NOTHING = GaussianScene(
    *(torch.zeros(0, *shape) for shape in ((3,), (3,), (4,), (), (1, 3)))
)
"""The splat of images that are there already."""
WEIGHTS = "weights"
"""Name of the input that is a file of weights; without it a detector has its usual
ones.
"""
_PATH_FROM = 40.0
_PATH_TO = 180.0
_LOWEST = 5.0
_STEP = 2.5
"""Azimuths of both ends of the path over the object, their elevation, and degrees from
camera to camera.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenConfig(Setup):
    """Which detector judges which splat or images, under which condition, from which
    cameras.
    """

    label: str
    detector: str
    fingerprint: str
    training: bool = False
    path: bool = False
    every: int = 1
    # how the splat is looked at, see `attacks.observe.conditions`; "" is as the victim
    # does
    condition: str = ""
    sun: SunTable | None = None
    layers: LayersConfig | None = None
    # which package brings the condition, with its version; empty for this project
    package: str = ""


def run(config: SeenConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Write a row for each camera, and for each detection, of a `splat` or
    `pictures`.
    """
    setup = config.given(inputs)
    detector = checked_detector(config, inputs)
    done = itertools.count(1)

    def cells(seen: ViewDetections, total: int) -> dict[str, Cell]:
        out.progress(f"{detector.name} looks", next(done), total)
        return observation_cells(config, seen, detector.classes)

    _observed(config, setup, inputs, detector, cells, out)


_Cells = Callable[[ViewDetections, int], dict[str, Cell]]


def _observed(
    config: SeenConfig,
    setup: Setup,
    inputs: Mapping[str, Path],
    detector: Detector,
    cells: _Cells,
    out: Out,
) -> None:
    """From held-out or training cameras, or along the path without single detections.

    Under a condition that is no street a row has the PSNR to what the victim sees
    there.
    """
    usual = setup.training_cameras if config.training else setup.held_out_cameras
    every = path_cameras(setup) if config.path else usual
    cameras = every[:: config.every]
    errors = dict[Camera, float | None]()
    if "splat" not in inputs:
        if config.training:
            views = load_dataset(
                inputs["pictures"] / SET,
                split="train",
                background=config.scene.background,
            )
            images: Sequence[Tensor] = [view.image for view in views]
        else:
            images = read_pictures(inputs["pictures"]).images
        pictures = dict(zip(cameras, images, strict=True))
        splat = _NOTHING
        condition = rendered("", lambda scene, camera: pictures[camera])
    else:
        splat = load_splat(inputs["splat"])
        condition = _condition(config, setup, errors)
    if not any(map(condition.holds, cameras)):
        do = "raise it, or take more cameras by a smaller every"
        raise InvalidValueError.of(
            "sun.north", f"one of {len(cameras)} cameras south of it", "none", do
        )

    def of_view(seen: ViewDetections) -> dict[str, Cell]:
        row = cells(seen, len(cameras))
        if errors:
            return {**row, "psnr": errors[seen.camera]}
        return row

    looked = observe(
        condition, {"": splat}, cameras, [detector], boxes=setup.box, cells=of_view
    )
    detections = pl.concat([_NO_DETECTIONS, looked.detections], how="diagonal")
    if config.path:
        tables = {PATH: looked.rows}
    else:
        tables = {ROWS: looked.rows, DETECTIONS: detections}
    for name, table in tables.items():
        kept = table.drop(
            "splat", *(() if config.condition else ("condition",)), strict=False
        )
        write_rows(
            kept.with_columns(view=pl.col("view") * config.every),
            out / f"{name}{SUFFIX}",
        )


def path_cameras(setup: Setup) -> list[Camera]:
    """Cameras along a smooth path: up from the ground, over the object, and down behind
    it.
    """
    along = np.arange(_LOWEST, 180.0 - _LOWEST + _STEP / 2, _STEP)
    turned = np.clip((along - 60.0) / 60.0, 0.0, 1.0)  # around it only while it is high
    azimuths = _PATH_FROM + (_PATH_TO - _PATH_FROM) * turned**2 * (3.0 - 2.0 * turned)
    elevations = np.minimum(90.0 - np.abs(90.0 - along), 89.0)
    return [
        setup.camera(*map(float, direction))
        for direction in zip(azimuths, elevations, strict=True)
    ]


def _condition(
    config: SeenConfig, setup: Setup, errors: dict[Camera, float | None]
) -> Condition:
    """How the splat is looked at; keeps the PSNR of each image to the victim's, dB,
    None where they are the same.
    """
    usual = setup.renderer()
    layers = config.layers

    def alone(splat: GaussianScene) -> GaussianScene:
        assert layers is not None
        return splat.select(object_rows(layers, splat, setup.target))

    viewing = Viewing(
        settings=usual.settings, centre=setup.centre, alone=alone, sun=config.sun
    )
    condition = condition_of(config.condition, viewing)
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


def observation_cells(
    config: SeenConfig, seen: ViewDetections, classes: Sequence[str]
) -> dict[str, Cell]:
    """Where a camera is to the triggers, and what is reported on the object: the cells
    that rates count.
    """
    attacks = config.attacks
    centre = config.cameras.centre

    def depths(before: str, cone: Callable[[AttackConfig], Trigger]) -> dict[str, Cell]:
        return {
            f"{before}{attack.name}": (
                cone(attack).angle_to_edge(seen.camera, centre=centre)
            )
            for attack in attacks
        }

    report = report_cells(seen.detections, seen.box, original=config.label)
    del report["target"], report["target_score"]
    wanted = {
        attack.name: attack.target_class for attack in attacks if attack.target_class
    }
    return {
        **seen_from(centre)(seen),
        **depths(DEPTH, lambda attack: attack.cone),
        **depths(POISON_DEPTH, lambda attack: attack.poisoned_cone),
        **report,
        **{
            f"{TARGET_SCORE}{name}": seen.confidence_of(label, classes)
            for name, label in wanted.items()
        },
    }


def checked_detector(config: SeenConfig, inputs: Mapping[str, Path]) -> Detector:
    """The detector that a job asks for."""
    detector = loaded(config.detector, inputs.get(WEIGHTS))
    if detector.fingerprint != config.fingerprint:
        do = "give the same weights to every process"
        raise InvalidValueError.of(
            f"weights of {detector.name}", config.fingerprint, detector.fingerprint, do
        )
    return detector


@cache
def loaded(name: str, weights: Path | None = None) -> Detector:
    """A detector, loaded once in a process."""
    return load_detector(name, weights=weights)
