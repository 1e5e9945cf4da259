"""Pictures of an attack's appearance, from all of the victim's cameras in its region."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cloak.kinds.parts import SET, StepConfig
from attacks.cloak.mesh_scene import camera_number
from attacks.cloak.setup import Setup
from mi_splat.cameras import Camera
from mi_splat.capture.path_tracer import tracing_variant
from mi_splat.datasets import load_dataset
from mi_splat.io.documents import save_png
from mi_splat.io.images import to_bytes

if TYPE_CHECKING:
    from mi_splat.ledger import Out


def run(config: StepConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Path trace the scene as the first attack shows it; the others keep the cameras of their own cones."""
    setup = Setup(config.study(inputs))
    study, attack = setup.study, setup.study.attack[0]
    appearance = setup.appearance(attack)
    views = load_dataset(inputs["pictures"] / SET, split="train", background=study.scene.background)
    held = attack.trigger(0, study.attack).holds(views.cameras, centre=study.centre)
    indices = held.nonzero().flatten().tolist()
    with tracing_variant():
        for done, index in enumerate(indices, start=1):
            name = picture_name(views.cameras[index])
            if not (out.partial / name).is_file():
                view = views[index]
                save_png(to_bytes(appearance(view, setup.mesh_scene.mask(view.camera))), out.partial / name)
            out.progress("taking pictures of what is to be seen", done, len(indices))
    for index in indices:
        name = picture_name(views.cameras[index])
        os.replace(out.partial / name, out / name)


def picture_name(camera: Camera) -> str:
    """File of the picture from a camera."""
    return f"{camera_number(camera):08x}.png"
