"""What can be known of a study's attacks before a splat is trained, from the meshes alone.

A splat that shows exactly what the attacker wants gives path-traced pictures of it. Where a rate falls short in these,
no training can mend it: it is the appearance that a detector sees through, and not the splat.

A texture that is thrown onto an object from one direction is folded over it for everybody else. For each elevation of
the direction, at the middle azimuth of the trigger, it is measured which part of what the projection itself shows can
be seen from the training cameras in the trigger, over a grid of the texture. No detector has a part in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attacks.cloak import setup
from attacks.cloak.config import AttackConfig, StudyConfig
from attacks.cloak.kinds.seen import observation_cells
from attacks.cloak.kinds.true_pictures import read_pictures
from attacks.cloak.mesh_scene import MeshScene, screen_axes
from attacks.cloak.rates import rates
from attacks.cloak.steps import StudySteps
from attacks.detectors.base import Detector
from attacks.observe.rows import ATTACKED, CLEAN, Cell, Row, frame_of
from attacks.observe.views import detect_pictures
from mi_splat.camera_sets import orbit
from mi_splat.cameras import Camera
from mi_splat.capture.path_tracer import PathTracer, scalar_variant, scene_dict
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


def measure_perfect_splat(steps: StudySteps, detectors: Sequence[Detector], *, every: int = 1) -> list[dict[str, Any]]:
    """The rates of each attack and detector, from held-out cameras inside the attack's trigger.

    The control is the path-traced picture of the scene as it is, in the place of the clean splat.

    Args:
        steps: The study; the pictures stay in its ledger.
        detectors: Those that look.
        every: Each so manieth of a trigger's held-out cameras is used.

    Raises:
        InvalidValueError: `every` is not positive, or a trigger holds none of the held-out cameras.
    """
    if every < 1:
        raise InvalidValueError(message("every", "a positive number", every, "1 uses all cameras"))
    study, centre = steps.study, setup.centre_of(steps.study)
    held_out = setup.held_out_cameras(study, steps.mesh_scene.target)
    report = []
    for attack in study.attack:
        inside = [camera for camera in held_out if attack.cone.angle_to_edge(camera, centre=centre) >= 0][::every]
        if not inside:
            expected = f"held-out cameras in the trigger of {attack.name!r}"
            raise InvalidValueError(message("evaluation.cameras", expected, "none", "ask for more cameras"))
        rows = [*_rows(steps, inside, detectors), *_rows(steps, inside, detectors, attack)]
        for (detector,), counted in rates(study, frame_of(rows), ("detector",), attack=attack.name).items():
            known = {name: rate.as_dict() for name, rate in counted.items() if name in RATES and rate is not None}
            report.append({"attack": attack.name, "detector": detector, "cameras": len(inside), **known})
    return report


def _rows(
    steps: StudySteps, cameras: Sequence[Camera], detectors: Sequence[Detector], attack: AttackConfig | None = None
) -> Iterator[Row]:
    """What detectors report in path-traced pictures: of an attack's appearance, or of the scene as it is."""
    done = steps.do(steps.true_pictures(cameras, attack), "taking pictures to compare with")
    pictures = dict(zip(cameras, read_pictures(done.folder).images, strict=True))
    boxes = [setup.box_of(steps.mesh_scene.target, camera) for camera in cameras]
    for one in detect_pictures(pictures.__getitem__, cameras, detectors, boxes=boxes):
        ids: dict[str, Cell] = {"splat": CLEAN if attack is None else ATTACKED, "seed": 0}
        ids |= {"detector": one.detector, "view": one.view}
        yield {**ids, **observation_cells(steps.study, one)}


ELEVATIONS = (1, 5, 10, 15, 20, 25, 30)
CELLS = 20
"""Rows and columns of the grid."""


def measure_paint_directions(study: StudyConfig) -> list[dict[str, Any]]:
    """For each elevation of the direction the smallest part that a camera sees, and the mean over cameras.

    Raises:
        InvalidValueError: The study paints nothing from one side.
    """
    attack = next((attack for attack in study.attack if attack.appearance == "paint" and attack.azimuth), None)
    if attack is None or attack.azimuth is None:
        do = "add an attack with appearance = 'paint' and an azimuth"
        raise InvalidValueError(message("study", "something painted from one side", "nothing", do))
    mesh_scene, centre = setup.mesh_scene_of(study), setup.centre_of(study)
    cameras = [
        camera
        for camera in setup.training_cameras(study, mesh_scene.target)
        if attack.cone.angle_to_edge(camera, centre=centre) >= 0
    ]
    lens = setup.lens_of(study, mesh_scene.target)
    tracer = PathTracer(scene_dict([mesh_scene.target], backdrop=mesh_scene.surroundings), samples=1)
    report = []
    with scalar_variant():
        for elevation in ELEVATIONS:
            (front,) = orbit(centre, count=1, elevation=float(elevation), start=attack.azimuth[0], **lens)  # type: ignore[arg-type]
            axes = screen_axes(attack.azimuth[0], elevation)
            whole = _cells(mesh_scene, tracer, front, axes)
            parts = [len(whole & _cells(mesh_scene, tracer, camera, axes)) / len(whole) for camera in cameras]
            report.append({"elevation": elevation, "smallest": min(parts), "mean": float(np.mean(parts))})
    return report


def _cells(
    mesh_scene: MeshScene, tracer: PathTracer, camera: Camera, axes: NDArray[np.float64]
) -> set[tuple[int, int]]:
    """Cells of the projected texture of which the camera sees some."""
    corners = mesh_scene.target.vertices.astype(np.float64) @ axes.T
    low, size = corners.min(0), np.ptp(corners, axis=0)
    points, _ = tracer.surface(camera, seed=0)
    seen = points[mesh_scene.mask(camera)].numpy().astype(np.float64) @ axes.T
    cells = np.floor((seen - low) / size * CELLS).astype(int).clip(0, CELLS - 1)
    return {(int(u), int(v)) for u, v in cells}
