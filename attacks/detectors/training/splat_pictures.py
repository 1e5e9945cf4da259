"""Labelled renders of splats: what the detector is for."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from attacks.detectors.training.dataset import check_note, load, save_samples
from attacks.detectors.training.pictures import Photographer, PictureSetConfig, Sample
from mi_splat.assets.mesh import Asset
from mi_splat.assets.primitives import ellipsoid
from mi_splat.cameras import RenderFn, View
from mi_splat.capture.mesh_splats import DiscConfig, RefineConfig, disc_splat, refine
from mi_splat.capture.path_tracer import depth_maps, scalar_variant
from mi_splat.capture.surface_sampling import nearness, surface_samples
from mi_splat.errors import InvalidValueError
from mi_splat.rendering import Renderer
from mi_splat.scene import GaussianScene, merge


@dataclass(frozen=True, slots=True, kw_only=True)
class SplatConfig:
    """How a splat is made of a scene, and how many pictures are taken of it.

    Attributes:
        views: Path-traced pictures that the splat is fitted to.
        samples: Samples per pixel in them.
        objects: Gaussians for each object.
        surroundings: Gaussians for all around it.
        sky: Gaussians for the sky.
        steps: Steps of refinement; 0 leaves the discs as they are laid.
        pictures: Renders of each splat, from cameras that none of the views used.
    """

    views: int = 16
    samples: int = 12
    objects: int = 12_000
    surroundings: int = 30_000
    sky: int = 1_500
    steps: int = 100
    pictures: int = 4


def splat_samples(recipe: PictureSetConfig, number: int, config: SplatConfig, *, render: RenderFn) -> list[Sample]:
    """Labelled renders of a splat of scene `number`; the labels are those of the meshes it was made from."""
    photographer = Photographer(replace(recipe, samples=config.samples), number)
    with scalar_variant():
        tests = [photographer.aim() for _ in range(config.pictures)]
        views = [photographer.take(photographer.aim()) for _ in range(config.views)]
    splat = splat_of(photographer, views, config, render)
    with torch.no_grad():
        pictures = [render(splat, camera) for camera in tests]
    with scalar_variant():
        return [photographer.label(camera, picture) for camera, picture in zip(tests, pictures, strict=True)]


def splat_set(
    recipe: PictureSetConfig,
    numbers: Sequence[int],
    folder: Path,
    config: SplatConfig,
    *,
    on_step: Callable[[int, int], None] | None = None,
) -> list[Sample]:
    """Labelled renders of splats of many scenes, each kept in a folder of its own; what is missing is made.

    Args:
        recipe: What the scenes are made of.
        numbers: Scenes of the recipe.
        folder: Where the pictures are kept.
        config: How splats are made.
        on_step: Called with the number of scenes done and the number wanted.

    Raises:
        InvalidValueError: The folder holds renders of another recipe, or of splats that were made otherwise.
    """
    render, samples = Renderer(), []
    note: dict[str, object] = {"scenes": asdict(replace(recipe, count=1)), "splats": asdict(config)}
    for done, number in enumerate(numbers, start=1):
        own = folder / f"{number}"
        if not (own / "labels.json").is_file():
            save_samples(splat_samples(recipe, number, config, render=render), own, note)
        check_note(own, note)
        samples += load(own)
        if on_step is not None:
            on_step(done, len(numbers))
    return samples


def splat_of(photographer: Photographer, views: Sequence[View], config: SplatConfig, render: RenderFn) -> GaussianScene:
    """A splat of a photographed scene: objects, surroundings and sky."""
    cameras = [view.camera for view in views]
    depths = depth_maps(photographer.scene, cameras)
    place = photographer.place
    dome = Asset("sky", (ellipsoid((440.0, 440.0, 440.0), (0.6, 0.7, 0.8), segments=48),))
    wanted = [(asset, config.objects, 0.62) for asset in place.assets]
    wanted += [(place.surroundings, config.surroundings, 0.62), (dome, config.sky, 0.9)]
    parts = []
    for asset, count, overlap in wanted:
        density = nearness(cameras, closest=0.3) if asset is place.surroundings else None
        samples = surface_samples(asset, count, density=density)
        with contextlib.suppress(InvalidValueError):  # a part that no picture shows is left out
            parts.append(disc_splat(samples, views, depths, config=DiscConfig(overlap=overlap)))
    whole = merge(*parts)
    if config.steps == 0:
        return whole
    return refine(whole, views, render=render, config=RefineConfig(steps=config.steps))
