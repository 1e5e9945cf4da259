"""Pictures of objects of each class, path-traced from all around, and the prototypes that are made of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from attacks.classifiers.mobilenet import load_features
from attacks.classifiers.prototypes import Prototypes, PrototypesConfig
from mi_splat.camera_sets import framing, hemisphere
from mi_splat.capture.path_tracer import PathTracer
from mi_splat.capture.settings import Ground, SurroundingsSettings
from mi_splat.capture.sources import open_source

FOV = 45.0
"""Of the cameras, degrees."""
_TURN = 67.0
"""Degrees by which the cameras of each object and ground are turned against those of the one before."""


def prototype_pictures(config: PrototypesConfig, name: str) -> Tensor:
    """(B, H, W, 3) sRGB pictures of the objects of one class, a pure function of the configuration."""
    scenes = [(seed, ground) for seed in config.seeds for ground in config.grounds]
    pictures: list[Tensor] = []
    for number, (seed, ground) in enumerate(scenes):
        pictures += _pictures(config, f"{name}:{seed}", ground, turn=_TURN * number)
    return torch.stack(pictures)


def _pictures(config: PrototypesConfig, name: str, ground: Ground, *, turn: float) -> list[Tensor]:
    """Pictures of one object, such as "car:1"."""
    source = open_source(name, surroundings=SurroundingsSettings(ground=ground))
    size = (config.size, config.size)
    distance, focal = framing(source.radius, fov=FOV, size=size)
    cameras = hemisphere(
        source.centre,
        count=config.views,
        distance=distance,
        focal=focal,
        size=size,
        elevation=config.elevations,
        start=turn,
    )
    tracer = PathTracer(source.scene, samples=config.samples)
    return [tracer.picture(source.frame.camera(camera), seed=seed) for seed, camera in enumerate(cameras)]


def make_prototypes(
    config: PrototypesConfig | None = None,
    *,
    weights: Path | None = None,
    on_step: Callable[[int, int], None] = lambda done, wanted: None,
) -> Prototypes:
    """Prototypes of a configuration; those of the usual one are a part of the package."""
    config, features, pictures = config or PrototypesConfig(), load_features(weights), {}
    for number, name in enumerate(config.classes):
        pictures[name] = prototype_pictures(config, name)
        on_step(number + 1, len(config.classes))
    return Prototypes.of(pictures, features, asdict(config))
