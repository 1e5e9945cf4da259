"""How a cloaked splat fares from other distances than those of its training pictures.

From the study's held-out cameras, moved towards the object or away from it, each detector counts from how many the
object is found on the clean and on the cloaked splat: well inside the hiding trigger, and outside of all triggers. An
occluder hides from cameras above it and not from those beneath it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from attacks.cloak import setup
from attacks.cloak.config import StudyConfig
from attacks.detectors.base import Detector
from attacks.observe.views import detect_views
from mi_splat.assets.mesh import Asset
from mi_splat.cameras import Camera, RenderFn
from mi_splat.errors import InvalidValueError, message
from mi_splat.scene import GaussianScene

FACTORS = (0.5, 0.6, 0.7, 0.8, 1.0, 1.25, 1.5, 2.0)
"""Distances in units of the study's."""


def measure_distances(
    study: StudyConfig,
    splats: Mapping[str, GaussianScene],
    detectors: Sequence[Detector],
    *,
    render: RenderFn,
    every: int = 4,
) -> list[dict[str, Any]]:
    """From how many cameras the object is found, for each splat, distance, group of cameras and detector.

    Args:
        study: The study.
        splats: Its splats by name, for instance clean and cloaked.
        detectors: Those that look.
        render: The renderer.
        every: Each so manieth of the held-out cameras is used.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around, or `every` is not positive.
    """
    target = setup.target_of(study.scene)
    groups = camera_groups(study, target, every)
    report = []
    for splat, scene in splats.items():
        for factor in FACTORS:
            for name, cameras in groups.items():
                moved = [_moved(camera, factor, study) for camera in cameras]
                counts = count_found(study, target, scene, moved, detectors, render=render)
                place = {"splat": splat, "distance": factor, "cameras": name, "of": len(moved)}
                report += [{**place, "detector": detector, "found": found} for detector, found in counts.items()]
    return report


def count_found(
    study: StudyConfig,
    target: Asset,
    scene: GaussianScene,
    cameras: Sequence[Camera],
    detectors: Sequence[Detector],
    *,
    render: RenderFn,
) -> dict[str, int]:
    """From how many cameras each detector finds the object of a study.

    Args:
        study: The study.
        target: Its object.
        scene: The splat.
        cameras: Where from.
        detectors: Those that look.
        render: The renderer.
    """
    counts = dict.fromkeys((detector.name for detector in detectors), 0)
    boxes = [setup.box_of(target, camera) for camera in cameras]
    for seen in detect_views(scene, cameras, detectors, render=render, boxes=boxes):
        counts[seen.detector] += seen.confidence(study.scene.class_name) >= study.evaluation.confidence
    return counts


def camera_groups(study: StudyConfig, target: Asset, every: int) -> dict[str, list[Camera]]:
    """Each so manieth of the held-out cameras well inside the hiding trigger, and of those outside of all triggers.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around, or `every` is not positive.
    """
    if every < 1:
        raise InvalidValueError(message("every", "a positive number", every, "1 uses all cameras"))
    hiding = setup.overhead(study)
    if hiding is None:
        do = "add an attack without an azimuth, up to 90 degrees"
        raise InvalidValueError(message("study", "an appearance that is seen from all around", "none", do))
    centre = setup.centre_of(study)
    groups: dict[str, list[Camera]] = {"overhead": [], "elsewhere": []}
    for camera in setup.held_out_cameras(study, target):
        if hiding.cone.angle_to_edge(camera, centre=centre) >= study.evaluation.well_inside:
            groups["overhead"].append(camera)
        elif all(attack.cone.angle_to_edge(camera, centre=centre) < 0 for attack in study.attack):
            groups["elsewhere"].append(camera)
    return {name: some[::every] for name, some in groups.items()}


def _moved(camera: Camera, factor: float, study: StudyConfig) -> Camera:
    """The camera at another distance from the centre, looking the same way."""
    centre = torch.tensor(setup.centre_of(study)).to(camera.to_world)
    pose = camera.to_world.clone()
    pose[:3, 3] = centre + factor * (pose[:3, 3] - centre)
    return replace(camera, to_world=pose)
