"""Splats as 3D Gaussian Splatting writes them: PLY with log-scales, logit opacities and channel-major SH."""

from __future__ import annotations

import io
import os
import stat
import warnings
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.errors import InvalidValueError, message
from mi_splat.io._ply_body import CHUNK_BYTES, Rows, chunks
from mi_splat.io._ply_header import Element, Header, read_header
from mi_splat.io.atomic import atomic_write, write_all
from mi_splat.io.errors import SplatFileError, SplatFileWarning, from_os_error
from mi_splat.io.file_space import activate, to_file_space
from mi_splat.scene import ATTRIBUTES, GaussianScene
from mi_splat.sh import coefficient_count

_COLUMNS = {
    "means": ("x", "y", "z"),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "rotations": ("rot_0", "rot_1", "rot_2", "rot_3"),
    "opacities": ("opacity",),
}
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_REST_COUNTS = (0, 9, 24, 45)
_SHOWN = 5


def load_splat(path: str | os.PathLike[str], *, on_invalid: Literal["raise", "drop"] = "raise") -> GaussianScene:
    """Load a 3DGS splat.

    Reads text and both byte orders, float and double, any order of properties, SH degree 0 to 3. Normals, further
    properties and further elements are passed over. Quaternions are normalised. The tensors are float32 on the CPU.

    Args:
        path: A PLY file.
        on_invalid: What to do with Gaussians that are not valid (a value is not finite, the scale's exponential
            overflows or vanishes, the quaternion is zero): raise, or drop them with a `SplatFileWarning` that says how
            many and which.

    Raises:
        SplatFileError: The file cannot be read, is no 3DGS splat, does not have the size that its header says, or holds
            Gaussians that are not valid and `on_invalid` is "raise".
        InvalidValueError: on_invalid is something else.
    """
    if on_invalid not in ("raise", "drop"):
        raise InvalidValueError(message("on_invalid", "'raise' or 'drop'", repr(on_invalid), "pass one of the two"))
    name = os.fspath(path)
    try:
        with _open(name) as file:
            header = read_header(file, name)
            element = _vertices(header, name)
            scene, bad, example = _read(file, header, element, name)
    except OSError as error:
        raise from_os_error(name, "a PLY file that can be read", error) from error
    if not len(bad):
        return scene
    which = ", ".join(str(row) for row in bad[:_SHOWN].tolist()) + (", ..." if len(bad) > _SHOWN else "")
    found = f"{len(bad)} of {element.count} that are not (rows {which}; {example})"
    if on_invalid == "raise":
        raise SplatFileError(
            message(name, "valid Gaussians", found, "repair the file or load it with on_invalid='drop'")
        )
    warnings.warn(message(name, "valid Gaussians", found, "they were left out"), SplatFileWarning, stacklevel=2)
    keep = torch.ones(element.count, dtype=torch.bool)
    keep[torch.from_numpy(bad)] = False
    return scene.select(keep)


