"""Loading and saving a splat in any of the formats; torch comes with scenes, and not
with arrays.
"""

from __future__ import annotations

import importlib.util
import io
import os
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import numpy as np

from mi_splat.attributes import LARGEST
from mi_splat.errors import InvalidValueError, install, message
from mi_splat.io import archives
from mi_splat.io.documents import save_bytes
from mi_splat.io.errors import (
    SplatFileError,
    SplatFileWarning,
    SplatLossWarning,
    from_os_error,
    path_name,
)
from mi_splat.io.folders import splat_in
from mi_splat.io.loaded import Encoded, Loaded, arrays_of, open_regular
from mi_splat.io.ply import read_header, write_ply

if TYPE_CHECKING:
    from mi_splat.scene import GaussianScene

HEAD = 32
"""First bytes of a file by which its format is known."""

USD = (".usdc", ".usda", ".usdz")
"""OpenUSD in binary, as text and as a package; what is called `.usd` is read by its
mark.
"""

SUFFIXES = (".ply", ".glb", *USD, ".compressed.ply", ".sog", ".spz", ".splat")

_ZIP = ".zip"
IN_ARCHIVES = (".ply", ".spz", ".sog", ".glb", ".splat")
"""Endings of splats that are read out of a ZIP archive; OpenUSD wants a file of its
own.
"""
_MAGIC = {
    b"ply": ".ply",
    b"NGSP": ".spz",
    b"\x1f\x8b": ".spz",
    b"PK\x03\x04": ".sog",
    b"glTF": ".glb",
}
_MAGIC |= {b"PXR-USDC": ".usdc", b"#usda": ".usda"}
_OTHERS = {
    ".gltf": "pack it into one .glb, for instance with gltf-transform",
    ".obj": (
        "this is a mesh: save it as .glb, then `mi-splat capture MESH.glb` renders"
        " images to train a splat on"
    ),
    ".npz": (
        "these are arrays of NumPy, whose meaning no name tells: save a .ply of them"
        " with mi_splat.save_splat"
    ),
    ".json": "bundle an unbundled SOG as .sog with splat-transform",
    ".lcc": "convert it to .ply with splat-transform",
    ".lcc2": "convert it to .ply with splat-transform",
    ".csv": "save it as .ply; splat-transform writes .csv from that",
    ".html": "save it as .ply; splat-transform makes a page from that",
    ".usd": "call it .usdc or .usda, as what it begins with says",
}
_PROGRAMS = (".pt", ".pth", ".ckpt", ".pkl", ".pickle")
"""Checkpoints of PyTorch: to unpickle one runs what is in it, so none is opened,
whatever it begins with.
"""


def suffix_of(path: str) -> str | None:
    """The suffix of the format that a name promises; None if it ends otherwise."""
    name = os.path.basename(path).lower()
    return max(
        (suffix for suffix in SUFFIXES if name.endswith(suffix)), key=len, default=None
    )


def format_to_read(path: str, head: bytes) -> str:
    """The suffix of the format of a file, ".ply" also for compressed ones, ".zip" for
    what a download is packed in.

    A name that promises nothing is overruled by the file's mark; one that promises
    something else is an error.
    """
    if os.path.basename(path).lower().endswith(_PROGRAMS):
        raise _unknown(path)
    if path.lower().endswith(_ZIP) and head.startswith(b"PK"):
        return _ZIP
    if path.lower().endswith(".npz"):
        raise _unknown(path)
    named = suffix_of(path)
    named = ".ply" if named == ".compressed.ply" else named
    marked = next(
        (suffix for mark, suffix in _MAGIC.items() if head.startswith(mark)), None
    )
    if named is None and marked is None:
        raise _unknown(path)
    if named in (None, marked) and marked is not None:
        return marked
    if marked is not None and named in (".splat", *_MAGIC.values()):
        raise SplatFileError.of(
            path,
            f"a {named} file",
            f"the mark of a {marked} file",
            f"rename it to {marked}",
        )
    return str(named)


def format_to_write(path: str) -> str:
    """The suffix of the format in which a file is to be written."""
    named = suffix_of(path)
    if named is None:
        raise _unknown(path)
    if named in USD:
        require_usd(path)
    return named


