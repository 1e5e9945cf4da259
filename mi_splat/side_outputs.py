"""What the tile rasteriser knows of each pixel besides its colour, and files for it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mi_splat import variant
from mi_splat.io.documents import save_bytes


@dataclass(frozen=True, slots=True, eq=False)
class SideOutputs:
    """A picture with opacity and depths; w_i = alpha_i T_i is the weight of Gaussian i at a pixel.

    Attributes:
        image: (H, W, 3) as `Renderer.__call__` gives it, to the bit.
        alpha: (H, W) opacity, the sum of w_i.
        depth: (H, W) expected depth sum(w_i z_i) / sum(w_i), z_i the camera-space depth of the mean, world units. It is
            0, with a gradient of 0, where alpha is 0.
        median_depth: (H, W) depth of the Gaussian at which the transmittance falls to one half or below, world units; 0
            where none does (alpha < 0.5). A step function of the scene: it is a constant to autograd.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    median_depth: Tensor


def save_floats(channels: Mapping[str, NDArray[np.float32]], path: Path) -> None:
    """Write (H, W) channels by their names as OpenEXR with 32-bit floats, without loss."""
    variant.use()
    import mitsuba as mi

    stream, planes = mi.MemoryStream(), np.stack(list(channels.values()), -1)
    mi.Bitmap(planes, mi.Bitmap.PixelFormat.MultiChannel, list(channels)).write(stream, mi.Bitmap.FileFormat.OpenEXR)
    save_bytes(bytes(stream.raw_buffer()), path)
