"""Splats in other axes than those of the 3DGS PLY (x right, y down, z forward), and
placed by transforms.

Between the axes of the formats lie signs of coordinates, which are changed without any
rounding.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mi_splat.errors import InvalidValueError
from mi_splat.io.errors import SplatFileError
from mi_splat.io.loaded import Arrays, Loaded, arrays_of
from mi_splat.maths.sh import band, degree_of

Signs = tuple[float, float, float]

X = (1.0, -1.0, -1.0)
Z = (-1.0, -1.0, 1.0)
"""Signs of the coordinates after half a turn about an axis."""

Y_UP = (0.0, -1.0, 0.0)
"""In the axes of the PLY, what is up in a format that defines y as up, after half a
turn about x or z.
"""
_PROBE = (0.36, 0.48, 0.8)


def flipped(arrays: Arrays, signs: Signs) -> Arrays:
    """The Gaussians with other signs of their coordinates; the same signs again give
    the same bits again.

    With D = diag(signs), a covariance R S^2 R^T becomes (D R D) S^2 (D R D)^T, whose
    quaternion is the old one with signs on its vector part. Every basis function of SH
    is even or odd in each coordinate, so that its coefficient keeps its size too.
    """
    turned = (_PROBE[0] * signs[0], _PROBE[1] * signs[1], _PROBE[2] * signs[2])
    parity = [
        round(after / before)
        for degree in range(degree_of(arrays["sh"].shape[1]) + 1)
        for before, after in zip(
            band(_PROBE, degree), band(turned, degree), strict=True
        )
    ]
    vector = np.prod(signs) * np.array(signs)
    return {
        **arrays,
        "means": arrays["means"] * np.array(signs, np.float32),
        "rotations": arrays["rotations"] * np.array([1, *vector], np.float32),
        "sh": arrays["sh"] * np.array(parity, np.float32)[:, None],
    }


def transformed(part: Loaded, matrix: NDArray[np.floating], path: str) -> Loaded:
    """A part after a transform that turns, moves and resizes it."""
    if np.array_equal(matrix, np.eye(4)):
        return part
    import torch

    from mi_splat.scene import Similarity

    if len(part.invalid):
        raise SplatFileError.of(
            path,
            "valid Gaussians where they are turned or moved",
            part.reason,
            "repair it",
        )
    try:
        scene = part.scene.transform(
            Similarity.from_matrix(torch.from_numpy(matrix), "transform")
        )
    except InvalidValueError as error:
        raise SplatFileError.of(
            path, "transforms that turn, move and resize", error, "export it again"
        ) from None
    return dataclasses.replace(part, arrays=arrays_of(scene))


def concatenated(parts: Sequence[Loaded]) -> Loaded:
    """All parts after each other; SH of lower degree are padded with zeros."""
    most = max(part.arrays["sh"].shape[1] for part in parts)
    starts = np.cumsum([0, *(len(part.arrays["means"]) for part in parts[:-1])])
    arrays: Arrays = {}
    for name in parts[0].arrays:
        columns = [part.arrays[name] for part in parts]
        if name == "sh":
            columns = [
                np.pad(sh, ((0, 0), (0, most - sh.shape[1]), (0, 0))) for sh in columns
            ]
        arrays[name] = np.concatenate(columns) if len(columns) > 1 else columns[0]
    invalid = np.concatenate(
        [part.invalid + start for part, start in zip(parts, starts, strict=True)]
    )
    return Loaded(
        arrays, invalid, next((part.reason for part in parts if part.reason), "")
    )
