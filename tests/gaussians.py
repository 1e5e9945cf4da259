"""Random scenes and hand-made PLY files for the tests of scenes and files."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.conformance import random_splat
from mi_splat.maths.rotation import normalise
from mi_splat.scene import GaussianScene

REST = {0: 0, 1: 9, 2: 24, 3: 45}


def random_scene(
    count: int, degree: int = 3, *, seed: int = 0, dtype: torch.dtype = torch.float32
) -> GaussianScene:
    """A scene of ordinary values."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return GaussianScene(
        means=normal(count, 3).to(dtype),
        scales=(normal(count, 3) - 3).exp().to(dtype),
        rotations=normalise(normal(count, 4)).to(dtype),
        opacities=normal(count).sigmoid().to(dtype),
        sh=normal(count, (degree + 1) ** 2, 3).to(dtype),
    )


def varied_scene(
    count: int, *, degree: int, seed: int, dtype: torch.dtype = torch.float32
) -> GaussianScene:
    """Needles, discs, huge and tiny Gaussians on a sphere."""
    splat = random_splat(count, degree=degree, seed=seed)
    return GaussianScene(*(torch.from_numpy(values).to(dtype) for values in splat))


def splat_names(degree: int, *, normals: bool = True) -> list[str]:
    """The properties of a 3DGS file, written out apart from the code under test."""
    names = [
        "x",
        "y",
        "z",
        *(["nx", "ny", "nz"] if normals else []),
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
    ]
    names += [f"f_rest_{i}" for i in range(REST[degree])]
    return [
        *names,
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
    ]


def splat_rows(
    count: int, degree: int = 0, *, seed: int = 0, names: Sequence[str] | None = None
) -> NDArray[np.void]:
    """Structured float32 rows as a file holds them, with random values."""
    names = splat_names(degree) if names is None else names
    values = np.random.default_rng(seed).normal(size=(count, len(names))).astype("<f4")
    return values.view([(name, "<f4") for name in names]).reshape(-1)


PLY_KINDS = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int", "i2": "short"}


def ply_header(
    rows: NDArray[np.void],
    encoding: str = "binary_little_endian",
    *,
    count: int | None = None,
) -> bytes:
    """The header for structured rows, with any count."""
    lines = [
        "ply",
        f"format {encoding} 1.0",
        f"element vertex {len(rows) if count is None else count}",
    ]
    lines += [
        f"property {PLY_KINDS[rows.dtype[name].str[1:]]} {name}"
        for name in rows.dtype.names or ()
    ]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


def ply_bytes(rows: NDArray[np.void]) -> bytes:
    """A binary little-endian PLY file of structured rows."""
    return ply_header(rows) + rows.tobytes()


def columns(rows: NDArray[Any], *names: str) -> NDArray[np.float64]:
    """(rows, names) values of structured rows in float64."""
    return np.stack([rows[name].astype(np.float64) for name in names], axis=1)
