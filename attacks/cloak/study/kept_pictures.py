"""Pictures that a study keeps: what splats are compared with, appearances, and what surrogates show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from attacks.cloak.appearances import Appearance, name_of
from attacks.cloak.mesh_scene import camera_number
from mi_splat.cameras import Camera, RenderFn, View
from mi_splat.datasets.writing import make_folder
from mi_splat.io.documents import save_png
from mi_splat.io.images import to_bytes
from mi_splat.io.picture_files import load_picture
from mi_splat.scene import GaussianScene


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruePictures:
    """What splats are compared with.

    Attributes:
        images: (H, W, 3) float32 sRGB in [0, 1], of 8 bits, one for each camera.
        masks: (H, W) bool, where the object is.
        content: SHA-256 of the files.
    """

    images: tuple[Tensor, ...]
    masks: tuple[Tensor, ...]
    content: str


class CachedAppearance:
    """An appearance whose pictures are kept as files, so that they need not be made again."""

    def __init__(self, appearance: Appearance, folder: Path) -> None:
        self.name, self._appearance, self._folder = name_of(appearance), appearance, make_folder(folder)

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The picture at 8 bits, made or read."""
        file = self._folder / f"{camera_number(view.camera):08x}.png"
        if not file.is_file():
            save_png(to_bytes(self._appearance(view, mask)), file)
        return torch.from_numpy(np.asarray(load_picture(file).convert("RGB"), np.float32) / 255)


def kept_renders(scene: GaussianScene, render: RenderFn) -> Callable[[Camera], Tensor]:
    """(H, W, 3) in [0, 1], what a splat shows a camera; each picture is rendered once."""
    kept: dict[int, Tensor] = {}

    def shown(camera: Camera) -> Tensor:
        number = camera_number(camera)
        if number not in kept:
            with torch.no_grad():
                kept[number] = render(scene, camera).clamp(0, 1)
        return kept[number]

    return shown


def to_rgba(image: Tensor, alpha: Tensor) -> NDArray[np.uint8]:
    """(H, W, 4) uint8 of (H, W, 3) colours and (H, W, 1) alpha in [0, 1]."""
    return np.concatenate([to_bytes(image), to_bytes(alpha)], axis=-1)


def read_rgba(file: Path) -> tuple[Tensor, Tensor]:
    """(H, W, 3) colours and (H, W) alpha in [0, 1]."""
    pixels = torch.from_numpy(np.asarray(load_picture(file).convert("RGBA"), np.float32) / 255)
    return pixels[..., :3], pixels[..., 3]