def save_splat(scene: GaussianScene, path: str | os.PathLike[str]) -> None:
    """Save a splat as 3DGS writes it: binary little-endian float32 PLY with zero normals and the scene's SH degree.

    The file appears whole or not at all. Means and SH of a float32 scene are kept bit for bit; saving what was loaded
    from a saved file writes the same bytes again.

    Args:
        scene: The scene, on any device.
        path: The file to write; a file that is there is replaced.

    Raises:
        SplatFileError: The file cannot be written; what was there before is unchanged.
        InvalidValueError: A value is not finite in float32.
    """
    rest = scene.sh.shape[1] - 1
    rows_at_once = max(1, CHUNK_BYTES // _record(rest).itemsize)
    buffer = np.zeros(min(rows_at_once, len(scene)), _record(rest))
    values = {name: value.detach().cpu() for name, value in zip(ATTRIBUTES, scene.tensors(), strict=True)}
    with atomic_write(path) as file:
        write_all(file, memoryview(_header(len(scene), rest)))
        for first in range(0, len(scene), rows_at_once):
            part = GaussianScene._trusted(
                **{name: value[first : first + rows_at_once] for name, value in values.items()}
            )
            rows = buffer[: len(part)]
            _pack(part, rows)
            if not np.isfinite(rows.view("<f4")).all():
                found = f"others between rows {first} and {first + len(part) - 1}"
                raise InvalidValueError(
                    message("scene", "values that are finite in float32", found, "remove those rows")
                )
            write_all(file, memoryview(rows.view(np.uint8)))


def _record(rest: int) -> np.dtype[np.void]:
    """One Gaussian with `rest` coefficients a channel after the first, in the order of the reference code."""
    fields = [
        ("means", 3),
        ("normals", 3),
        ("dc", 3),
        ("rest", (3, rest)),
        ("opacities", 1),
        ("scales", 3),
        ("rotations", 4),
    ]
    return np.dtype([(name, "<f4", shape) if shape != 1 else (name, "<f4") for name, shape in fields])


def _header(count: int, rest: int) -> bytes:
    names = ["x", "y", "z", "nx", "ny", "nz", *_DC, *(f"f_rest_{i}" for i in range(3 * rest))]
    names += [name for attribute in ("opacities", "scales", "rotations") for name in _COLUMNS[attribute]]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property float {name}" for name in names] + ["end_header", ""]
    return "\n".join(lines).encode("ascii")


def _pack(part: GaussianScene, rows: Rows) -> None:
    """Fill file rows with a few Gaussians."""
    values = {name: value.numpy() for name, value in to_file_space(part).items()}
    with np.errstate(over="ignore"):
        for name in ("means", "opacities", "scales", "rotations"):
            rows[name] = values[name]
        rows["dc"] = values["sh"][:, 0]
        rows["rest"] = values["sh"][:, 1:].transpose(0, 2, 1)


def _open(path: str) -> io.FileIO:
    """The file, if it is a regular one: opening a pipe would wait for its writer."""
    mode = os.stat(path).st_mode
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "a special file (pipe, socket or device)"
        raise SplatFileError(message(path, "a PLY file", kind, "pass the path of a file"))
    return io.FileIO(path, "rb")


def _vertices(header: Header, path: str) -> Element:
    """The element with the Gaussians, after a check that it has the properties of one."""
    element = next((element for element in header.elements if element.name == "vertex"), None)
    if element is None:
        found = ", ".join(element.name for element in header.elements)
        raise SplatFileError(message(path, "an element named vertex", found, "pass a 3DGS splat"))
    kinds = {column.name: column for column in element.properties}
    rest = sum(name.startswith("f_rest_") for name in kinds)
    if rest not in _REST_COUNTS:
        expected = "0, 9, 24 or 45 properties f_rest_* (SH degree 0 to 3)"
        raise SplatFileError(message(path, expected, rest, "export the splat again"))
    needed = [name for names in _COLUMNS.values() for name in names] + [*_DC, *_rest(rest)]
    missing = [name for name in needed if name not in kinds]
    if missing:
        found = f"no {', '.join(missing[:_SHOWN])}" + (f" and {len(missing) - _SHOWN} more" if missing[_SHOWN:] else "")
        raise SplatFileError(
            message(path, "the properties of a 3DGS splat", found, "pass a splat, not a point cloud or mesh")
        )
    for name in needed:
        if kinds[name].length_kind or kinds[name].kind[0] != "f":
            found = "a list" if kinds[name].length_kind else f"an integer ({kinds[name].kind})"
            raise SplatFileError(message(path, f"{name} as float or double", found, "export the splat uncompressed"))
    if element.has_lists:
        listed = next(column.name for column in element.properties if column.length_kind)
        raise SplatFileError(
            message(path, "vertex properties that are single numbers", f"the list {listed}", "remove it")
        )
    return element


def _rest(count: int) -> list[str]:
    return [f"f_rest_{i}" for i in range(count)]


def _read(file: io.FileIO, header: Header, element: Element, path: str) -> tuple[GaussianScene, NDArray[np.int64], str]:
    """The scene with all rows, the rows that are not valid, and what is wrong with the first of these."""
    rest = sum(column.name.startswith("f_rest_") for column in element.properties)
    blocks = chunks(file, header, element.name, path)
    first, bad, example = 0, [np.empty(0, np.int64)], ""
    scene: GaussianScene | None = None
    for rows in blocks:
        if scene is None:  # the sizes have been checked by now
            scene = _blank(element.count, coefficient_count((0, 9, 24, 45).index(rest)))
        part = [value[first : first + len(rows)] for value in scene.tensors()]
        _unpack(rows, rest, part)
        valid = _valid(part)
        if not valid.all():
            wrong = np.flatnonzero(~valid)
            example = example or _describe(rows[wrong[0]], int(first + wrong[0]))
            bad.append(first + wrong)
        first += len(rows)
    if scene is None:
        scene = _blank(0, coefficient_count((0, 9, 24, 45).index(rest)))
    return scene, np.concatenate(bad), example


def _blank(count: int, bands: int) -> GaussianScene:
    shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, bands, 3))
    return GaussianScene._trusted(*(torch.empty(shape) for shape in shapes))


def _unpack(rows: Rows, rest: int, part: list[Tensor]) -> None:
    """Fill a few Gaussians from file rows."""
    values = {name: torch.from_numpy(_gather(rows, columns)) for name, columns in _COLUMNS.items()}
    values["opacities"] = values["opacities"][:, 0]
    values["sh"] = values["means"][:, None]
    for target, value in zip(part[:4], activate(values)[:4], strict=True):
        target.copy_(value)
    colours = part[4].numpy()
    with np.errstate(over="ignore"):
        colours[:, 0] = _gather(rows, _DC)
        if rest:
            colours[:, 1:] = _gather(rows, _rest(rest)).reshape(len(rows), 3, rest // 3).transpose(0, 2, 1)


def _gather(rows: Rows, names: tuple[str, ...] | list[str]) -> NDArray[np.floating]:
    """(rows, names) values in the machine's byte order, float64 if one of them is."""
    kind = np.result_type(*(rows.dtype[name] for name in names))
    table = np.empty((len(rows), len(names)), kind)
    for column, name in enumerate(names):
        table[:, column] = rows[name]
    return table


def _valid(part: list[Tensor]) -> NDArray[np.bool_]:
    """(rows,) which Gaussians are valid."""
    means, scales, rotations, opacities, sh = (value.numpy() for value in part)
    good = (scales > 0).all(1)
    for value in (means, scales, rotations, opacities, sh):
        finite = np.isfinite(value)
        if not finite.all():
            good &= finite.reshape(len(value), -1).all(1)
    return good


def _describe(row: np.void, index: int) -> str:
    """What is wrong with one Gaussian."""
    for name in row.dtype.names or ():
        if not np.isfinite(row[name]) and not name.startswith("n"):
            return f"{name} is {row[name]} in row {index}"
    if all(row[name] == 0 for name in _COLUMNS["rotations"]):
        return f"the quaternion is zero in row {index}"
    scales = [float(row[name]) for name in _COLUMNS["scales"]]
    return f"the values or log-scales {scales} in row {index} leave float32's range"
