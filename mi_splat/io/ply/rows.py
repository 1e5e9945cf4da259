"""Rows of a 3DGS PLY file to arrays, which needs no torch, and from tensors back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mi_splat.attributes import LARGEST
from mi_splat.io.loaded import unit
from mi_splat.io.ply.blocks import Rows

if TYPE_CHECKING:
    from mi_splat.scene import GaussianScene

COLUMNS = {
    "means": ("x", "y", "z"),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "rotations": ("rot_0", "rot_1", "rot_2", "rot_3"),
    "opacities": ("opacity",),
}
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_UNBOUNDED = (*COLUMNS["scales"], *COLUMNS["rotations"], *COLUMNS["opacities"])
REST_COUNTS = (0, 9, 24, 45)
"""Number of f_rest_* properties for SH degree 0 to 3: channel-major, all of red, then green, then blue."""


def rest_names(count: int) -> list[str]:
    """Names of the SH properties after the first coefficients."""
    return [f"f_rest_{i}" for i in range(count)]


def needed_names(rest: int) -> list[str]:
    """Names of all properties of a splat with `rest` properties f_rest_*."""
    return [*(name for names in COLUMNS.values() for name in names), *DC, *rest_names(rest)]


def file_names(rest: int) -> list[str]:
    """Names of all properties in the order in which the reference code writes them, with normals."""
    after = [name for attribute in ("opacities", "scales", "rotations") for name in COLUMNS[attribute]]
    return [*COLUMNS["means"], "nx", "ny", "nz", *DC, *rest_names(rest), *after]


def file_record(rest: int) -> np.dtype[np.void]:
    """One Gaussian as `pack` fills it: the properties `file_names`, grouped."""
    colours = [("dc", "<f4", (3,)), ("rest", "<f4", (3, rest // 3))]
    after = [("opacities", "<f4", ()), ("scales", "<f4", (3,)), ("rotations", "<f4", (4,))]
    return np.dtype([("means", "<f4", (3,)), ("normals", "<f4", (3,)), *colours, *after])


def pack(part: GaussianScene, rows: Rows) -> bool:
    """Fill rows of `file_record` with the Gaussians of `part`, which is float32 on the CPU."""
    from mi_splat.io.parameters import to_raw_parameters  # brings torch, which reading does without

    values = {name: value.numpy() for name, value in to_raw_parameters(part).items()}
    for name in COLUMNS:
        rows[name] = values[name]
    rows["dc"] = values["sh"][:, 0]
    for channel in range(3):  # a channel at a time is twice as fast as one transpose
        rows["rest"][:, channel] = values["sh"][:, 1:, channel]
    return bool((np.abs(rows.view("<f4")) <= LARGEST).all() and (part.scales <= LARGEST).all())


def unpack(rows: Rows, rest: int, part: Sequence[NDArray[np.float32]]) -> NDArray[np.bool_]:
    """Fill the five float32 arrays `part` from rows of a file, in any kinds and byte order."""
    table, numbers = _table(rows, rest)
    means, scales, rotations, opacities, colours = part
    values = {name: _columns(table, numbers, columns) for name, columns in COLUMNS.items()}
    logits = values["opacities"][:, 0]
    with np.errstate(all="ignore"):  # of a thread; what is not finite is judged below
        means[:] = values["means"]
        # As `mi_splat.io.parameters.activate`: in float64, rounded once to the file's kind.
        scales[:] = np.exp(values["scales"], dtype=np.float64).astype(values["scales"].dtype)
        rotations[:] = unit(values["rotations"])
        opacities[:] = (1 / (1 + np.exp(-logits.astype(np.float64)))).astype(logits.dtype)
        colours[:, 0] = _columns(table, numbers, DC)
        for channel in range(3 if rest else 0):
            names = rest_names(rest)[channel * rest // 3 : (channel + 1) * rest // 3]
            colours[:, 1:, channel] = _columns(table, numbers, names)
    return _valid(part, logits)


def _table(rows: Rows, rest: int) -> tuple[NDArray[np.floating], dict[str, int]]:
    """Rows as a (rows, columns) table in the machine's byte order, and the column of each property in it."""
    names = list(rows.dtype.names or ())
    kinds = {rows.dtype[name] for name in names}
    if len(kinds) == 1:
        kind = kinds.pop()
        table = rows.view(kind).reshape(len(rows), len(names))
        return table.astype(kind.newbyteorder("="), copy=False), {name: i for i, name in enumerate(names)}
    names = needed_names(rest)
    table = np.empty((len(rows), len(names)), np.result_type(*(rows.dtype[name] for name in names)))
    for column, name in enumerate(names):
        table[:, column] = rows[name]
    return table, {name: i for i, name in enumerate(names)}


def _columns(table: NDArray[np.floating], numbers: dict[str, int], names: Sequence[str]) -> NDArray[np.floating]:
    """(rows, names) values, without a copy if the columns are neighbours in this order."""
    wanted = [numbers[name] for name in names]
    first, last = wanted[0], wanted[0] + len(wanted)
    return table[:, first:last] if wanted == list(range(first, last)) else table[:, wanted]


def _valid(part: Sequence[NDArray[np.float32]], logits: NDArray[np.floating]) -> NDArray[np.bool_]:
    """(rows,) which Gaussians have values in range, finite in the file too (an infinite logit has a sigmoid)."""
    means, scales, rotations, opacities, sh = part
    good = np.ones(len(means), np.bool_)
    bounded = (np.abs(value) <= LARGEST for value in (means, scales, sh))
    for check in (scales > 0, *bounded, *(np.isfinite(value) for value in (logits, rotations, opacities))):
        if not check.all():
            good &= check.reshape(len(check), -1).all(1)
    return good


def describe(row: np.void, rest: int) -> str:
    """What is wrong with one Gaussian that is not valid."""
    for name in needed_names(rest):
        if not (abs(row[name]) <= LARGEST or (np.isfinite(row[name]) and name in _UNBOUNDED)):
            return f"{name} is {row[name]:g}"
    if all(row[name] == 0 for name in COLUMNS["rotations"]):
        return "the quaternion is zero"
    scales = [round(float(row[name]), 3) for name in COLUMNS["scales"]]
    return f"log-scales {scales} are scales outside of float32's range or above {LARGEST:g}"
