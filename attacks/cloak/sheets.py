"""Pictures that a study of CLOAK leaves: a contact sheet, poisoned pictures, and what a rising camera sees."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from attacks.cloak.config import StudyConfig
from attacks.cloak.steps import StudySteps
from attacks.detectors.base import Detector
from attacks.observe.drawing import annotated
from attacks.observe.rows import CLEAN
from mi_splat.datasets import load_dataset
from mi_splat.directions import direction_of
from mi_splat.io.images import through_png
from mi_splat.scene import GaussianScene
from mi_splat.scene_files import resized

CONTACT, POISONED_PICTURES, RISING = "contact.png", "poisoned.png", "rising.webp"
"""Both splats from many sides; poisoned training pictures below their clean ones; both splats while a camera rises."""

_SIDE, _LOW, _CELL = 40.0, 15, 256
"""Azimuth of the rising cameras of a contact sheet, elevation of those that go around, degrees; pixels of a picture."""
_ELEVATIONS = (5, 15, 25, 35, 45, 55, 65, 75, 85)
_AZIMUTHS = (0, 45, 90, 135, 150, 165, 180, 195, 210)


def contact_sheet(steps: StudySteps, splats: Mapping[str, GaussianScene], detector: Detector) -> NDArray[np.uint8]:
    """Clean above cloaked, over elevation and then around, with what the detector reports."""
    study, render, rows = steps.study, steps.renderer(), list[NDArray[np.uint8]]()
    camera = steps.setup.camera
    rising = [(f"{elevation} deg up", camera(_SIDE, elevation)) for elevation in _ELEVATIONS]
    around = [(f"azimuth {azimuth}", camera(azimuth, _LOW)) for azimuth in _AZIMUTHS]
    for cameras in (rising, around):
        for which, scene in splats.items():
            with torch.no_grad():
                pictures = [through_png(render(scene, view)) for _, view in cameras]
            rows.append(_row(study, detector, pictures, [f"{which}, {name}" for name, _ in cameras]))
    return np.concatenate(rows)


RISING_FPS, _RISING = 12.0, [*range(4, 87, 2), *[86] * 8, *range(82, 4, -4)]
"""Pictures a second of the animation, and elevations in degrees: up step by step, a rest, and down faster."""


def rising(steps: StudySteps, splats: Mapping[str, GaussianScene], detector: Detector) -> list[NDArray[np.uint8]]:
    """The clean splat beside the cloaked one from a camera that rises, with what the detector reports."""
    study, render = steps.study, steps.renderer()
    frames: dict[int, list[NDArray[np.uint8]]] = {}
    for name, scene in splats.items():
        title = "pictures clean" if name == CLEAN else "pictures poisoned"
        for elevation in sorted(set(_RISING)):
            camera = resized(steps.setup.camera(_SIDE, elevation), (_CELL, _CELL))
            with torch.no_grad():
                picture = through_png(render(scene, camera))
            frames.setdefault(elevation, []).append(_row(study, detector, [picture], [f"{title}, {elevation} deg up"]))
    return [np.concatenate(frames[elevation], axis=1) for elevation in _RISING]


def _row(
    study: StudyConfig, detector: Detector, pictures: Sequence[Tensor], titles: Sequence[str]
) -> NDArray[np.uint8]:
    """Pictures beside each other under their titles, with what a detector reports."""
    least, seen = study.evaluation.confidence, detector.detect(torch.stack(list(pictures)))
    cells = zip(pictures, seen, titles, strict=True)
    return np.concatenate([annotated(*cell, min_confidence=least, width=_CELL) for cell in cells], axis=1)


_POISONED = 6
"""Pictures of each attack in the sheet of poisoned ones."""


def poisoned_sheet(steps: StudySteps, folders: Mapping[str, Path], detector: Detector) -> NDArray[np.uint8]:
    """Training pictures of each attack, evenly from the lowest to the highest: clean above poisoned, with reports."""
    study, first = steps.study, steps.study.seeds[0]
    sets = {
        name: load_dataset(folder, split="train", background=study.scene.background) for name, folder in folders.items()
    }
    cameras, owners, rows = steps.setup.training_cameras, steps.setup.owners(first), list[NDArray[np.uint8]]()
    for attack in study.attack:
        held = ((direction_of(cameras[view], study.centre).elevation, view) for view in owners)
        mine = sorted((height, view) for height, view in held if owners[view] == attack.name)
        chosen = [mine[index] for index in np.linspace(0, len(mine) - 1, _POISONED).round().astype(int)]
        for name, views in sets.items():
            titles = [f"{name}, {attack.name}, {height:.0f} deg" for height, _ in chosen]
            rows.append(_row(study, detector, [views[view].image for _, view in chosen], titles))
    return np.concatenate(rows)
