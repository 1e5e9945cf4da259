"""3D Gaussian splats in Mitsuba: scenes, files, rendering, capture, training.

The names below are imported when they are first used, so that importing this package is
light.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mi_splat import _lazy

if TYPE_CHECKING:
    from mi_splat.cameras.camera import Camera, RenderFn, View, look_at
    from mi_splat.cameras.lens import Lens
    from mi_splat.cameras.sets import hemisphere
    from mi_splat.datasets import load_dataset
    from mi_splat.errors import MiSplatError
    from mi_splat.io import load_splat, save_splat
    from mi_splat.render.renderer import Renderer, RenderSettings, ScreenGradients
    from mi_splat.render.scene_files import read_scene
    from mi_splat.scene import GaussianScene
    from mi_splat.selection.config import Selection
    from mi_splat.selection.select import select
    from mi_splat.training.initialization import from_points
    from mi_splat.training.loop import FitConfig, fit

__all__ = [
    "Camera",
    "FitConfig",
    "GaussianScene",
    "Lens",
    "MiSplatError",
    "RenderFn",
    "RenderSettings",
    "Renderer",
    "ScreenGradients",
    "Selection",
    "View",
    "fit",
    "from_points",
    "hemisphere",
    "load_dataset",
    "load_splat",
    "look_at",
    "read_scene",
    "save_splat",
    "select",
]

__getattr__, __dir__ = _lazy.attach(
    __name__,
    {
        "mi_splat.cameras.sets": ("hemisphere",),
        "mi_splat.cameras.lens": ("Lens",),
        "mi_splat.cameras.camera": ("Camera", "RenderFn", "View", "look_at"),
        "mi_splat.datasets": ("load_dataset",),
        "mi_splat.errors": ("MiSplatError",),
        "mi_splat.io": ("load_splat", "save_splat"),
        "mi_splat.render.renderer": ("Renderer", "RenderSettings", "ScreenGradients"),
        "mi_splat.scene": ("GaussianScene",),
        "mi_splat.render.scene_files": ("read_scene",),
        "mi_splat.selection.config": ("Selection",),
        "mi_splat.selection.select": ("select",),
        "mi_splat.training.initialization": ("from_points",),
        "mi_splat.training.loop": ("FitConfig", "fit"),
    },
)
