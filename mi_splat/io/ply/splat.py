"""Splats as 3D Gaussian Splatting writes them: PLY with log-scales, logit opacities and channel-major SH."""

from __future__ import annotations

import io
import os
import threading
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mi_splat.attributes import ATTRIBUTES, LARGEST
from mi_splat.errors import InvalidValueError
from mi_splat.io.atomic import atomic_write, write_all
from mi_splat.io.errors import SplatFileError
from mi_splat.io.loaded import SHOWN, Loaded
from mi_splat.io.ply.blocks import Rows, for_each_block
from mi_splat.io.ply.body import locate, read_rows
from mi_splat.io.ply.header import Element, Header
from mi_splat.io.ply.rows import REST_COUNTS, describe, file_names, file_record, needed_names, pack, unpack
from mi_splat.sh import coefficient_count

if TYPE_CHECKING:
    from mi_splat.scene import GaussianScene


def read_ply(file: io.FileIO, header: Header, path: str) -> Loaded:
    """Read a 3DGS splat: text and both byte orders, float and double, any order of properties, SH degree 0 to 3."""
    return _read(file, header, _vertices(header, path), path)


def write_ply(scene: GaussianScene, path: str | os.PathLike[str]) -> None:
    """Save a splat as 3DGS writes it: binary little-endian float32 PLY with zero normals and the scene's SH degree.

    The file appears whole or not at all. Means and SH of a float32 scene are kept bit for bit; saving what was loaded
    from a saved file writes the same bytes again.
    """
    import torch  # reading does without

    rest = 3 * (scene.sh.shape[1] - 1)
    properties = "\n".join(f"property float {name}" for name in file_names(rest))
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(scene)}\n{properties}\nend_header\n".encode()
    record, lock = file_record(rest), threading.Lock()
    tensors = [value.detach().to("cpu", torch.float32) for value in scene.tensors()]
    with atomic_write(path) as file:
        write_all(file, memoryview(head))

        def store(first: int, rows: Rows) -> None:
            last = first + len(rows)
            if not pack(scene.unchecked(*(value[first:last] for value in tensors)), rows):
                got = f"others between rows {first} and {last - 1}"
                expected = f"values that are finite in float32, up to {LARGEST:g}"
                raise InvalidValueError.of("scene", expected, got, "remove them")
            with lock:
                file.seek(len(head) + first * record.itemsize)
                write_all(file, rows.view(np.uint8).data)

        for_each_block(len(scene), record, store)


def _vertices(header: Header, path: str) -> Element:
    """The element with the Gaussians, after a check that it has the properties of one."""
    element = next((element for element in header.elements if element.name == "vertex"), None)
    if element is None:
        got = ", ".join(element.name for element in header.elements) or "none"
        raise SplatFileError.of(path, "an element named vertex", got, "pass a 3DGS splat")
    columns = {column.name: column for column in element.properties}
    rest = _rest_count(element)
    if rest not in REST_COUNTS:
        expected = "0, 9, 24 or 45 properties f_rest_* (SH degree 0 to 3)"
        raise SplatFileError.of(path, expected, rest, "export the splat again")
    missing = [name for name in needed_names(rest) if name not in columns]
    if missing:
        more = f" and {len(missing) - SHOWN} more" if len(missing) > SHOWN else ""
        got = f"no {', '.join(missing[:SHOWN])}{more}"
        do = "pass a splat: this may be a point cloud, or a mesh, of which mi-splat capture takes pictures"
        raise SplatFileError.of(path, "the properties of a 3DGS splat", got, do)
    for name in needed_names(rest):
        if columns[name].length_kind:
            raise SplatFileError.of(path, f"{name} as a single number", f"the list {name}", "export the splat again")
        if columns[name].kind[0] != "f":
            got = f"an integer ({columns[name].kind})"
            raise SplatFileError.of(path, f"{name} as float or double", got, "export the splat uncompressed")
    return element


def _rest_count(element: Element) -> int:
    """Number of SH properties after the first coefficients."""
    return sum(column.name.startswith("f_rest_") for column in element.properties)


def _read(file: io.FileIO, header: Header, element: Element, path: str) -> Loaded:
    """The scene with all rows, and which of them are not valid."""
    rest = _rest_count(element)
    locate(file, header, element.name, path)  # the sizes are right before memory is taken
    bands, count = coefficient_count(REST_COUNTS.index(rest)), element.count
    shapes = dict(zip(ATTRIBUTES, ((count, 3), (count, 3), (count, 4), (count,), (count, bands, 3)), strict=True))
    # NumPy asks for huge pages, torch does not: half of the time of a large load went into page faults.
    arrays = {name: np.empty(shape, np.float32) for name, shape in shapes.items()}
    wrong: dict[int, tuple[NDArray[np.int64], str]] = {}

    def take(first: int, rows: Rows) -> None:
        valid = unpack(rows, rest, [value[first : first + len(rows)] for value in arrays.values()])
        if not valid.all():
            bad = np.flatnonzero(~valid)
            wrong[first] = (first + bad, describe(rows[bad[0]], rest))

    read_rows(file, header, element, path, take)
    if not wrong:
        return Loaded(arrays, np.empty(0, np.int64), "")
    return Loaded(arrays, np.concatenate([wrong[first][0] for first in sorted(wrong)]), wrong[min(wrong)][1])
