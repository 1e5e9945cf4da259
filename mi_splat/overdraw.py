"""Overdraw: how many Gaussians a renderer of tiles has to walk through at each place of a picture."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from mi_splat import variant
from mi_splat.cameras import Camera
from mi_splat.scene import GaussianScene, check_scene

Layers = NDArray[np.int64]
"""(rows, columns) numbers of Gaussians on the lists of the tiles of a picture, 4 x 4 pixels each."""


def overdraw(scene: GaussianScene, cameras: Sequence[Camera], *, near: float) -> Iterator[Layers]:
    """How many Gaussians the list of each tile holds, camera by camera: exactly those that the rasteriser would make.

    No list is made, so memory does not grow with what Gaussians cover.
    """
    check_scene("scene", scene)
    variant.use()
    import mitsuba as mi

    from mi_splat.rasterization import layouts
    from mi_splat.rasterization.frozen import aligned
    from mi_splat.rasterization.layers import layers_of_tiles
    from mi_splat.rasterization.pinhole import Pinhole

    geometry = [value.detach().float().contiguous().flatten() for value in scene.tensors()[:4]]
    grey = scene.sh.detach().new_zeros(3 * len(scene)).float()  # colours cost time, and hide nothing from a list
    arrays = tuple(aligned(mi.Float(value)) for value in (*geometry, grey))
    for camera in cameras:
        yield layers_of_tiles(layouts.TENSORS, arrays, Pinhole(camera=camera, near=near))
