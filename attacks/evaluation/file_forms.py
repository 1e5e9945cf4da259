"""A splat as it comes back from another file: other formats, half precision, fewer SH bands."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path

from mi_splat.errors import InvalidValueError, message
from mi_splat.io import SplatLossWarning, load_splat, save_splat
from mi_splat.scene import GaussianScene

FORMATS = (".ply", ".compressed.ply", ".spz", ".sog", ".glb", ".splat")
"""Formats that a splat can go through."""


def through_file(scene: GaussianScene, suffix: str) -> GaussianScene:
    """The splat after it was saved in a format and loaded again.

    Args:
        scene: The splat.
        suffix: One of `FORMATS`.

    Raises:
        InvalidValueError: It is none of them.
    """
    if suffix not in FORMATS:
        raise InvalidValueError(message("format", f"one of {', '.join(FORMATS)}", suffix, "choose one"))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", SplatLossWarning)
        path = Path(folder) / f"splat{suffix}"
        save_splat(scene, path)
        return load_splat(path)


def half_precision(scene: GaussianScene) -> GaussianScene:
    """The splat with SH rounded to float16."""
    return scene.replace(sh=scene.sh.half().to(scene.sh))


def fewer_bands(scene: GaussianScene, degree: int) -> GaussianScene:
    """The splat with SH of at most this degree."""
    return scene.with_degree(min(degree, scene.degree))
