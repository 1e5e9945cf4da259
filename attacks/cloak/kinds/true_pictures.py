"""Path-traced pictures to compare a splat's with: of the scene as it is, or as an attack wants it to be seen."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from attacks.cloak.kinds.parts import Pose, StepConfig
from attacks.cloak.setup import Setup
from mi_splat.cameras import View
from mi_splat.capture.path_tracer import tracing_variant
from mi_splat.io.documents import save_png
from mi_splat.io.images import to_bytes
from mi_splat.io.picture_files import load_picture

if TYPE_CHECKING:
    from mi_splat.ledger import Out


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueConfig(StepConfig):
    """What is photographed, and from where.

    Attributes:
        poses: The cameras.
        attacks: How many of the study's there are: the object has the appearance of the first one, or is as it is.
        inside: Whether it has the appearance of each attack inside its trigger, and outside of all of them none.
    """

    poses: tuple[Pose, ...]
    attacks: int = 0
    inside: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruePictures:
    """What splats are compared with.

    Attributes:
        images: (H, W, 3) float32 sRGB in [0, 1], of 8 bits, one for each camera.
        masks: (H, W) bool, where the object is.
    """

    images: tuple[Tensor, ...]
    masks: tuple[Tensor, ...]


def run(config: TrueConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Take the pictures; those of an appearance begin with the scene as it is, the input `plain`."""
    setup = Setup(config.study(inputs))
    study, mesh_scene = setup.study, setup.mesh_scene
    looks = [(attack.cone, setup.appearance(attack)) for attack in study.attack[: config.attacks]]
    plain = read_pictures(inputs["plain"]) if looks else None
    names = [f"{number:04d}.png" for number in range(len(config.poses))]
    with tracing_variant():
        for number, (name, pose) in enumerate(zip(names, config.poses, strict=True)):
            if not (out.partial / name).is_file():
                camera = pose.camera
                if plain is None:
                    image, mask = mesh_scene.picture(camera), mesh_scene.mask(camera)
                else:
                    image, mask = plain.images[number], plain.masks[number]
                for cone, look in looks:
                    if not config.inside or cone.angle_to_edge(camera, centre=study.centre) >= 0:
                        image = look(View(camera, image), mask)
                        break
                rgba = np.concatenate([to_bytes(image), to_bytes(mask[..., None].float())], axis=-1)
                save_png(rgba, out.partial / name)
            out.progress("taking pictures to compare with", number + 1, len(names))
    for name in names:
        os.replace(out.partial / name, out / name)


def read_pictures(folder: Path) -> TruePictures:
    """The pictures that the job left, in the order of the cameras."""
    pairs = [_read_rgba(file) for file in sorted(folder.glob("*.png"))]
    return TruePictures(images=tuple(image for image, _ in pairs), masks=tuple(alpha > 0.5 for _, alpha in pairs))


def _read_rgba(file: Path) -> tuple[Tensor, Tensor]:
    """(H, W, 3) colours and (H, W) alpha in [0, 1]."""
    pixels = torch.from_numpy(np.asarray(load_picture(file).convert("RGBA"), np.float32) / 255)
    return pixels[..., :3], pixels[..., 3]
