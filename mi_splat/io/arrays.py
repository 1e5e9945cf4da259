"""Arrays in files of NumPy (.npy): what the header says is held against the bytes that are there."""

import io
import math
import os
import tokenize
from pathlib import Path

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from mi_splat.io.errors import SplatFileError, from_os_error
from mi_splat.io.loaded import open_regular, read_whole

_HEADER = 10_000
"""Bytes that a header may have; NumPy's own limit."""
_READERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
# What NumPy raises for headers that are broken in one way or another: it reads them as Python.
_BROKEN = (
    *(ValueError, EOFError, TypeError, SyntaxError, LookupError, AttributeError, ArithmeticError, RecursionError),
    *(MemoryError, tokenize.TokenError),
)


def load_array(path: Path) -> NDArray[np.generic]:
    """The array in a .npy file, of numbers or other plain values, never of objects."""
    expected, do = "an array of NumPy (.npy)", "save it with numpy.save"
    try:
        with open_regular(str(path)) as file:
            head, size = io.BytesIO(os.pread(file.fileno(), _HEADER, 0)), os.fstat(file.fileno()).st_size
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
