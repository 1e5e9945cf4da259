"""Gradients that a renderer of others has written, as `mi-splat conform --gradients`
reads them.
"""

from __future__ import annotations

import lzma
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from mi_splat.errors import InvalidValueError, MiSplatError, one_line
from mi_splat.io.errors import SplatFileError
from mi_splat.selection.select import load_array

if TYPE_CHECKING:
    from mi_splat.oracle import Array

_DAMAGED = (
    *(
        MiSplatError,
        OSError,
        EOFError,
        ValueError,
        TypeError,
        OverflowError,
        MemoryError,
    ),
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error),
    # an encrypted member, or a method of compression that Python does not know
    RuntimeError,
)
"""What reading a damaged ZIP of arrays raises."""


def read_gradients(path: Path, exact: Mapping[str, Array]) -> dict[str, Array]:
    """The arrays of a file that are called as exact ones; none may be larger in the
    file than twice those.
    """
    found = dict[str, Any]()
    most = 1024 + 16 * max(values.size for values in exact.values())
    try:
        with zipfile.ZipFile(path) as archive, TemporaryDirectory() as folder:
            for name in (
                f"{key}.npy" for key in exact if f"{key}.npy" in archive.namelist()
            ):
                if archive.getinfo(name).file_size > most:
                    raise SplatFileError.of(
                        name,
                        "a gradient",
                        f"more than {most:,} bytes",
                        "shape it as exported",
                    )
                found[name[:-4]] = load_array(
                    Path(archive.extract(name, folder))
                ).astype(float)
    except _DAMAGED as error:
        got = one_line(str(error), 200) or type(error).__name__
        do = "save them with numpy.savez"
        raise InvalidValueError.of(
            str(path), "arrays shaped as those exported", got, do
        ) from error
    return found
