"""3D Gaussian splats in Mitsuba: scenes, files, rendering, capture, training.

The names below are imported when they are first used, so that importing this package is light.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mi_splat import _lazy

if TYPE_CHECKING:
    from mi_splat.camera_sets import hemisphere, orbit
    from mi_splat.cameras import Camera, RenderFn, View, look_at
    from mi_splat.datasets import load_dataset
    from mi_splat.errors import InvalidValueError, MiSplatError
    from mi_splat.io import SplatFileError, load_splat, save_splat
    from mi_splat.rendering import Renderer, RenderSettings, ScreenGradients
    from mi_splat.scene import GaussianScene, Similarity, merge
    from mi_splat.scene_files import SplatScene, read_scene
    from mi_splat.training.loop import Fit, FitConfig, fit

__all__ = [
    "Camera",
    "Fit",
    "FitConfig",
    "GaussianScene",
    "InvalidValueError",
    "MiSplatError",
    "RenderFn",
    "RenderSettings",
    "Renderer",
    "ScreenGradients",
    "Similarity",
    "SplatFileError",
    "SplatScene",
    "View",
    "fit",
    "hemisphere",
    "load_dataset",
    "load_splat",
    "look_at",
    "merge",
    "orbit",
    "read_scene",
    "save_splat",
]

__getattr__, __dir__ = _lazy.attach(
    __name__,
    {
        "mi_splat.camera_sets": ("hemisphere", "orbit"),
        "mi_splat.cameras": ("Camera", "RenderFn", "View", "look_at"),
        "mi_splat.datasets": ("load_dataset",),
        "mi_splat.errors": ("InvalidValueError", "MiSplatError"),
        "mi_splat.io": ("SplatFileError", "load_splat", "save_splat"),
        "mi_splat.rendering": ("Renderer", "RenderSettings", "ScreenGradients"),
        "mi_splat.scene_files": ("SplatScene", "read_scene"),
        "mi_splat.scene": ("GaussianScene", "Similarity", "merge"),
        "mi_splat.training.loop": ("Fit", "FitConfig", "fit"),
    },
)
