"""The `.splat` file: 32 bytes a Gaussian, no header.

Source: convert.py and main.js of github.com/antimatter15/splat (three float32 of the
mean, three of the standard deviations, four bytes of colour and opacity, four bytes of
the quaternion w, x, y, z as 128 q + 128).
"""

import io

import numpy as np
from numpy.typing import NDArray

from mi_splat.io.errors import SplatFileError
from mi_splat.io.formats.format import Format, Saving
from mi_splat.io.loaded import (
    Array,
    Arrays,
    Encoded,
    Loaded,
    Values,
    bytes_of,
    dropped_bands,
    outside,
    read_whole,
    validated,
    vanished,
)
from mi_splat.maths.sh import colour_to_dc

RECORD = np.dtype(
    [
        ("means", "<f4", (3,)),
        ("scales", "<f4", (3,)),
        ("colours", "u1", (4,)),
        ("rotations", "u1", (4,)),
    ]
)
"""One Gaussian."""

_LENGTHS = (1.0, *(1 + sign * step / 256 for step in range(1, 7) for sign in (1, -1)))
_LONGEST = 5 / 256


def read_splat(file: io.FileIO, path: str) -> Loaded:
    """Read a `.splat` file."""
    data = read_whole(file)
    if not data or len(data) % RECORD.itemsize:
        expected = f"whole records of {RECORD.itemsize} bytes"
        raise SplatFileError.of(
            path, expected, f"{len(data)} bytes", "write or download it again"
        )
    rows = np.frombuffer(data, RECORD)
    return validated(
        rows["means"],
        rows["scales"],
        (rows["rotations"].astype(np.float64) - 128) / 128,
        rows["colours"][:, 3] / np.float64(255),
        colour_to_dc(rows["colours"][:, :3] / np.float64(255))[:, None],
    )


def write_splat(arrays: Arrays, saving: Saving) -> Encoded:
    """A scene as a `.splat` file, in the scene's order."""
    values = Values.of(arrays)
    rows = np.zeros(len(values.means), RECORD)
    rows["means"] = arrays["means"]
    rows["scales"] = arrays["scales"]
    rows["colours"][:, :3] = bytes_of(values.colours * 255)
    rows["colours"][:, 3] = bytes_of(values.opacities * 255)
    rows["rotations"] = _pack_rotations(values.rotations)
    losses = [
        *dropped_bands(values.sh, 0),
        *outside("colour clamped to 0..1", values.colours, 0, 1, "of full colour"),
        *vanished(values.opacities, rows["colours"][:, 3]),
    ]
    return Encoded(rows.tobytes(), tuple(losses))


def _pack_rotations(rotations: Array) -> NDArray[np.uint8]:
    """(N, 4) bytes 128 q + 128, of the length near one that best keeps the direction,
    so that bytes read come back.
    """
    largest = np.take_along_axis(
        rotations, np.abs(rotations).argmax(axis=1)[:, None], 1
    )
    # -1 fits into a byte and +1 does not
    turned = rotations * np.where(largest > 0, -1.0, 1.0)
    best = np.full(len(rotations), -np.inf)
    packed = np.zeros((len(rotations), 4), np.uint8)
    for length in _LENGTHS:
        tried = bytes_of(128 * length * turned + 128)
        vectors = tried.astype(np.float64) - 128
        lengths = np.linalg.norm(vectors, axis=1)
        cosines = (vectors * turned).sum(axis=1) / lengths
        better = (cosines > best + 1e-12) & (
            (np.abs(lengths / 128 - 1) <= _LONGEST) | (length == 1)
        )
        best[better], packed[better] = cosines[better], tried[better]
    return packed


SPLAT = Format(
    name="splat",
    suffixes=(".splat",),
    read=read_splat,
    write=write_splat,
    keeps_nothing=False,
    in_archives=True,
)
