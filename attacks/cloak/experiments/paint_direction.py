"""From where to paint a sign on an object so that its worst camera sees most of it.

A texture that is thrown onto an object from one direction is folded over it for everybody else. For each elevation of
the direction, at the middle azimuth of the trigger, this measures which part of what the projection itself shows can be
seen from the training cameras in the trigger, over a grid of the texture. No detector has a part in it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from attacks.cloak import setup
from attacks.cloak.config import StudyConfig
from attacks.cloak.mesh_scene import MeshScene, screen_axes
from mi_splat.camera_sets import orbit
from mi_splat.cameras import Camera
from mi_splat.capture.path_tracer import PathTracer, scalar_variant, scene_dict
from mi_splat.errors import InvalidValueError, message

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
