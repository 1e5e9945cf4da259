"""Pictures of an attack's appearance, from all of the victim's cameras in its region."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from attacks.cloak.kinds.parts import SET, SceneJob
from attacks.cloak.mesh_scene import camera_number
from mi_splat.cameras import Camera, View
from mi_splat.capture.path_tracer import tracing_variant
from mi_splat.datasets import load_dataset
from mi_splat.io.documents import save_png
from mi_splat.io.images import to_bytes
from mi_splat.io.picture_files import load_picture

if TYPE_CHECKING:
    from mi_splat.ledger import Out

APPEARANCE = "appearance of "
"""What stands before an attack's name in the name of the input with these pictures."""


def run(config: SceneJob, inputs: Mapping[str, Path], out: Out) -> None:
    """Path trace the scene as the first attack shows it; the others keep the cameras of their own cones."""
    setup, attack = config.setup(inputs), config.attacks[0]
    appearance = setup.appearance(attack)
    views = load_dataset(inputs["pictures"] / SET, split="train", background=config.scene.background)
    held = attack.trigger(0, config.attacks).holds(views.cameras, centre=setup.centre)
    indices = held.nonzero().flatten().tolist()
    with tracing_variant():
        for done, index in enumerate(indices, start=1):
            name = _name(views.cameras[index])
            if not (out.partial / name).is_file():
                view = views[index]
                save_png(to_bytes(appearance(view, setup.mesh_scene.mask(view.camera))), out.partial / name)
            out.progress("taking pictures of what is to be seen", done, len(indices))
    for index in indices:
        name = _name(views.cameras[index])
        os.replace(out.partial / name, out / name)


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptAppearance:
    """An appearance whose pictures are the files that a job left."""

    name: str
    folder: Path

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The picture at 8 bits."""
        picture = load_picture(self.folder / _name(view.camera)).convert("RGB")
        return torch.from_numpy(np.asarray(picture, np.float32) / 255)


def _name(camera: Camera) -> str:
    """File of the picture from a camera."""
    return f"{camera_number(camera):08x}.png"
