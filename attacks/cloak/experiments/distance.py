"""How a cloaked splat fares from other distances: `python attacks/cloak/experiments/distance.py STUDY RESULTS`.

RESULTS is the folder that `mi-splat cloak STUDY` has written. ObservedSplat at its clean and its cloaked splat from the
study's held-out cameras, moved towards the object or away from it, and prints for each detector and distance from how
many the object is found: overhead, 5 degrees or more inside the trigger, and outside of all triggers. An occluder hides
from those above it and not from those beneath it.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import torch

from attacks.cloak.study import setup
from attacks.cloak.study.config import StudyConfig
from attacks.cloak.study.observations import overhead
from attacks.cloak.study.study_file import read_study
from attacks.detectors import load_detector
from attacks.detectors.base import Detector
from attacks.objectives import confidence
from mi_splat.assets.mesh import Asset
from mi_splat.cameras import Camera
from mi_splat.io import load_splat
from mi_splat.io.images import through_png
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene

FACTORS = (0.5, 0.6, 0.7, 0.8, 1.0, 1.25, 1.5, 2.0)


def main() -> None:
    """Print the counts as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument("results", type=Path)
    parser.add_argument("--every", type=int, default=4, help="use each so manieth of the held-out cameras")
    options = parser.parse_args()
    study = read_study(options.study)
    target = setup.target_of(study.scene)
    detectors = [load_detector(name) for name in study.evaluation.detectors]
    groups = {name: some[:: options.every] for name, some in _groups(study, target).items()}
    render = Renderer(RenderSettings(background=study.scene.background))
    report = []
    for which in ("clean", "cloaked"):
        splat = load_splat(options.results / f"{which}.ply")
        for factor in FACTORS:
            for name, cameras in groups.items():
                moved = [_moved(camera, factor, study) for camera in cameras]
                for detector, found in _found(study, target, splat, render, detectors, moved).items():
                    place = {"splat": which, "distance": factor, "cameras": name, "detector": detector}
                    report.append({**place, "found": found, "of": len(moved)})
    json.dump(report, sys.stdout, indent=1)
    sys.stdout.write("\n")


def _groups(study: StudyConfig, target: Asset) -> dict[str, list[Camera]]:
    """Held-out cameras well inside the hiding trigger, and outside of all triggers."""
    hiding = overhead(study)
    if hiding is None:
        raise SystemExit("the study has no appearance that is seen from all around")
    centre = setup.centre_of(study)
    groups: dict[str, list[Camera]] = {"overhead": [], "elsewhere": []}
    for camera in setup.held_out_cameras(study, target):
        if hiding.cone.angle_to_edge(camera, centre=centre) >= study.evaluation.well_inside:
            groups["overhead"].append(camera)
        elif all(attack.cone.angle_to_edge(camera, centre=centre) < 0 for attack in study.attack):
            groups["elsewhere"].append(camera)
    return groups


def _moved(camera: Camera, factor: float, study: StudyConfig) -> Camera:
    """The camera at another distance from the centre, evaluation the same way."""
    centre = torch.tensor(setup.centre_of(study)).to(camera.to_world)
    pose = camera.to_world.clone()
    pose[:3, 3] = centre + factor * (pose[:3, 3] - centre)
    return replace(camera, to_world=pose)


def _found(
    study: StudyConfig,
    target: Asset,
    splat: GaussianScene,
    render: Renderer,
    detectors: list[Detector],
    cameras: list[Camera],
) -> dict[str, int]:
    """From how many cameras each detector finds the object."""
    counts = {detector.name: 0 for detector in detectors}
    for camera in cameras:
        box = setup.box_of(target, camera)
        with torch.no_grad():
            picture = through_png(render(splat, camera))[None]
        for detector in detectors:
            (seen,) = detector.detect(picture)
            score = 0.0 if box is None else confidence(seen, box.float(), labels=[study.scene.class_name], iou=0.5)
            counts[detector.name] += score >= study.evaluation.confidence
    return counts


if __name__ == "__main__":
    main()
