"""Path-traced images: the victim's set of the scene, and single ones of it as it is
or as an attack shows it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from attacks.cloak.mesh_scene import camera_number
from attacks.cloak.setup import SET, Pose, Setup
from mi_splat.cameras.camera import Camera, View
from mi_splat.capture.path_tracer import tracing_variant
from mi_splat.capture.settings import CaptureSettings
from mi_splat.capture.writer import write_capture
from mi_splat.datasets import load_dataset
from mi_splat.io.documents import save_png
from mi_splat.io.images import to_bytes
from mi_splat.io.picture_files import load_picture

if TYPE_CHECKING:
    from mi_splat.ledger import Out

VARIES = (f"{SET}/capture.json",)
APPEARANCE = "appearance of "
"""What stands before an attack's name in the name of the input with images of its
appearance.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class PicturesConfig(Setup):
    """From where; the object has the appearance of the attack, if there is one."""

    # None are the victim's cameras, whose images are a set
    poses: tuple[Pose, ...] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruePictures:
    """What splats are compared with."""

    # (H, W, 3) float32 sRGB in [0, 1], of 8 bits, one for each camera
    images: tuple[Tensor, ...]
    masks: tuple[Tensor, ...]  # (H, W) bool, where the object is


def run(config: PicturesConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Take the images; those of an appearance begin with the victim's `set`, or with
    images of the scene: `plain`.

    A set is transparent where nothing is, so that the background has no part in it.
    """
    setup = config.given(inputs)
    mesh_scene = setup.mesh_scene
    if config.poses is None:
        settings = CaptureSettings(
            samples=setup.cameras.samples, rgba=True, points=setup.cameras.points
        )
        told = partial(out.progress, "taking the victim's images")
        write_capture(
            setup.source,
            setup.training_cameras,
            out.partial / SET,
            settings=settings,
            on_step=told,
        )
        os.replace(out.partial / SET, out / SET)
        return
    appearances = [setup.appearance(attack) for attack in setup.attacks]
    plain = read_pictures(inputs["plain"]) if "plain" in inputs else None
    if "set" in inputs:
        views = load_dataset(inputs["set"] / SET, background=config.scene.background)
    else:
        views = None
    if views is not None:
        taken = {
            camera_number(camera): index for index, camera in enumerate(views.cameras)
        }
    else:
        taken = {}
    names = []

    def as_it_is(number: int, camera: Camera) -> tuple[View, Tensor]:
        if plain is not None:
            return View(camera, plain.images[number]), plain.masks[number]
        if views is None:
            view = View(camera, mesh_scene.picture(camera))
        else:
            view = views[taken[camera_number(camera)]]
        return view, mesh_scene.mask(view.camera)

    with tracing_variant():
        for number, pose in enumerate(config.poses):
            name = f"{number:04d}-{camera_number(pose.camera):08x}.png"
            if not (out.partial / name).is_file():
                view, mask = as_it_is(number, pose.camera)
                image = appearances[0](view, mask) if appearances else view.image
                rgba = np.concatenate(
                    [to_bytes(image), to_bytes(mask[..., None].float())], axis=-1
                )
                save_png(rgba, out.partial / name)
            names.append(name)
            out.progress("taking images", len(names), len(config.poses))
    for name in names:
        os.replace(out.partial / name, out / name)


def read_pictures(folder: Path) -> TruePictures:
    """The images that the job left, in the order of the cameras."""
    rgba = [_read(file) for file in sorted(folder.glob("*.png"))]
    return TruePictures(
        images=tuple(values[..., :3] for values in rgba),
        masks=tuple(values[..., 3] > 0.5 for values in rgba),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptAppearance:
    """An appearance whose images are the files that a job left."""

    name: str
    folder: Path

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The image at 8 bits."""
        (file,) = self.folder.glob(f"*-{camera_number(view.camera):08x}.png")
        return _read(file)[..., :3]


def _read(file: Path) -> Tensor:
    """(H, W, 4) float32 in [0, 1]."""
    return torch.from_numpy(
        np.asarray(load_picture(file).convert("RGBA"), np.float32) / 255
    )
