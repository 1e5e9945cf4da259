"""The rates of a splat that shows its attacks to perfection: what detectors report in path-traced pictures of them.

A splat that shows exactly what the attacker wants gives these pictures. Where a rate falls short here, no training can
mend it: it is the appearance that a detector sees through, and not the splat.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from attacks.cloak import setup
from attacks.cloak.config import AttackConfig
from attacks.cloak.observations import frame, observation_of, row_of
from attacks.cloak.rates import rates
from attacks.cloak.study.pipeline import CLEAN, CLOAKED, StudyPipeline
from attacks.detectors.base import Detector
from attacks.observe.views import detect_pictures
from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError, message

RATES = (
    "control_recall",
    "trigger_miss_rate",
    "trigger_miss_rate_all",
    "nothing_reported",
    "target_rate",
    "control_target_rate",
)
"""Those of `attacks.cloak.rates.rates` that a camera inside a trigger has a part in."""


def measure_perfect_splat(
    pipeline: StudyPipeline, detectors: Sequence[Detector], *, every: int = 1
) -> list[dict[str, Any]]:
    """The rates of each attack and detector, from held-out cameras inside the attack's trigger.

    The control is the path-traced picture of the scene as it is, in the place of the clean splat.

    Args:
        pipeline: The study; the pictures become stages of it.
        detectors: Those that look.
        every: Each so manieth of a trigger's held-out cameras is used.

    Raises:
        InvalidValueError: `every` is not positive, or a trigger holds none of the held-out cameras.
    """
    if every < 1:
        raise InvalidValueError(message("every", "a positive number", every, "1 uses all cameras"))
    study, centre = pipeline.study, setup.centre_of(pipeline.study)
    held_out = setup.held_out_cameras(study, pipeline.mesh_scene.target)
    report = []
    for attack in study.attack:
        inside = [camera for camera in held_out if attack.cone.angle_to_edge(camera, centre=centre) >= 0][::every]
        if not inside:
            expected = f"held-out cameras in the trigger of {attack.name!r}"
            raise InvalidValueError(message("evaluation.cameras", expected, "none", "ask for more cameras"))
        rows = _rows(pipeline, inside, detectors) + _rows(pipeline, inside, detectors, attack)
        for (detector,), found in rates(study, frame(rows), ("detector",), attack=attack.name).items():
            known = {name: rate.as_dict() for name, rate in found.items() if name in RATES and rate is not None}
            report.append({"attack": attack.name, "detector": detector, "cameras": len(inside), **known})
    return report


def _rows(
    pipeline: StudyPipeline,
    cameras: Sequence[Camera],
    detectors: Sequence[Detector],
    attack: AttackConfig | None = None,
) -> list[dict[str, Any]]:
    """What detectors report in path-traced pictures: of an attack's appearance, or of the scene as it is."""
    pictures = dict(zip(cameras, pipeline.true_pictures(cameras, attack).images, strict=True))
    boxes = [setup.box_of(pipeline.mesh_scene.target, camera) for camera in cameras]
    looked = detect_pictures(pictures.__getitem__, cameras, detectors, boxes=boxes)
    splat = {"splat": CLEAN if attack is None else CLOAKED, "seed": 0}
    return [{**splat, **row_of(observation_of(pipeline.study, one))} for one in looked]
