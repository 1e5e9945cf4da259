"""A kind of job: where the object is in each training picture, as a mask of 8 bits."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from attacks.cloak.kinds.parts import StepConfig
from attacks.cloak.setup import Setup
from mi_splat.capture.path_tracer import tracing_variant
from mi_splat.io.documents import save_png
from mi_splat.io.images import to_bytes
from mi_splat.io.picture_files import load_picture

if TYPE_CHECKING:
    from mi_splat.ledger import Out


def run(config: StepConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Draw the masks of the study's training cameras."""
    setup = Setup(config.study(inputs))
    with tracing_variant():
        for index, camera in enumerate(setup.training_cameras):
            mask = setup.mesh_scene.mask(camera)
            save_png(to_bytes(mask[..., None].float().expand(-1, -1, 3)), out / f"{index:04d}.png")
            out.progress("drawing masks", index + 1, len(setup.training_cameras))


def read_masks(folder: Path) -> list[Tensor]:
    """(H, W) bool masks that the job left, in the order of the cameras."""
    files = sorted(folder.glob("*.png"))
    return [torch.from_numpy(np.asarray(load_picture(file).convert("L")) > 127) for file in files]
