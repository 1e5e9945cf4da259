"""Images and animations in the format that their names end in, and what 8 bits keep of
a rendering.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import save_bytes

if TYPE_CHECKING:
    from torch import Tensor

PICTURES = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}
"""Format of an image by the ending of its name."""
ANIMATIONS = (".gif", ".webp")
FLOATS = ".exr"
"""Ending of an image of floats."""
_JPEG_QUALITY = 95
_WEBP_QUALITY = 80
_GAP = 8  # pixels between images beside each other


def is_picture(path: Path) -> bool:
    """Whether a name ends as that of an image that can be written."""
    return path.suffix.lower() in PICTURES


def is_animation(path: Path) -> bool:
    """Whether a name ends as that of an animation that can be written."""
    return path.suffix.lower() in ANIMATIONS


def is_floats(path: Path) -> bool:
    """Whether a name ends as that of an image of floats."""
    return path.suffix.lower() == FLOATS


def save_picture(pixels: NDArray[np.uint8], path: Path) -> None:
    """Write (H, W, 3) pixels as PNG or JPEG, as the name says."""
    if not is_picture(path):
        do = "end it in .png or .jpg"
        raise InvalidValueError.of(
            str(path), "the name of an image", path.suffix or "no ending", do
        )
    buffer = io.BytesIO()
    kind = PICTURES[path.suffix.lower()]
    options = {"quality": _JPEG_QUALITY, "subsampling": 0} if kind == "JPEG" else {}
    Image.fromarray(pixels).save(buffer, format=kind, **options)
    save_bytes(buffer.getvalue(), path)


def save_animation(
    frames: Sequence[NDArray[np.uint8]], path: Path, *, fps: float
) -> None:
    """Write (H, W, 3) images one after the other, as GIF or WebP, in a loop."""
    sizes = {frame.shape for frame in frames}
    if len(sizes) != 1:
        got = f"{len(sizes)} sizes" if sizes else "none"
        raise InvalidValueError.of(
            "animation", "images of one size", got, "give the cameras one size"
        ).hinted("--size")
    if not 0 < fps <= 1000:
        raise InvalidValueError.of(
            "fps", "images a second, up to 1000", fps, "24 is usual"
        )
    if not is_animation(path):
        do = "end it in .gif or .webp"
        raise InvalidValueError.of(
            str(path), "the name of an animation", path.suffix or "no ending", do
        )
    first, *rest = map(Image.fromarray, frames)
    options: dict[str, float] = {
        "duration": round(1000 / fps),
        "quality": _WEBP_QUALITY,
    }
    if path.suffix.lower() == ".gif":
        first, *rest = (
            image.quantize(256, dither=Image.Dither.FLOYDSTEINBERG)
            for image in (first, *rest)
        )
        options = {"duration": 1000 / fps}
    buffer = io.BytesIO()
    first.save(
        buffer, path.suffix[1:], save_all=True, append_images=rest, loop=0, **options
    )
    save_bytes(buffer.getvalue(), path)


def quantise(image: Tensor) -> Tensor:
    """The image as 8 bits hold it, back in [0, 1]."""
    return (image.detach().clamp(0, 1) * 255).round() / 255


def to_bytes(image: Tensor) -> np.ndarray:
    """(H, W, 3) sRGB in [0, 1] as uint8."""
    return (image.detach().clamp(0, 1) * 255).round().cpu().numpy().astype(np.uint8)


def from_bytes(pixels: Tensor) -> Tensor:
    """(H, W, 3) float32 sRGB in [0, 1] of uint8 pixels."""
    return pixels.float() / 255


def through_png(image: Tensor) -> Tensor:
    """The image as an 8-bit PNG keeps it, which loses nothing else; (H, W, 3) float32
    in [0, 1].
    """
    import torch  # writing does without

    return torch.from_numpy(to_bytes(image).astype(np.float32) / 255).to(image.device)


def side_by_side(pictures: Sequence[Tensor]) -> NDArray[np.uint8]:
    """(H, W, 3) images beside each other, white between them and below lower ones."""
    pixels = [to_bytes(picture.clamp(0, 1)) for picture in pictures]
    height = max(map(len, pixels))
    gap = np.full((height, _GAP, 3), 255, np.uint8)
    parts = [
        np.pad(p, ((0, height - len(p)), (0, 0), (0, 0)), constant_values=255)
        for p in pixels
    ]
    return np.concatenate(
        [part for shown in parts for part in (gap, shown)][1:], axis=1
    )
