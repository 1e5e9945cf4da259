"""Masks of Gaussians: of a box, and in files."""

import io
import math
import os
import tokenize
from pathlib import Path

import numpy as np
import torch
from numpy.lib import format as npy
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import save_bytes
from mi_splat.io.errors import SplatFileError, from_os_error
from mi_splat.io.loaded import open_regular, read_whole
from mi_splat.io.points import load_points
from mi_splat.rotation import multiply, to_matrix
from mi_splat.scene import GaussianScene

_NPY_HEADER = 10_000
"""Bytes that a header may have; NumPy's own limit."""
_READERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
# What NumPy raises for headers that are broken in one way or another: it reads them as Python.
_BROKEN = (
    *(ValueError, EOFError, TypeError, SyntaxError, LookupError, AttributeError, ArithmeticError, RecursionError),
    *(MemoryError, tokenize.TokenError),
)


def box_mask(
    scene: GaussianScene,
    box: tuple[float, float, float, float, float, float],
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Tensor:
    """(N,) bool, which Gaussians have their means in a box; those on its faces count."""
    low, high = torch.tensor([box[:3], box[3:]], dtype=torch.float64)
    yaw, pitch, roll = rotation
    turn = to_matrix(multiply(_about(2, yaw), multiply(_about(1, pitch), _about(0, roll))))
    local = (scene.means.detach().cpu().double() - (low + high) / 2) @ turn  # by the inverse, as rows
    inside: Tensor = (local.abs() <= (high - low) / 2).all(1)
    return inside


def _about(axis: int, degrees: float) -> Tensor:
    """(4,) float64 quaternion (w, x, y, z) of a turn about a world axis."""
    half = math.radians(degrees) / 2
    turn = torch.zeros(4, dtype=torch.float64)
    turn[0], turn[1 + axis] = math.cos(half), math.sin(half)
    return turn


def load_mask(path: Path, scene: GaussianScene) -> Tensor:
    """(N,) bool, which Gaussians of a scene a file names."""
    if path.suffix.lower() == ".npy":
        return _from_array(load_array(path), len(scene), str(path))
    if path.suffix.lower() == ".ply":
        return _at_positions(load_points(path).points, scene, path)
    do = "save a mask with numpy.save, or a part of the splat as PLY"
    raise InvalidValueError.of(str(path), "a file that ends in .npy or .ply", path.suffix or "no ending", do)


def mask_of(values: object, count: int) -> Tensor:
    """(N,) bool mask from one bool (or 0 and 1) a Gaussian, or from row numbers."""
    try:
        array = np.asarray(values)
    except ValueError:  # rows of different lengths
        array = np.empty((0, 0))
    return _from_array(array, count, "mask")


def save_mask(mask: Tensor, path: Path) -> None:
    """Save a (N,) bool mask as .npy; the file appears whole or not at all."""
    buffer = io.BytesIO()
    np.save(buffer, mask.detach().cpu().numpy().astype(bool))
    save_bytes(buffer.getvalue(), path)


def _from_array(values: NDArray[np.generic], count: int, what: str) -> Tensor:
    """A mask from bools, from zeros and ones, or from row numbers."""
    if values.ndim != 1 or values.dtype.kind not in "biu":
        got, do = f"{values.dtype} of shape {values.shape}", "pass a one-dimensional array"
        raise InvalidValueError.of(what, f"({count},) bools, or row numbers", got, do)
    binary = values.dtype.kind == "b" or (len(values) == count and bool(((values == 0) | (values == 1)).all()))
    if binary:
        if len(values) != count:
            raise InvalidValueError.of(what, f"{count} bools, one a Gaussian", len(values), "make it from this scene")
        return torch.from_numpy(values.astype(bool))
    rows = torch.from_numpy(values.astype(np.int64))
    if len(rows) and not bool(((rows >= 0) & (rows < count)).all()):
        got = f"{int(rows.min())} to {int(rows.max())}"
        raise InvalidValueError.of(what, f"row numbers in 0..{count - 1}", got, "make them from this scene")
    mask = torch.zeros(count, dtype=torch.bool)
    mask[rows] = True
    return mask


def _at_positions(points: Tensor, scene: GaussianScene, path: Path) -> Tensor:
    """Which Gaussians lie exactly at one of the points."""
    wanted, ours = (_keys(values) for values in (points, scene.means.detach().cpu()))
    strange = int((~np.isin(wanted, ours)).sum())
    if strange:
        got = f"{strange:,} of {len(wanted):,} that are not"
        do = "pass a part of this very splat, not one that was moved, resized or trained on"
        raise InvalidValueError.of(str(path), "positions that are those of Gaussians of the scene", got, do)
    return torch.from_numpy(np.isin(ours, wanted))


def _keys(points: Tensor) -> NDArray[np.void]:
    """Each (N, 3) position as one value that is equal where all three numbers are."""
    values = np.ascontiguousarray(points.numpy().astype(np.float32) + np.float32(0))  # of -0 and 0, 0
    keys: NDArray[np.void] = values.view(np.dtype((np.void, 12)))[:, 0]
    return keys


def load_array(path: Path) -> NDArray[np.generic]:
    """The array in a .npy file, never of objects; what its header says is held against the bytes that are there."""
    expected, do = "an array of NumPy (.npy)", "save it with numpy.save"
    try:
        with open_regular(str(path)) as file:
            head, size = io.BytesIO(os.pread(file.fileno(), _NPY_HEADER, 0)), os.fstat(file.fileno()).st_size
            version = npy.read_magic(head)
            if version not in _READERS:
                raise ValueError(f"version {version[0]}.{version[1]} of the format")
            shape, column_first, kind = _READERS[version](head)
            if kind.hasobject:
                raise ValueError("pickled objects, which may run code")
            needed = head.tell() + math.prod(shape) * kind.itemsize
            if needed != size or min(shape, default=0) < 0:
                raise ValueError(f"{size} bytes where the header asks for {needed}")
            data = memoryview(read_whole(file))[head.tell() :]
        return np.ndarray(shape, kind, data, order="F" if column_first else "C")
    except OSError as error:
        raise from_os_error(str(path), expected, error) from error
    except _BROKEN as error:
        got = " ".join(str(error).split())[:160] or type(error).__name__
        raise SplatFileError.of(str(path), expected, got, do) from error
