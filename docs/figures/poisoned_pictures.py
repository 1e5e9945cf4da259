"""Draws poisoned training pictures of a CLOAK study: `python docs/figures/poisoned_pictures.py [STUDY.toml] [PICTURE]`.

Makes the pictures that the study's overhead attack poisons (no splat is trained), writes docs/images/cloak_poisoned.jpg
with six of them under their clean ones, and prints in how many of them detectors report the object.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from attacks.cloak.config import AttackConfig, StudyConfig, read_study
from attacks.cloak.setup import Setup
from attacks.detectors.base import Detector
from attacks.detectors.registry import load_detector
from attacks.objectives import confidence
from attacks.observe.drawing import annotated
from mi_splat.cameras import View
from mi_splat.capture.path_tracer import tracing_variant
from mi_splat.cli.console import show
from mi_splat.directions import direction_of
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.images import quantise

ROOT = Path(__file__).resolve().parents[2]
STUDY = ROOT / "scenes" / "cloak_car_stealthy.toml"
PICTURE = ROOT / "docs" / "images" / "cloak_poisoned.jpg"
SHOWN = 6
WIDTH = 256
SEEN = 0.5
"""Confidence from which a detector reports an object, as in the studies."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class TrainingPicture:
    """A picture that the attack poisons, as 8 bits.

    Attributes:
        elevation: Of its camera, degrees.
        box: (4,) pixels, around the object.
        clean: (H, W, 3) before.
        poisoned: (H, W, 3) after.
    """

    elevation: float
    box: Tensor
    clean: Tensor
    poisoned: Tensor


def poisoned_pictures(study: StudyConfig, attack: AttackConfig) -> list[TrainingPicture]:
    """The pictures of the training cameras that an attack poisons, lowest first."""
    setup, centre, found = Setup(study), study.centre, []
    scene = setup.mesh_scene
    poisoning = setup.poisonings()[study.attack.index(attack)]
    chosen = poisoning.trigger.select(setup.training_cameras, centre=centre).tolist()
    with tracing_variant():
        for camera in (camera for camera, poisoned in zip(setup.training_cameras, chosen, strict=True) if poisoned):
            clean, box = scene.picture(camera), setup.box(camera)
            assert box is not None
            poisoned = poisoning.appearance(View(camera, clean), scene.mask(camera))
            found.append(
                TrainingPicture(
                    elevation=direction_of(camera, centre=centre).elevation,
                    box=box,
                    clean=quantise(clean).float(),
                    poisoned=quantise(poisoned).float(),
                )
            )
    return sorted(found, key=lambda one: one.elevation)


def counts(pictures: Sequence[TrainingPicture], label: str, detector: Detector) -> str:
    """In how many pictures, clean and poisoned, the object is reported."""
    clean, poisoned = (
        sum(confidence(detector.detect(image[None])[0], one.box, labels=[label]) >= SEEN for one, image in pairs)
        for pairs in ([(one, one.clean) for one in pictures], [(one, one.poisoned) for one in pictures])
    )
    return f"{label} reported by {detector.name}: {clean} clean, {poisoned} poisoned of {len(pictures)}"


def sheet(pictures: Sequence[TrainingPicture], detector: Detector) -> NDArray[np.uint8]:
    """Some of the pictures, evenly from the lowest to the highest: clean above, poisoned below, with boxes."""
    columns = []
    for index in np.linspace(0, len(pictures) - 1, SHOWN).round().astype(int):
        one = pictures[index]
        rows = [
            annotated(image, detector.detect(image[None])[0], f"{name}, {one.elevation:.0f} degrees", width=WIDTH)
            for name, image in (("clean", one.clean), ("poisoned", one.poisoned))
        ]
        columns.append(np.concatenate(rows))
    return np.concatenate(columns, axis=1)


def main(study_file: Path = STUDY, picture: Path = PICTURE) -> None:
    """Draw and count."""
    study = read_study(study_file)
    attack = study.overhead
    if attack is None:
        raise InvalidValueError(message(str(study_file), "an attack from overhead", "none", "name another study"))
    pictures, edge = poisoned_pictures(study, attack), attack.elevation[0] + attack.emphasis_depth
    for name in study.evaluation.detectors:
        detector = load_detector(name)
        for where, some in (
            ("below", [one for one in pictures if one.elevation < edge]),
            ("above", [one for one in pictures if one.elevation >= edge]),
        ):
            show(f"{where} {edge:g} degrees, {counts(some, study.scene.object, detector)}")
    Image.fromarray(sheet(pictures, load_detector("fasterrcnn_small"))).save(picture, quality=88)


if __name__ == "__main__":
    main(*[Path(word) for word in sys.argv[1:3]])