def require_usd(path: str) -> None:
    """Raise unless the package that reads and writes OpenUSD is installed."""
    if importlib.util.find_spec("pxr") is None:
        expected = "the package usd-core, for files of OpenUSD"
        raise SplatFileError.of(
            path, expected, "none", f"{install('usd')}, or use .glb"
        )


def _unknown(path: str) -> SplatFileError:
    ending = os.path.splitext(path)[1].lower()
    do = _OTHERS.get(ending, "convert it to .ply, for instance with splat-transform")
    if ending in _PROGRAMS:
        do = (
            "a checkpoint can be a program, and is not opened: export a .ply where you"
            " trust it, with ns-export gaussian-splat of nerfstudio,"
            " gsplat.export_splats, or save_ply of 3DGS"
        )
    return SplatFileError.of(
        path, f"a name that ends in {', '.join(SUFFIXES)}", ending or "no ending", do
    )


_FORMATS = {
    ".ply": ("mi_splat.io.ply", "read_ply", ""),
    ".compressed.ply": (
        "mi_splat.io.formats.compressed_ply",
        "read_compressed_ply",
        "write_compressed_ply",
    ),
    ".glb": ("mi_splat.io.formats.gltf", "read_glb", "write_glb"),
    ".spz": ("mi_splat.io.formats.spz", "read_spz", "write_spz"),
    ".sog": ("mi_splat.io.formats.sog", "read_sog", "write_sog"),
    ".splat": ("mi_splat.io.formats.splat32", "read_splat", "write_splat"),
    **dict.fromkeys(USD, ("mi_splat.io.formats.usd", "read_usd", "write_usd")),
}
"""Module, reader and writer of each format; the PLY is written a part at a time."""
TAGGED = (".ply", ".compressed.ply", ".sog", ".spz")
"""Formats that can say that a splat was trained with antialiasing."""
_NEVER_EMPTY = (".glb", ".sog", ".splat")


def load_splat(
    path: str | os.PathLike[str], *, on_invalid: Literal["raise", "drop"] = "raise"
) -> GaussianScene:
    """Load a splat: 3DGS PLY, compressed PLY, SPZ, SOG, glTF, OpenUSD or .splat.

    The name and the first bytes of the file say which. Quaternions are normalised. The
    tensors are float32 on the CPU. Every size that the file claims is held against the
    bytes that are there before memory is taken for it. Where axes differ from those of
    the PLY (SPZ, glTF, OpenUSD), the scene is turned; docs/formats.md says how.

    Of a PLY, text and both byte orders, float and double and any order of properties
    are read; normals, further properties and further elements are passed over. Text,
    and vertices that carry lists, need the package plyfile. A warning says what else
    there is to know: bands above degree 3 are left out, flat Gaussians of 2DGS become
    thin ellipsoids, the splat was trained with antialiasing and is to be drawn with it.

    Args:
        path: A splat file; a .zip with one; or a folder with one: of `mi-splat train`
            or `dagger`, or of 3DGS, whose newest iteration is taken.
        on_invalid: What to do with Gaussians that are not valid (a value is not finite
            in float32 or above 1e9, the scale vanishes, the quaternion is zero): raise,
            or drop them with a `SplatFileWarning` that says how many and which.

    Returns:
        The scene, on the CPU.

    Raises:
        SplatFileError: The file cannot be read, is no splat, is damaged, or holds
            Gaussians that are not valid and `on_invalid` is "raise".
        InvalidValueError: on_invalid is something else, or path is no path.
    """
    if on_invalid not in ("raise", "drop"):
        raise InvalidValueError.of(
            "on_invalid", "'raise' or 'drop'", repr(on_invalid), "pass one of the two"
        )
    name = path_name(path)
    loaded = load_stored(name).settle(name, on_invalid, stacklevel=2)
    if loaded.is_antialiased:
        do = "draw it with antialiased=True, of RenderSettings or splat_tile"
        text = message(
            name,
            "a splat for plain 3DGS rendering",
            "one that was trained with antialiasing",
            do,
        )
        warnings.warn(text, SplatFileWarning, stacklevel=2)
    return loaded.scene


