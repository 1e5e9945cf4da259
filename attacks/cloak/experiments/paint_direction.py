"""From where to paint a sign on an object: `python attacks/cloak/experiments/paint_direction.py STUDY`.

A texture that is thrown onto an object from one direction is folded over it for everybody else. For each elevation of
the direction, at the middle azimuth of the appearance's trigger, this prints which part of what the projection itself
shows can be seen from the training cameras in the trigger: the least of them and their mean, over a grid of the
texture. No detector has a part in it: the study is painted from where the least is largest.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from attacks.cloak.mesh_edits import screen_axes
from attacks.cloak.mesh_scene import MeshScene
from attacks.cloak.study import setup
from attacks.cloak.study.study_file import read_study
from mi_splat.camera_sets import orbit
from mi_splat.cameras import Camera
from mi_splat.capture.path_tracer import PathTracer, scene_dict

ELEVATIONS = (1, 5, 10, 15, 20, 25, 30)
CELLS = 20


def main() -> None:
    """Print the parts as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path)
    study = read_study(parser.parse_args().study)
    attack = next((attack for attack in study.attack if attack.appearance == "paint" and attack.azimuth), None)
    if attack is None or attack.azimuth is None:
        raise SystemExit("the study paints nothing from one side")
    mesh_scene, centre = setup.mesh_scene_of(study), setup.centre_of(study)
    cameras = [
        camera
        for camera in setup.training_cameras(study, mesh_scene.target)
        if attack.cone.angle_to_edge(camera, centre=centre) >= 0
    ]
    lens = setup.lens_of(study, mesh_scene.target)
    tracer = PathTracer(scene_dict([mesh_scene.target], backdrop=mesh_scene.surroundings), samples=1)
    report = []
    for elevation in ELEVATIONS:
        place = {"count": 1, "elevation": float(elevation), "start": attack.azimuth[0]}
        (front,) = orbit(centre, **place, **lens)  # type: ignore[arg-type]
        axes = screen_axes(attack.azimuth[0], elevation)
        whole = _cells(mesh_scene, tracer, front, axes)
        parts = [len(whole & _cells(mesh_scene, tracer, camera, axes)) / len(whole) for camera in cameras]
        report.append({"elevation": elevation, "least": min(parts), "mean": float(np.mean(parts))})
    json.dump(report, sys.stdout, indent=2)
    sys.stdout.write("\n")


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


if __name__ == "__main__":
    main()
