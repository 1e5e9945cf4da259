"""Images and gradients that a renderer has written: PNG and NumPy files, read with
nothing but NumPy; others with the readers that are passed.
"""

from __future__ import annotations

import io
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mi_splat.errors import InvalidValueError, one_line
from mi_splat.oracle import Array

_MOST_PIXELS = 4096 * 4096
_PNG = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}
"""By the colour type of a PNG: grey, RGB, grey and alpha, RGBA."""
_DAMAGED = (
    OSError,
    EOFError,
    ValueError,
    TypeError,
    KeyError,
    OverflowError,
    MemoryError,
    # an encrypted member, or a method of compression that Python does not know
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    # a header of an array that is no Python literal
    SyntaxError,
    tokenize.TokenError,
)
"""What reading a damaged file raises."""


class FoundImage(NamedTuple):
    """An image of a renderer."""

    values: Array  # (H, W, 3), or (H, W, 4) with an alpha; colours times their alpha
    bits: int  # of a channel, 8 or 32


Reader = Callable[[Path], FoundImage]


def as_image(values: Array, what: str) -> FoundImage:
    """An array as an image: bytes, or floats in 0 to 1; (H, W, 3 or 4), where the alpha
    of bytes is one that colours are yet to be multiplied by.
    """
    array = np.asarray(values)
    shape = array.ndim == 3 and array.shape[2] in (3, 4)
    if not shape or array.dtype.kind not in "uif":
        got = f"{array.shape} of {array.dtype}"
        raise InvalidValueError.of(
            what, "numbers (H, W, 3) or (H, W, 4)", got, "save an RGB image"
        )
    if array.dtype != np.uint8:
        return FoundImage(_without_plain_alpha(array.astype(np.float64)), 32)
    image = array / 255
    if image.shape[2] == 4:
        image[..., :3] *= image[..., 3:]
    return FoundImage(_without_plain_alpha(image), 8)


def _without_plain_alpha(image: Array) -> Array:
    if image.shape[2] == 4 and image[..., 3].min(initial=1.0) >= 1:
        return image[..., :3]
    return image


def read_images(
    folder: str | PathLike[str],
    names: Iterable[str],
    readers: Mapping[str, Reader] | None = None,
) -> dict[str, FoundImage]:
    """The images of a folder by the name of their scene.

    Args:
        folder: Where they are, called NAME.png, NAME.npy or as `readers` know.
        names: Of the scenes.
        readers: Of other formats, by their endings in lower case.
    """
    known = {**_READERS, **(_PILLOW if find_spec("PIL") else {}), **(readers or {})}
    every = list(names)
    files = {
        path.stem: path
        for path in sorted(Path(folder).iterdir())
        if path.suffix.lower() in known and path.is_file()
    }
    found = {
        name: _read(known[files[name].suffix.lower()], files[name])
        for name in every
        if name in files
    }
    if not found:
        raise InvalidValueError.of(
            str(folder),
            f"images such as {every[0]}.png",
            "none",
            f"render the splats of the pack; {', '.join(known)} are read",
        )
    return found


def _read(reader: Reader, path: Path) -> FoundImage:
    try:
        return reader(path)
    except InvalidValueError:
        raise
    except _DAMAGED as error:
        got = one_line(str(error), 200) or type(error).__name__
        do = "save it again, or as another format"
        raise InvalidValueError.of(str(path), "an image", got, do) from error


def read_npy(path: Path) -> FoundImage:
    """An array that numpy.save has written."""
    return as_image(_array(path.read_bytes(), 8 * 4 * _MOST_PIXELS), str(path))


