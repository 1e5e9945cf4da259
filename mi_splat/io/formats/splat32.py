"""The `.splat` file: 32 bytes a Gaussian, no header.

Source: convert.py and main.js of github.com/antimatter15/splat (three float32 of the mean, three of the standard
deviations, four bytes of colour and opacity, four bytes of the quaternion w, x, y, z as 128 q + 128).
"""

from __future__ import annotations

import io

import numpy as np
import torch

from mi_splat.errors import message
from mi_splat.io.errors import SplatFileError
from mi_splat.io.formats.encoded import Encoded, Values, bytes_of, dc_of, dropped_bands, outside, vanished
from mi_splat.io.loaded import Loaded, judged, read_whole
from mi_splat.scene import GaussianScene

RECORD = np.dtype([("means", "<f4", (3,)), ("scales", "<f4", (3,)), ("colours", "u1", (4,)), ("rotations", "u1", (4,))])
"""One Gaussian."""


def read_splat(file: io.FileIO, path: str) -> Loaded:
    """Read a `.splat` file.

    Raises:
        SplatFileError: Its size is no positive multiple of 32 bytes.
    """
    data = read_whole(file)
    if not data or len(data) % RECORD.itemsize:
        expected = f"whole records of {RECORD.itemsize} bytes"
        raise SplatFileError(message(path, expected, f"{len(data)} bytes", "write or download it again"))
    rows = np.frombuffer(data, RECORD)
    return judged(
        rows["means"],
        rows["scales"],
        (rows["rotations"].astype(np.float64) - 128) / 128,
        rows["colours"][:, 3] / np.float64(255),
        dc_of(rows["colours"][:, :3] / np.float64(255))[:, None],
    )


def write_splat(scene: GaussianScene) -> Encoded:
    """A scene as a `.splat` file, in the scene's order.

    Raises:
        InvalidValueError: A value is not finite in float32.
        SplatFileError: The scene is empty, which the format cannot say.
    """
    if not len(scene):
        raise SplatFileError(message("scene", "Gaussians for a .splat file", "none", "save it as a PLY"))
    values = Values.of(scene)
    rows = np.zeros(len(scene), RECORD)
    rows["means"] = values.means
    rows["scales"] = scene.scales.detach().to("cpu", torch.float32).numpy()
    rows["colours"][:, :3] = bytes_of(values.colours * 255)
    rows["colours"][:, 3] = bytes_of(values.opacities * 255)
    # -1 fits into a byte and +1 does not, so the largest component is made negative.
    largest = np.take_along_axis(values.rotations, np.abs(values.rotations).argmax(1)[:, None], 1)
    rows["rotations"] = bytes_of(values.rotations * np.where(largest > 0, -128.0, 128.0) + 128)
    losses = [
        *dropped_bands(values, 0),
        *outside("colour clamped to 0..1", values.colours, 0, 1, "of full colour"),
        *vanished(values.opacities, rows["colours"][:, 3]),
    ]
    return Encoded(rows.tobytes(), tuple(losses))