def save_splat(
    scene: GaussianScene, path: str | os.PathLike[str], *, antialiased: bool = False
) -> None:
    """Save a splat in the format that the ending of `path` names.

    `.ply` (as 3DGS writes it), `.glb` and OpenUSD hold all of a scene: means and SH of
    a float32 scene are kept bit for bit. The other formats round; docs/formats.md says
    how much. The file appears whole or not at all. Saving what was loaded from a saved
    PLY writes the same bytes again.

    Args:
        scene: The scene, on any device.
        path: The file to write: .ply, .compressed.ply, .spz, .sog, .glb, .usdc, .usda,
            .usdz or .splat; a file that is there is replaced.
        antialiased: Note in the file, where its format can (PLY, SOG, SPZ), that it is
            to be drawn with antialiasing.

    Raises:
        SplatFileError: The file cannot be written, or the name fits no format; what was
            there before is unchanged.
        InvalidValueError: A value is not finite in float32 or too large (`LARGEST`), or
            the arguments are no scene and no path.

    Warns:
        SplatLossWarning: Something is lost beyond that rounding: SH bands are dropped,
        values are clamped.
    """
    losses = write_splat_file(scene, path, antialiased=antialiased).losses
    if losses:
        got = "; ".join(str(loss) for loss in losses)
        text = message(
            os.fspath(path),
            "a scene that fits the format",
            got,
            "save it as .ply or .glb to keep all",
        )
        warnings.warn(text, SplatLossWarning, stacklevel=2)


def load_stored(path: str | os.PathLike[str]) -> Loaded:
    """All Gaussians of a file, valid or not, in its order, and which are not; of a .zip
    those of the splat in it.
    """
    name = splat_in(path_name(path)) or path_name(path)
    try:
        # Values that are not finite make NumPy warn where they are cast; each reader
        # judges them at its end.
        with open_regular(name) as file, np.errstate(all="ignore"):
            suffix = format_to_read(name, os.pread(file.fileno(), HEAD, 0))
            if suffix != _ZIP:
                return _read(file, name, suffix)
            with archives.splat_of(file, name, IN_ARCHIVES) as (member, inner):
                return _read(
                    member,
                    inner,
                    format_to_read(inner, os.pread(member.fileno(), HEAD, 0)),
                )
    except OSError as error:
        raise from_os_error(name, "a splat file that can be read", error) from error


def _read(file: io.FileIO, name: str, suffix: str) -> Loaded:
    """The content of a file whose format has that suffix."""
    if suffix == ".ply" and read_header(file, name).is_compressed:
        suffix = ".compressed.ply"
    if suffix in USD:
        require_usd(name)
    module, function, _ = _FORMATS[suffix]
    read: Callable[[io.FileIO, str], Loaded] = getattr(
        importlib.import_module(module), function
    )
    return read(file, name)


def write_splat_file(
    scene: GaussianScene,
    path: str | os.PathLike[str],
    *,
    spz_version: Literal[2, 3, 4] = 3,
    antialiased: bool = False,
) -> Encoded:
    """Like `save_splat`, but what is lost is returned and not warned of; formats of
    `TAGGED` keep `antialiased`.
    """
    from mi_splat.scene import check_scene

    check_scene("scene", scene)
    suffix = format_to_write(path_name(path))
    if not len(scene) and suffix in _NEVER_EMPTY:
        raise SplatFileError.of(
            "scene", f"Gaussians for a {suffix} file", "none", "save it as a PLY"
        )
    arrays = arrays_of(scene)
    if not all((np.abs(value) <= LARGEST).all() for value in arrays.values()):
        expected = f"values that are finite in float32, up to {LARGEST:g}"
        raise InvalidValueError.of(
            "scene", expected, "others", "remove those Gaussians"
        )
    if suffix == ".ply":
        write_ply(scene, path, antialiased=antialiased)
        return Encoded(b"", ())
    module, _, function = _FORMATS[suffix]
    write: Callable[..., Encoded] = getattr(importlib.import_module(module), function)
    more: dict[str, object] = {"antialiased": antialiased} if suffix in TAGGED else {}
    more |= (
        {"version": spz_version}
        if suffix == ".spz"
        else {"ending": suffix}
        if suffix in USD
        else {}
    )
    encoded = write(arrays, **more)
    save_bytes(encoded.data, path)
    return encoded