def _array(data: bytes, most: int) -> Array:
    """An array of a file without objects, which is as long as its shape says."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[version]
    shape, _, dtype = read(stream)
    size = math.prod(shape) * dtype.itemsize
    if dtype.hasobject or size > most or size != len(data) - stream.tell():
        raise ValueError(f"an array {shape} of {dtype} in {len(data):,} bytes")
    stream.seek(0)
    array: Array = np.lib.format.read_array(stream, allow_pickle=False)
    return array


def read_gradients(
    folder: str | PathLike[str], exact: Mapping[str, Mapping[str, Array]]
) -> dict[str, dict[str, Array]]:
    """The arrays of NAME.npz that are called as exact ones, by scene; none may be
    larger than twice those in the file.
    """
    found = {}
    for name, arrays in exact.items():
        path = Path(folder) / f"{name}.npz"
        if path.is_file():
            most = 1024 + 16 * max(values.size for values in arrays.values())
            found[name] = _read_arrays(path, arrays, most)
    if not found:
        raise InvalidValueError.of(
            str(folder),
            f"gradients such as {next(iter(exact))}.npz with arrays such as means",
            "none",
            "save them as those of the pack are",
        )
    return found


def _read_arrays(path: Path, keys: Iterable[str], most: int) -> dict[str, Array]:
    found = {}
    try:
        with zipfile.ZipFile(path) as archive:
            members = set(archive.namelist())
            for key in keys:
                if f"{key}.npy" not in members:
                    continue
                with archive.open(f"{key}.npy") as member:
                    data = member.read(most + 1)
                if len(data) > most:
                    raise ValueError(f"more than {most:,} bytes of {key}")
                found[key] = _array(data, most).astype(np.float64)
    except _DAMAGED as error:
        got = one_line(str(error), 200) or type(error).__name__
        do = "save them with numpy.savez"
        raise InvalidValueError.of(
            str(path), "arrays shaped as those of the pack", got, do
        ) from error
    return found


def _read_by_pillow(path: Path) -> FoundImage:
    from PIL import Image

    with Image.open(path, formats=("JPEG", "WEBP")) as image:
        if image.width * image.height > _MOST_PIXELS:
            raise ValueError(f"{image.width} x {image.height} pixels")
        return as_image(np.asarray(image.convert("RGBA")), str(path))


# -------------------------------------------------------------------------------- PNG


def read_png(path: Path) -> FoundImage:
    """A PNG of 8 bits, grey or RGB, with or without alpha, not interlaced."""
    return as_image(_decoded(path.read_bytes()), str(path))


def _decoded(data: bytes) -> Array:
    """(H, W, 3 or 4) bytes of a PNG (ISO/IEC 15948)."""
    if not data.startswith(_PNG):
        raise ValueError("no PNG")
    chunks = list(_chunks(data))
    head = next((body for kind, body in chunks if kind == b"IHDR"), b"")
    width, height, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", head)
    if depth != 8 or colour not in _CHANNELS or interlaced:
        raise ValueError(
            f"a PNG of {depth} bits, colour type {colour}"
            f"{', interlaced' if interlaced else ''}; only plain 8-bit grey and RGB"
            " are read"
        )
    channels = _CHANNELS[colour]
    if not 0 < width * height <= _MOST_PIXELS:
        raise ValueError(f"{width} x {height} pixels")
    stride = 1 + width * channels
    packed = b"".join(body for kind, body in chunks if kind == b"IDAT")
    raw = zlib.decompressobj().decompress(packed, height * stride)
    if len(raw) != height * stride:
        raise ValueError("the PNG is cut off")
    lines = np.frombuffer(raw, dtype=np.uint8).reshape(height, stride)
    pixels = _unfiltered(lines, channels).reshape(height, width, channels)
    if channels < 3:  # grey
        grey = np.repeat(pixels[..., :1], 3, axis=2)
        return np.concatenate([grey, pixels[..., 1:]], axis=2)
    return pixels


def _chunks(data: bytes) -> Iterable[tuple[bytes, bytes]]:
    at = len(_PNG)
    while at + 8 <= len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        yield kind, data[at + 8 : at + 8 + length]
        at += 12 + length


def _unfiltered(lines: Array, channels: int) -> Array:
    """Bytes from their differences to the left, above, or a mixture of both."""
    found = np.zeros((len(lines), lines.shape[1] - 1), dtype=np.uint8)
    above = np.zeros(found.shape[1], dtype=np.uint8)
    for row, line in enumerate(lines):
        kind = line[0]
        if kind == 0:
            found[row] = line[1:]
        elif kind == 1:
            steps = line[1:].reshape(-1, channels)
            found[row] = np.cumsum(steps, axis=0, dtype=np.uint8).ravel()
        elif kind == 2:
            found[row] = line[1:] + above
        else:
            found[row] = _predicted(line[1:], above, channels, paeth=kind == 4)
        above = found[row]
    return found


def _predicted(line: Array, above: Array, channels: int, *, paeth: bool) -> Array:
    """A line whose filter needs the bytes to the left one after the other."""
    out = [0] * channels + line.tolist()
    up = [0] * channels + above.tolist()
    for i in range(channels, len(out)):
        a = out[i - channels]
        b = up[i]
        guess = (a + b) // 2
        if paeth:
            c = up[i - channels]
            guess = min(
                (abs(b - c), 0, a), (abs(a - c), 1, b), (abs(a + b - 2 * c), 2, c)
            )[2]
        out[i] = (out[i] + guess) & 255
    return np.array(out[channels:], dtype=np.uint8)


_READERS: dict[str, Reader] = {".png": read_png, ".npy": read_npy}
_PILLOW: dict[str, Reader] = dict.fromkeys((".jpg", ".jpeg", ".webp"), _read_by_pillow)
"""By the ending of a file: those that need nothing but NumPy, and those of Pillow."""
