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

from attacks.cloak.kinds.parts import Pose, SceneJob
from mi_splat.cameras import View
from mi_splat.capture.path_tracer import tracing_variant
from mi_splat.io.documents import save_png
from mi_splat.io.images import to_bytes
from mi_splat.io.picture_files import load_picture

if TYPE_CHECKING:
    from mi_splat.ledger import Out


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueConfig(SceneJob):
    """What is photographed, and from where; the object has the appearance of the first attack, if there is one."""

    poses: tuple[Pose, ...]
    inside: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruePictures:
    """What splats are compared with."""

    images: tuple[Tensor, ...]  # (H, W, 3) float32 sRGB in [0, 1], of 8 bits, one for each camera
    masks: tuple[Tensor, ...]  # (H, W) bool, where the object is


def run(config: TrueConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Take the pictures; those of an appearance begin with the scene as it is, the input `plain`."""
    setup = config.setup(inputs)
    mesh_scene = setup.mesh_scene
    appearances = [(attack.cone, setup.appearance(attack)) for attack in config.attacks]
    plain = read_pictures(inputs["plain"]) if appearances else None
    names = [f"{number:04d}.png" for number in range(len(config.poses))]
    with tracing_variant():
        for number, (name, pose) in enumerate(zip(names, config.poses, strict=True)):
            if not (out.partial / name).is_file():
                camera = pose.camera
                if plain is None:
                    image, mask = mesh_scene.picture(camera), mesh_scene.mask(camera)
                else:
                    image, mask = plain.images[number], plain.masks[number]
                for cone, appearance in appearances:
                    if not config.inside or cone.angle_to_edge(camera, centre=setup.centre) >= 0:
                        image = appearance(View(camera, image), mask)
                        break
                rgba = np.concatenate([to_bytes(image), to_bytes(mask[..., None].float())], axis=-1)
                save_png(rgba, out.partial / name)
            out.progress("taking pictures to compare with", number + 1, len(names))
    for name in names:
        os.replace(out.partial / name, out / name)


def read_pictures(folder: Path) -> TruePictures:
    """The pictures that the job left, in the order of the cameras."""
    pixels = [np.asarray(load_picture(file).convert("RGBA"), np.float32) for file in sorted(folder.glob("*.png"))]
    rgba = [torch.from_numpy(values / 255) for values in pixels]
    return TruePictures(
        images=tuple(values[..., :3] for values in rgba), masks=tuple(values[..., 3] > 0.5 for values in rgba)
    )
