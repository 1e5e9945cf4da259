"""The images of a set that is being prepared: upright, of bounded size, without what
else EXIF says.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from mi_splat.datasets.errors import DatasetError
from mi_splat.datasets.folders import MASKS, SUFFIXES, SetFiles
from mi_splat.datasets.frames import picture_size
from mi_splat.io.documents import file_name, save_png
from mi_splat.io.images import save_picture
from mi_splat.io.picture_files import (
    PictureFileError,
    focal_length_35mm,
    load_picture,
    made_upright,
    picture_orientation,
)
from mi_splat.preparation.config import PreparationError, PrepareConfig

FEWEST_IMAGES = 3
"""Of which cameras can be found."""
_OF_PHONES = (".heic", ".heif", ".avif")
"""Images that are not read; they are named as such."""
_FULL_FRAME = math.hypot(36.0, 24.0)
"""Millimetres: the diagonal that a focal length "in 35 mm" belongs to."""

OnProgress = Callable[[str, int, int], None]
"""Called with what is going on, how much of it is done, and of how much."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Photograph:
    """An image of the set.

    Images of one size and focal length share a camera, so that both orientations of a
    phone are placed.
    """

    name: str  # of its file in images/
    source: str  # its file, or when it is in a video
    size: tuple[int, int]  # width and height, pixels
    focal: float | None = None  # focal length in pixels, as the camera has written it


def images_in(folder: Path, most: int) -> list[Path]:
    """The images of a folder in the order of their names, with those that cannot be
    read.

    Raises:
        PreparationError: There are too few, or too many.
    """
    kinds = (*SUFFIXES, *_OF_PHONES)
    images = sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in kinds and path.is_file()
    )
    if len(images) > most:
        do = "leave some out, or allow more"
        error = PreparationError.of(
            str(folder), f"at most {most} images", len(images), do
        )
        raise error.hinted("--max-images")
    if len(images) < FEWEST_IMAGES:
        expected = f"at least {FEWEST_IMAGES} images ({', '.join(SUFFIXES)})"
        do = "20 to 200 that overlap by two thirds are usual"
        raise PreparationError.of(str(folder), expected, len(images) or "none", do)
    return images


def take_photographs(
    folder: Path,
    out: Path,
    config: PrepareConfig,
    on_progress: OnProgress,
    *,
    masks: Path | None = None,
) -> tuple[list[Photograph], dict[str, str]]:
    """Write the images of a folder into images/ of a set, and their masks into masks/.

    Args:
        folder: Where the photographs are.
        out: Folder of the set, with images/ in it.
        config: How large the images become.
        on_progress: Told of each image.
        masks: Folder of masks by the names of the photographs; None if there are none.

    Returns:
        The images, and by the names of files that cannot be read why they cannot.
    """
    paths = images_in(folder, config.max_images)
    taken: list[Photograph] = []
    broken: dict[str, str] = {}
    masked = SetFiles(masks or folder)
    for number, path in enumerate(paths):
        on_progress("reading photographs", number, len(paths))
        try:
            picture_size(path)
            image = load_picture(path, upright=True)
            mask_file = None if masks is None else masked.mask([masks], path.name)
            mask = None if mask_file is None else _mask_of(mask_file, path, image.size)
        except (PictureFileError, DatasetError) as error:
            broken[path.name] = str(error)
            continue
        focal = focal_length_35mm(image)
        pixels = _opaque(image)
        pixels.thumbnail(
            (config.longest_side,) * 2, Image.Resampling.LANCZOS, reducing_gap=3.0
        )
        ending = ".jpg" if path.suffix.lower() in (".jpg", ".jpeg") else ".png"
        name = _free_name(file_name(path.stem), ending, {photo.name for photo in taken})
        save_picture(np.asarray(pixels), out / "images" / name)
        if mask is not None:
            (out / MASKS).mkdir(exist_ok=True)
            small = mask.resize(pixels.size, Image.Resampling.BOX)
            save_png(np.asarray(small), out / MASKS / f"{name}.png")
        if focal is not None:
            focal *= math.hypot(*pixels.size) / _FULL_FRAME
        taken.append(
            Photograph(name=name, source=path.name, size=pixels.size, focal=focal)
        )
    if len(taken) < FEWEST_IMAGES:
        name, reason = next(iter(broken.items()))
        text = (
            f"{len(broken)} of {len(paths)} images cannot be read, {name} for instance:"
            f" {reason}"
        )
        raise PreparationError(text)
    return taken, broken


def _mask_of(file: Path, photograph: Path, size: tuple[int, int]) -> Image.Image:
    """The mask of a photograph that has a size when it is upright; drawn on it upright,
    or as it is stored.
    """
    mask = load_picture(file).convert("L")
    for turned in (mask, made_upright(mask, picture_orientation(photograph))):
        if abs(turned.width * size[1] - turned.height * size[0]) <= max(size):
            return turned
    expected = f"a mask of {size[0]} x {size[1]} pixels"
    got = f"{mask.width} x {mask.height}"
    raise DatasetError.of(
        str(file), expected, got, "make the mask as large as its image"
    )


def _opaque(image: Image.Image) -> Image.Image:
    """An image in sRGB colours; over black where it is transparent."""
    has_alpha = "A" in image.mode or "a" in image.mode or "transparency" in image.info
    if not has_alpha:
        return image.convert("RGB")
    black = Image.new("RGBA", image.size, "black")
    return Image.alpha_composite(black, image.convert("RGBA")).convert("RGB")


def _free_name(stem: str, ending: str, taken: set[str]) -> str:
    """A name that no other image has, on disks, too, that take small and capital
    letters for the same.
    """
    small = {other.lower() for other in taken}
    number = 2
    name = f"{stem}{ending}"
    while name.lower() in small:
        name = f"{stem}-{number}{ending}"
        number += 1
    return name
