"""Whether a cloaked object stays hidden on a street of meshes, path-traced under a sun that moves over the day.

The layers of an object show the road of the study's own pictures. On another road, under another light, they show what
they did before, for a splat is not lit.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.cloak import setup
from attacks.cloak.config import StudyConfig
from attacks.cloak.experiments.distance import camera_groups, count_found
from attacks.cloak.layers import object_rows
from attacks.detectors.base import Detector
from attacks.observe.conditions import SunTable, street_at
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import save_splat
from mi_splat.scene import GaussianScene
from mi_splat.sun import clock

STREET = SunTable(scene="scenes/mixed/car_among_meshes.xml", hours=(7.0, 9.5, 12.0, 14.5, 17.0), samples=8)
"""At the equinox."""
HOUSES = 4.0
"""Cameras farther north than this, in world units, would stand in the houses."""


def measure_street(
    study: StudyConfig,
    splats: Mapping[str, GaussianScene],
    detectors: Sequence[Detector],
    *,
    every: int = 4,
    sun: SunTable = STREET,
) -> list[dict[str, Any]]:
    """From how many cameras the object is found, for each splat, hour, group of cameras and detector.

    Args:
        study: The study, with layers.
        splats: Its splats by name, for instance clean and cloaked; the object is cut out of each.
        detectors: Those that look.
        every: Each so manieth of the held-out cameras is used.
        sun: Where and when; its scene has the parameter car, too.

    Raises:
        InvalidValueError: The study has no layers, or no appearance that is seen from all around.
    """
    if study.layers is None:
        do = "take a study with [layers], whose object is known Gaussian by Gaussian"
        raise InvalidValueError(message("study", "layers", "none", do))
    target = setup.target_of(study.scene)
    groups = {
        name: [camera for camera in cameras if float(camera.position[1]) < HOUSES]
        for name, cameras in camera_groups(study, target, every).items()
    }
    report = []
    with tempfile.TemporaryDirectory() as folder:
        for splat, scene in splats.items():
            alone = scene.select(object_rows(study, scene, target))
            path = (Path(folder) / f"{splat}.ply").resolve()
            save_splat(alone, path)
            for hour in sun.hours:
                render = street_at(sun, hour, car=str(path))
                for name, cameras in groups.items():
                    place = {"splat": splat, "hour": clock(hour), "cameras": name, "of": len(cameras)}
                    counts = count_found(study, target, render.splats.scene, cameras, detectors, render=render)
                    report += [{**place, "detector": detector, "found": found} for detector, found in counts.items()]
    return report
