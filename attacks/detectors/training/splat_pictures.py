"""Labelled renders of splats: what the detector is for."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import torch

from attacks.detectors.training.config import PictureSetConfig, SplatConfig
from attacks.detectors.training.dataset import check_note, load, save_pictures
from attacks.detectors.training.pictures import LabelledPicture, SceneRenderer
from mi_splat.assets.mesh import Asset
from mi_splat.assets.primitives import ellipsoid
from mi_splat.cameras import RenderFn, View
from mi_splat.capture.mesh_splats import DiscConfig, RefineConfig, disc_splat, refine
from mi_splat.capture.path_tracer import depth_maps, scalar_variant
from mi_splat.capture.surface_sampling import nearness, surface_samples
from mi_splat.errors import InvalidValueError
from mi_splat.rendering import Renderer
from mi_splat.scene import GaussianScene, merge


def splat_pictures(
    scenes: PictureSetConfig, number: int, config: SplatConfig, *, render: RenderFn
) -> list[LabelledPicture]:
    """Labelled renders of a splat of one scene; the labels are those of the meshes it was made from.

    Args:
        scenes: What the scenes are made of.
        number: Which of these scenes.
        config: How the splat is made, and how many renders of it.
        render: Renders the splat.
    """
    renderer = SceneRenderer(replace(scenes, samples=config.samples), number)
    with scalar_variant():
        tests = [renderer.choose_camera() for _ in range(config.pictures)]
        views = [renderer.render(renderer.choose_camera()) for _ in range(config.views)]
    splat = splat_of(renderer, views, config, render)
    with torch.no_grad():
        pictures = [render(splat, camera) for camera in tests]
    with scalar_variant():
        return [renderer.label(camera, picture) for camera, picture in zip(tests, pictures, strict=True)]


def splat_set(
    scenes: PictureSetConfig,
    numbers: Sequence[int],
    folder: Path,
    config: SplatConfig,
    *,
    on_step: Callable[[int, int], None] | None = None,
) -> list[LabelledPicture]:
    """Labelled renders of splats of many scenes, each kept in a folder of its own; what is missing is made.

    Args:
        scenes: What the scenes are made of.
        numbers: Which of these scenes.
        folder: Where the pictures are kept.
        config: How splats are made.
        on_step: Called with the number of scenes done and the number wanted.

    Raises:
        InvalidValueError: The folder holds renders of other scenes, or of splats that were made otherwise.
    """
    render, samples = Renderer(), []
    note: dict[str, object] = {"scenes": asdict(replace(scenes, count=1)), "splats": asdict(config)}
    for done, number in enumerate(numbers, start=1):
        own = folder / f"{number}"
        if not (own / "labels.json").is_file():
            save_pictures(splat_pictures(scenes, number, config, render=render), own, note)
        check_note(own, note)
        samples += load(own)
        if on_step is not None:
            on_step(done, len(numbers))
    return samples


def splat_of(renderer: SceneRenderer, views: Sequence[View], config: SplatConfig, render: RenderFn) -> GaussianScene:
    """A splat of a path-traced scene: objects, surroundings and sky.

    Args:
        renderer: The scene, and what is in it.
        views: Path-traced pictures of it, from which the colours come.
        config: How many Gaussians and steps of refinement.
        render: What the refinement differentiates.
    """
    cameras = [view.camera for view in views]
    depths = depth_maps(renderer.scene, cameras)
    contents = renderer.contents
    dome = Asset("sky", (ellipsoid((440.0, 440.0, 440.0), (0.6, 0.7, 0.8), segments=48),))
    wanted = [(asset, config.objects, 0.62) for asset in contents.assets]
    wanted += [(contents.surroundings, config.surroundings, 0.62), (dome, config.sky, 0.9)]
    parts = []
    for asset, count, overlap in wanted:
        density = nearness(cameras, closest=0.3) if asset is contents.surroundings else None
        samples = surface_samples(asset, count, density=density)
        with contextlib.suppress(InvalidValueError):  # a part that no picture shows is left out
            parts.append(disc_splat(samples, views, depths, config=DiscConfig(overlap=overlap)))
    whole = merge(*parts)
    if config.steps == 0:
        return whole
    return refine(whole, views, render=render, config=RefineConfig(steps=config.steps))
