"""The object and the cameras that a command's options describe, which depend on each other."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mi_splat.cameras import Camera
from mi_splat.cli.cameras import find_cameras, render_settings, renderer_of
from mi_splat.cli.options import CameraOptions
from mi_splat.rendering import Renderer
from mi_splat.scene_files import SplatScene
from mi_splat.selection.config import Selection
from mi_splat.selection.select import select
from mi_splat.selection.visibility import object_weight


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chosen:
    """An object, and where it is looked at from.

    Attributes:
        mask: (N,) bool, the object's Gaussians.
        cameras: By name.
        render: Makes their pictures.
    """

    mask: Tensor
    cameras: dict[str, Camera]
    render: Renderer

    def weights(self, loaded: SplatScene) -> dict[str, Tensor]:
        """(H, W) share of each pixel that the object makes up, by the camera's name."""
        return {
            name: object_weight(loaded.scene, self.mask, camera, self.render) for name, camera in self.cameras.items()
        }


def choose(loaded: SplatScene, selection: Selection, options: CameraOptions) -> Chosen:
    """The object and the cameras.

    A click is on the picture that `mi-splat render` makes with the same flags, so with one the cameras come first.
    Otherwise the object does, and cameras that nothing else is said of look at it.

    Args:
        loaded: The scene.
        selection: Which object.
        options: Which cameras.

    Raises:
        InvalidValueError: As in `select` and `find_cameras`.
        DatasetError: As in `find_cameras`.
        SplatFileError: A mask file cannot be read.
    """
    if selection.click:
        cameras = find_cameras(loaded, options)
        render = renderer_of(loaded, options, cameras)
        first = next(iter(cameras.values()))
        mask = select(loaded.scene, selection, objects=loaded.objects, camera=first, render=render)
        return Chosen(mask=mask, cameras=cameras, render=render)
    mask = select(loaded.scene, selection, objects=loaded.objects)
    return look_at_object(loaded, mask, options)


def look_at_object(loaded: SplatScene, mask: Tensor, options: CameraOptions) -> Chosen:
    """An object that is known, and the cameras.

    Args:
        loaded: The scene.
        mask: (N,) bool, the object's Gaussians.
        options: Which cameras; those that nothing else is said of look at the object, from where most of it shows.
    """

    def shows(camera: Camera) -> float:
        small = Renderer(render_settings(loaded, options, {"": camera}))
        with torch.no_grad():
            return float(object_weight(loaded.scene, mask, camera, small).mean())

    cameras = find_cameras(loaded, options, focus=loaded.scene.select(mask), shows=shows)
    return Chosen(mask=mask, cameras=cameras, render=renderer_of(loaded, options, cameras))
