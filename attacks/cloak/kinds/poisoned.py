"""The set that CLOAK poisons: other files in the place of some pictures, all others the same bytes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from attacks.cloak.appearances import Appearance, name_of
from attacks.cloak.config import AttackConfig
from attacks.cloak.kinds.looks import picture_name as look_name
from attacks.cloak.kinds.parts import SET, StepConfig
from attacks.cloak.kinds.rendering import renderer_of
from attacks.cloak.mesh_scene import camera_number
from attacks.cloak.poisoning import Cloak
from attacks.cloak.setup import Setup
from attacks.poisons.base import MANIFEST
from attacks.poisons.writing import write_poisoned
from mi_splat.cameras import Camera, RenderFn, View
from mi_splat.capture.path_tracer import tracing_variant
from mi_splat.datasets import load_dataset
from mi_splat.io import load_splat
from mi_splat.io.documents import save_json
from mi_splat.io.picture_files import load_picture
from mi_splat.scene import GaussianScene

if TYPE_CHECKING:
    from mi_splat.ledger import Out


def run(config: StepConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Poison a set; surrogates, `surrogate 1` and so on, correct it in their order."""
    setup = Setup(config.study(inputs))
    study = setup.study
    views = load_dataset(inputs["pictures"] / SET, split="train", background=study.scene.background)
    rounds = range(1, 1 + sum(name.startswith("surrogate ") for name in inputs))
    shown = [_kept_renders(load_splat(inputs[f"surrogate {number}"]), renderer_of(study)) for number in rounds]

    def kept(appearance: Appearance, attack: AttackConfig) -> Appearance:
        return KeptAppearance(name=name_of(appearance), folder=inputs[f"look of {attack.name}"])

    cloak = Cloak(
        poisonings=lambda seed: setup.poisonings(seed=seed, cached=kept, surrogates=shown),
        centre=study.centre,
        masks=setup.mesh_scene.mask,
    )
    with tracing_variant():
        done = cloak(views, seed=study.seeds[0], on_step=partial(out.progress, "poisoning"))
    write_poisoned(out / SET, views, done)
    save_json(done.manifest, out / MANIFEST)


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptAppearance:
    """An appearance whose pictures are files (`attacks.cloak.kinds.looks`).

    Attributes:
        name: For manifests.
        folder: With the files.
    """

    name: str
    folder: Path

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The picture at 8 bits."""
        picture = load_picture(self.folder / look_name(view.camera)).convert("RGB")
        return torch.from_numpy(np.asarray(picture, np.float32) / 255)


def _kept_renders(scene: GaussianScene, render: RenderFn) -> Callable[[Camera], Tensor]:
    """(H, W, 3) in [0, 1], what a splat shows a camera; each picture is rendered once."""
    pictures: dict[int, Tensor] = {}

    def shown(camera: Camera) -> Tensor:
        number = camera_number(camera)
        if number not in pictures:
            with torch.no_grad():
                pictures[number] = render(scene, camera).clamp(0, 1)
        return pictures[number]

    return shown
