"""Coloured points, and the PLY file in which 3DGS trainers look for them."""

import os
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.attributes import LARGEST
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import save_bytes
from mi_splat.io.errors import SplatFileError, from_os_error
from mi_splat.io.loaded import open_regular
from mi_splat.io.ply import Element, header_bytes, read_header, read_rows

_AXES = ("x", "y", "z")
_CHANNELS = ("red", "green", "blue")
_KINDS = {
    **dict.fromkeys((*_AXES, "nx", "ny", "nz"), "f4"),
    **dict.fromkeys(_CHANNELS, "u1"),
}
"""Of the columns that are written; readers of other trainers ask for normals as
well.
"""
_GREY = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Coloured points on surfaces, from which a training may start."""

    points: Tensor  # (P, 3) float32, world units
    colours: Tensor  # (P, 3) float32, sRGB in [0, 1]

    def __post_init__(self) -> None:
        for name in ("points", "colours"):
            object.__setattr__(
                self, name, getattr(self, name).detach().to("cpu", torch.float32)
            )
        shapes = (tuple(self.points.shape), tuple(self.colours.shape))
        if shapes[0] != shapes[1] or self.points.ndim != 2 or shapes[0][1] != 3:
            raise InvalidValueError.of(
                "point cloud", "(P, 3) points and colours", shapes, "check the arrays"
            )
        wrong = (~(self.points.abs() <= LARGEST)).any(1).nonzero()[:, 0]
        if len(wrong):
            got = (
                f"{self.points[wrong[0]].tolist()} in row {int(wrong[0])} ({len(wrong)}"
                f" of {len(self.points)} rows)"
            )
            raise InvalidValueError.of(
                "points",
                f"finite coordinates up to {LARGEST:g}",
                got,
                "remove those points",
            )
        if not bool(((self.colours >= 0) & (self.colours <= 1)).all()):
            raise InvalidValueError.of(
                "colours", "values in [0, 1]", "others", "divide bytes by 255"
            )

    def __len__(self) -> int:
        """Number of points."""
        return len(self.points)


def to_bytes(colours: Tensor) -> NDArray[np.uint8]:
    """8-bit values of numbers in [0, 1], rounded to the nearest; others are clipped."""
    values: NDArray[np.uint8] = (
        (colours.detach().cpu().double().clamp(0, 1) * 255 + 0.5)
        .to(torch.uint8)
        .numpy()
    )
    return values


def save_points(cloud: PointCloud, path: str | os.PathLike[str]) -> None:
    """Save points as binary PLY with zero normals and 8-bit colours; the file appears
    whole or not at all.
    """
    rows = np.zeros(len(cloud), [(name, f"<{kind}") for name, kind in _KINDS.items()])
    for i, name in enumerate(_AXES):
        rows[name] = cloud.points[:, i].numpy()
    for i, name in enumerate(_CHANNELS):
        rows[name] = to_bytes(cloud.colours[:, i])
    head = header_bytes(
        {"vertex": Element(len(rows), {name: (kind,) for name, kind in _KINDS.items()})}
    )
    save_bytes(rows.view(np.uint8).data, path, head=head)


def load_points(path: str | os.PathLike[str]) -> PointCloud:
    """Load the vertices of a PLY file in any encoding; they are grey if the file has no
    colours.

    Text, and vertices that carry lists, need the package plyfile.
    """
    name = os.fspath(path)
    try:
        with open_regular(name) as file:
            header = read_header(file, name)
            element = header.elements.get("vertex")
            kinds = {} if element is None else element.kinds
            if not set(_AXES) <= kinds.keys():
                got = ", ".join(kinds) or "no element named vertex"
                raise SplatFileError.of(
                    name, "vertices with x, y and z", got, "export the points again"
                )
            rows = read_rows(file, header, "vertex", name)
    except OSError as error:
        raise from_os_error(name, "a PLY file that can be read", error) from error
    coordinates = np.stack([rows[axis] for axis in _AXES], axis=1).astype(np.float32)
    colours = np.full(coordinates.shape, _GREY, np.float32)
    if set(_CHANNELS) <= kinds.keys():
        scales = {
            key: 1.0 if kinds[key][0] == "f" else 1 / (256 ** int(kinds[key][1:]) - 1)
            for key in _CHANNELS
        }
        colours[:] = np.stack(
            [rows[key] * scale for key, scale in scales.items()], axis=1
        )
    try:
        return PointCloud(torch.from_numpy(coordinates), torch.from_numpy(colours))
    except InvalidValueError as error:
        raise SplatFileError.of(
            name, "points that are valid", str(error), "export the points again"
        ) from error
