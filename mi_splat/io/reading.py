"""Reading a splat file of any format as arrays; torch comes with the formats that need it, which the PLY is not."""

import importlib
import io
import os
from collections.abc import Callable
from typing import Literal

import numpy as np

from mi_splat.errors import InvalidValueError
from mi_splat.io.errors import from_os_error, path_name
from mi_splat.io.folders import splat_in
from mi_splat.io.formats.detection import HEAD, META, USD, format_to_read
from mi_splat.io.loaded import Arrays, Loaded, open_regular
from mi_splat.io.ply.header import read_header
from mi_splat.io.ply.splat import read_ply

_READERS = {
    ".glb": ("mi_splat.io.formats.gltf", "read_glb"),
    ".spz": ("mi_splat.io.formats.spz", "read_spz"),
    ".sog": ("mi_splat.io.formats.sog", "read_sog"),
    META: ("mi_splat.io.formats.sog", "read_sog_folder"),
    ".splat": ("mi_splat.io.formats.splat32", "read_splat"),
    ".ksplat": ("mi_splat.io.formats.ksplat", "read_ksplat"),
    **dict.fromkeys(USD, ("mi_splat.io.formats.usd", "read_usd")),
}
"""Module and its function for each format but the PLY."""


def load_arrays(
    path: str | os.PathLike[str], *, on_invalid: Literal["raise", "drop"] = "raise", stacklevel: int = 1
) -> Arrays:
    """As `load_splat`, without making a scene of the arrays."""
    if on_invalid not in ("raise", "drop"):
        raise InvalidValueError.of("on_invalid", "'raise' or 'drop'", repr(on_invalid), "pass one of the two")
    return load_stored(path).settle(path_name(path), on_invalid, stacklevel=stacklevel + 1)


def load_stored(path: str | os.PathLike[str]) -> Loaded:
    """All Gaussians of a file, valid or not, in its order, and which are not."""
    name = splat_in(path_name(path)) or path_name(path)
    try:
        # Values that are not finite make NumPy warn where they are cast; each reader judges them at its end.
        with open_regular(name) as file, np.errstate(all="ignore"):
            return _reader(format_to_read(name, os.pread(file.fileno(), HEAD, 0)))(file, name)
    except OSError as error:
        raise from_os_error(name, "a splat file that can be read", error) from error


def _reader(kind: str) -> Callable[[io.FileIO, str], Loaded]:
    """What reads a format."""
    if kind == ".ply":
        return _read_any_ply
    module, function = _READERS[kind]
    reader: Callable[[io.FileIO, str], Loaded] = getattr(importlib.import_module(module), function)
    return reader


def _read_any_ply(file: io.FileIO, path: str) -> Loaded:
    """Read a PLY, compressed or not: its header says which."""
    file.seek(0)
    header = read_header(file, path)
    names = [column.name for element in header.elements if element.name == "vertex" for column in element.properties]
    if "packed_position" not in names:
        return read_ply(file, header, path)
    from mi_splat.io.formats.compressed_ply import read_compressed_ply

    return read_compressed_ply(file, header, path)
