"""Pictures without any object: held-out streets, parks, rooms, open grounds, and random surroundings.

Whatever a detector reports on them is a false positive.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from numpy.random import Generator

from attacks.detectors.training.config import BACKGROUNDS, SPLITS, BackgroundConfig
from attacks.detectors.training.dataset import check_note, load, save_pictures
from attacks.detectors.training.pictures import LabelledPicture
from attacks.detectors.training.surroundings import of_kind
from mi_splat.cameras import Camera, orbit_pose
from mi_splat.capture.path_tracer import capture, daylight, scalar_variant, scene_dict
from mi_splat.fields import check_choice

_DISTANCE = (4.0, 7.0)
"""Metres from a camera to what it looks at, about those of the shipped scenes."""
_OBJECT_RADIUS = 2.2
"""Metres; random surroundings are made to fit an object of this size, here that of a car."""


def background_pictures(kind: str, number: int, config: BackgroundConfig) -> list[LabelledPicture]:
    """The pictures of background `number` of a kind, a pure function of its arguments; none has a label.

    Cameras look at a point near the origin from 4 to 7 metres, from elevations of 0 to 90 degrees and all azimuths,
    with a field of view of 22 to 60 degrees, as in the pictures with objects.

    Args:
        kind: One of `BACKGROUNDS`.
        number: Which of the kind.
        config: Size and seeds of the set.

    Raises:
        InvalidValueError: There is no such kind.
    """
    check_choice("kind", kind, BACKGROUNDS)
    low, high = SPLITS[config.split]
    rng = np.random.default_rng([config.seed, low, number, 2 + BACKGROUNDS.index(kind)])
    around = of_kind(kind, int(rng.integers(low, high)), rng, _OBJECT_RADIUS)
    scene = scene_dict([], light=daylight(int(rng.integers(1 << 30))), backdrop=around)
    cameras = [_camera(rng, config.size) for _ in range(config.shots)]
    with scalar_variant():
        views = capture(scene, cameras, samples=config.samples, seed=int(rng.integers(1 << 28)))
    return [
        LabelledPicture(
            (view.image.clamp(0, 1) * 255).round().to(torch.uint8), torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64)
        )
        for view in views
    ]


def _camera(rng: Generator, size: int) -> Camera:
    target = (float(rng.normal(0, 0.5)), float(rng.normal(0, 0.5)), float(rng.uniform(0.5, 1.2)))
    focal = size / 2 / math.tan(math.radians(rng.uniform(22, 60)) / 2)
    pose = orbit_pose(
        target,
        azimuth=float(rng.uniform(0, 360)),
        elevation=float(rng.uniform(0, 90)),
        distance=float(rng.uniform(*_DISTANCE)),
    )
    return Camera(to_world=pose, focal=focal, width=size, height=size)


def background_sets(
    folder: Path,
    config: BackgroundConfig,
    *,
    kinds: Sequence[str] = BACKGROUNDS,
    on_step: Callable[[int, int], None] | None = None,
) -> dict[str, list[LabelledPicture]]:
    """Pictures of kinds of background, each scene kept in a folder of its own; what is missing is made.

    Args:
        folder: Where the pictures are kept.
        config: Their number, size and seeds.
        kinds: Which of `BACKGROUNDS`.
        on_step: Called with the number of scenes done and the number wanted.

    Returns:
        Kind to its pictures.

    Raises:
        InvalidValueError: The folder holds pictures that were made otherwise.
    """
    note: dict[str, object] = {"backgrounds": asdict(replace(config, scenes=1))}
    found: dict[str, list[LabelledPicture]] = {kind: [] for kind in kinds}
    jobs = [(kind, number) for kind in kinds for number in range(config.scenes)]
    for done, (kind, number) in enumerate(jobs, start=1):
        own = folder / f"{kind}-{number}"
        if not (own / "labels.json").is_file():
            save_pictures(background_pictures(kind, number, config), own, note)
        check_note(own, note)
        found[kind] += load(own)
        if on_step is not None:
            on_step(done, len(jobs))
    return found
