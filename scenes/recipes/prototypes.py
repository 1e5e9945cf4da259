"""Makes the vectors of the classifier `prototypes`: `python -m
scenes.recipes.prototypes prototypes.safetensors`.

Objects of each class are path-traced from all around; a class is the mean direction of
the features of its images.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn.functional import normalize

from attacks.classifiers.frozen import Preparation
from attacks.classifiers.prototypes import load_features
from attacks.detectors.weights import fingerprint
from mi_splat.cameras.sets import framing, hemisphere
from mi_splat.capture.objects import OBJECTS
from mi_splat.capture.path_tracer import PathTracer
from mi_splat.capture.settings import Ground, SurroundingsSettings
from mi_splat.capture.sources import mesh_source
from mi_splat.io.noted_tensors import NOTES
from scenes.recipes.objects import build

FOV = 45.0
"""Of the cameras, degrees."""
_TURN = 67.0
"""Degrees by which the cameras of each object and ground are turned against those of
the one before.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """Objects of each class, what they stand on, and cameras on each ground, spread
    over the elevations.
    """

    classes: tuple[str, ...] = OBJECTS
    seeds: tuple[int, ...] = (1, 2)
    grounds: tuple[Ground, ...] = ("road", "grass", "none")
    views: int = 12
    elevations: tuple[float, float] = (0.0, 80.0)
    size: int = 160
    samples: int = 16


def pictures_of(recipe: Recipe, name: str) -> Iterator[Tensor]:
    """(H, W, 3) sRGB images of the objects of one class."""
    size = (recipe.size, recipe.size)
    scenes = [(seed, ground) for seed in recipe.seeds for ground in recipe.grounds]
    for number, (object_seed, ground) in enumerate(scenes):
        target = build(name, object_seed).body
        source = mesh_source(target, name, SurroundingsSettings(ground=ground))
        distance, lens = framing(source.radius, fov=FOV, size=size)
        cameras = hemisphere(
            source.centre,
            count=recipe.views,
            distance=distance,
            elevation=recipe.elevations,
            start=_TURN * number,
            lens=lens,
        )
        tracer = PathTracer(source.scene, samples=recipe.samples)
        yield from (
            tracer.picture(camera, seed=seed) for seed, camera in enumerate(cameras)
        )


def save_prototypes(
    pictures: Mapping[str, Sequence[Tensor]],
    features: nn.Module,
    recipe: Mapping[str, Any],
    path: Path,
) -> None:
    """Write the mean directions of the classes, less the mean of all of them."""
    prepare = Preparation()
    means = []
    for images in pictures.values():
        with torch.no_grad():
            rows = [
                normalize(features(prepare(image[None])), dim=1) for image in images
            ]
        means.append(normalize(torch.cat(rows).mean(0), dim=0))
    centre = torch.stack(means).mean(0)
    directions = normalize(torch.stack(means) - centre, dim=1)
    notes = {
        "classes": list(pictures),
        "features": fingerprint(features.state_dict()),
        "recipe": dict(recipe),
    }
    save_file(
        {"directions": directions, "centre": centre},
        path,
        metadata={NOTES: json.dumps(notes)},
    )


if __name__ == "__main__":
    usual = Recipe()
    images = {name: list(pictures_of(usual, name)) for name in usual.classes}
    save_prototypes(images, load_features(), asdict(usual), Path(sys.argv[1]))
