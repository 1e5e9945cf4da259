"""Loading and saving a splat in any of the formats; torch comes with scenes, and not
with arrays.
"""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Literal

import numpy as np

from mi_splat.attributes import LARGEST
from mi_splat.errors import InvalidValueError, message
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
from mi_splat.io.formats import gaussian_ply, gltf, sog, splat32, spz, usd
from mi_splat.io.formats.format import FORMATS, Format, Saving
from mi_splat.io.loaded import Encoded, Loaded, arrays_of, open_regular

if TYPE_CHECKING:
    from mi_splat.scene import GaussianScene

HEAD = 32
"""First bytes of a file by which its format is known."""

for _format in (
    gaussian_ply.PLY,
    gltf.GLB,
    usd.USDC,
    usd.USDA,
    usd.USDZ,
    gaussian_ply.COMPRESSED_PLY,
    sog.SOG,
    spz.SPZ,
    splat32.SPLAT,
):
    FORMATS.add(_format.name, _format)

SUFFIXES = tuple(suffix for each in FORMATS.own.values() for suffix in each.suffixes)
"""Endings of the project's own formats."""

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
    named = _named(path)
    if named is None:
        return None
    return named[1]


def _named(path: str) -> tuple[Format, str] | None:
    """The format that a name promises, and its suffix."""
    name = os.path.basename(path).lower()
    for formats in (FORMATS.own.values(), _brought()):
        ends = [
            (each, suffix)
            for each in formats
            for suffix in each.suffixes
            if name.endswith(suffix)
        ]
        if ends:
            return max(ends, key=lambda pair: len(pair[1]))
    return None


def _marked(head: bytes) -> list[Format]:
    """The formats whose files begin like this."""
    for formats in (FORMATS.own.values(), _brought()):
        marked = [each for each in formats if head.startswith(each.magic)]
        if marked:
            return marked
    return []


def _brought() -> Iterator[Format]:
    """Formats of other packages, imported only where none of ours fits."""
    for name in FORMATS.brought:
        yield FORMATS[name]


def format_to_read(path: str, head: bytes) -> Format:
    """The format of a file that begins with `head`.

    A name that promises nothing is overruled by the file's mark; one that promises
    something else is an error.
    """
    lower = path.lower()
    if lower.endswith((*_PROGRAMS, ".npz")):
        raise _unknown(path)
    if lower.endswith(_ZIP.suffixes) and head.startswith(b"PK"):
        return _ZIP
    named = _named(path)
    marked = _marked(head)
    if named is None:
        if not marked:
            raise _unknown(path)
        return marked[0]
    if marked and named[0] not in marked:
        expected = f"a {named[1]} file"
        true = marked[0].suffixes[0]
        got = f"the mark of a {true} file"
        raise SplatFileError.of(path, expected, got, f"rename it to {true}")
    return named[0]


def format_to_write(path: str) -> tuple[Format, str]:
    """The format in which a file is to be written, and the suffix of its name."""
    named = _named(path)
    if named is None or named[0].write is None:
        raise _unknown(path)
    named[0].check(path)
    return named


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
            return _read(file, name)
    except OSError as error:
        raise from_os_error(name, "a splat file that can be read", error) from error


def _read(file: io.FileIO, name: str) -> Loaded:
    """The content of an open file."""
    found = format_to_read(name, os.pread(file.fileno(), HEAD, 0))
    found.check(name)
    return found.read(file, name)


def _read_archived(file: io.FileIO, name: str) -> Loaded:
    """The content of the splat in an archive."""
    suffixes = tuple(
        suffix
        for each in FORMATS.values()
        if each.in_archives
        for suffix in each.suffixes
    )
    with archives.splat_of(file, name, suffixes) as (member, inner):
        return _read(member, inner)


_ZIP = Format(name="zip", suffixes=(".zip",), read=_read_archived)
"""What a download is packed in."""


def write_splat_file(
    scene: GaussianScene,
    path: str | os.PathLike[str],
    *,
    version: int | None = None,
    antialiased: bool = False,
) -> Encoded:
    """Like `save_splat`, but in a version of the format if one is asked for, and what
    is lost is returned and not warned of.
    """
    from mi_splat.scene import check_scene

    check_scene("scene", scene)
    chosen, suffix = format_to_write(path_name(path))
    assert chosen.write is not None
    if version is not None and version not in chosen.versions:
        expected = " or ".join(map(str, chosen.versions)) or "none"
        raise InvalidValueError.of(
            f"version of a {suffix} file", expected, version, "leave it out"
        )
    if not len(scene) and not chosen.keeps_nothing:
        raise SplatFileError.of(
            "scene", f"Gaussians for a {suffix} file", "none", "save it as a PLY"
        )
    arrays = arrays_of(scene)
    if not all((np.abs(value) <= LARGEST).all() for value in arrays.values()):
        expected = f"values that are finite in float32, up to {LARGEST:g}"
        raise InvalidValueError.of(
            "scene", expected, "others", "remove those Gaussians"
        )
    saving = Saving(
        suffix=suffix,
        antialiased=antialiased and chosen.keeps_antialiasing,
        version=version,
    )
    encoded = chosen.write(arrays, saving)
    save_bytes(encoded.data, path, head=encoded.head)
    return encoded
