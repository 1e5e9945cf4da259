"""Loading and saving a splat in any of the formats: `load_splat` and `save_splat`."""

import os
import warnings
from collections.abc import Callable
from functools import partial
from typing import Literal

from mi_splat.errors import message
from mi_splat.io.atomic import atomic_write, write_all
from mi_splat.io.errors import SplatLossWarning, path_name
from mi_splat.io.formats.compressed_ply import write_compressed_ply
from mi_splat.io.formats.detection import USD, format_to_write
from mi_splat.io.formats.encoded import Encoded
from mi_splat.io.formats.gltf import write_glb
from mi_splat.io.formats.sog import write_sog
from mi_splat.io.formats.splat32 import write_splat
from mi_splat.io.formats.spz import write_spz
from mi_splat.io.formats.usd import write_usd
from mi_splat.io.loaded import as_scene
from mi_splat.io.ply.splat import write_ply
from mi_splat.io.reading import load_arrays
from mi_splat.scene import GaussianScene, check_scene


def load_splat(path: str | os.PathLike[str], *, on_invalid: Literal["raise", "drop"] = "raise") -> GaussianScene:
    """Load a splat: 3DGS PLY, compressed PLY, SPZ, SOG, glTF, OpenUSD, .splat or .ksplat.

    The name and the first bytes of the file say which. Quaternions are normalised. The tensors are float32 on the CPU.
    Every size that the file claims is held against the bytes that are there before memory is taken for it. Where axes
    differ from those of the PLY (SPZ, glTF, OpenUSD), the scene is turned; docs/formats.md says how.

    Of a PLY, text and both byte orders, float and double and any order of properties are read; normals, further
    properties and further elements are passed over. Text, and vertices that carry lists, need the package plyfile.

    Args:
        path: A splat file; or a folder with one: of `mi-splat train` or `dagger`, or with the meta.json of a SOG.
        on_invalid: What to do with Gaussians that are not valid (a value is not finite in float32 or above 1e9, the
            scale vanishes, the quaternion is zero): raise, or drop them with a `SplatFileWarning` that says how many
            and which.

    Returns:
        The scene, on the CPU.

    Raises:
        SplatFileError: The file cannot be read, is no splat, is damaged, or holds Gaussians that are not valid and
            `on_invalid` is "raise".
        InvalidValueError: on_invalid is something else, or path is no path.
    """
    return as_scene(load_arrays(path, on_invalid=on_invalid, stacklevel=2))


def save_splat(scene: GaussianScene, path: str | os.PathLike[str]) -> None:
    """Save a splat in the format that the ending of `path` names.

    `.ply` (as 3DGS writes it), `.glb` and OpenUSD hold all of a scene: means and SH of a float32 scene are kept bit for
    bit. The other formats round; docs/formats.md says how much. The file appears whole or not at all. Saving what was
    loaded from a saved PLY writes the same bytes again.

    Args:
        scene: The scene, on any device.
        path: The file to write: .ply, .compressed.ply, .spz, .sog, .glb, .usdc, .usda, .usdz or .splat; a file that is
            there is replaced.

    Raises:
        SplatFileError: The file cannot be written, or the name fits no format; what was there before is unchanged.
        InvalidValueError: A value is not finite in float32 or too large (`LARGEST`), or the arguments are no scene and
            no path.

    Warns:
        SplatLossWarning: Something is lost beyond that rounding: SH bands are dropped, values are clamped.
    """
    losses = write_splat_file(scene, path).losses
    if losses:
        got = "; ".join(str(loss) for loss in losses)
        text = message(os.fspath(path), "a scene that fits the format", got, "save it as .ply or .glb to keep all")
        warnings.warn(text, SplatLossWarning, stacklevel=2)


def write_splat_file(
    scene: GaussianScene, path: str | os.PathLike[str], *, spz_version: Literal[2, 3, 4] = 3
) -> Encoded:
    """Like `save_splat`, but what is lost is returned and not warned of."""
    check_scene("scene", scene)
    name = path_name(path)
    suffix = format_to_write(name)
    if suffix == ".ply":
        write_ply(scene, path)
        return Encoded(b"", ())
    encoded = write_spz(scene, spz_version) if suffix == ".spz" else _WRITERS[suffix](scene)
    with atomic_write(path) as file:
        write_all(file, memoryview(encoded.data))
    return encoded


_WRITERS: dict[str, Callable[[GaussianScene], Encoded]] = {
    ".compressed.ply": write_compressed_ply,
    ".glb": write_glb,
    ".sog": write_sog,
    ".splat": write_splat,
    **{ending: partial(write_usd, ending=ending) for ending in USD},
}
