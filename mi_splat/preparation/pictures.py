"""The pictures of a set that is being prepared: upright, of bounded size, under names that every tool takes."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from mi_splat.datasets.errors import DatasetError
from mi_splat.datasets.pictures import SUFFIXES, picture_size
from mi_splat.io.documents import file_name
from mi_splat.io.picture_files import PictureFileError, focal_length_35mm, load_picture
from mi_splat.io.pictures import save_picture
from mi_splat.preparation.config import PreparationError, PrepareConfig
from mi_splat.preparation.video import sharpest_frames

Told = Callable[[str, int, int], None]
"""Told what is going on, how much of it is done, and of how much."""

FEWEST_PICTURES = 3
"""Of which cameras can be found."""
_KINDS = frozenset(suffix.lower() for suffix in SUFFIXES)
_OF_PHONES = (".heic", ".heif", ".avif")
_FULL_FRAME = math.hypot(36.0, 24.0)
"""Millimetres: the diagonal that a focal length "in 35 mm" belongs to."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A picture of the set.

    Attributes:
        name: Of its file in images/.
        source: Its file, or when it is in a video.
        size: Width and height, pixels.
        focal: Focal length in pixels, as the camera has written it; None if it has not.
    """

    name: str
    source: str
    size: tuple[int, int]
    focal: float | None = None


def pictures_in(folder: Path, most: int) -> list[Path]:
    """The pictures of a folder in the order of their names; those of phones that cannot be read are among them."""
    kinds = _KINDS.union(_OF_PHONES)
    pictures = sorted(path for path in folder.iterdir() if path.suffix.lower() in kinds and path.is_file())
    if len(pictures) > most:
        do = "leave some out, or allow more"
        error = PreparationError.of(str(folder), f"at most {most} pictures", len(pictures), do)
        raise error.hinted("--max-pictures")
    check_count(str(folder), pictures)
    return pictures


def check_count(source: str, pictures: Sequence[object]) -> None:
    """Raise if there are too few pictures to find cameras by."""
    if len(pictures) < FEWEST_PICTURES:
        expected = f"at least {FEWEST_PICTURES} pictures ({', '.join(sorted(_KINDS))})"
        do = "20 to 200 that overlap by two thirds are usual"
        raise PreparationError.of(source, expected, len(pictures) or "none", do)


def take_photographs(
    folder: Path, images: Path, config: PrepareConfig, told: Told
) -> tuple[list[Picture], dict[str, str]]:
    """Write the pictures of a folder into images/, turned as EXIF says and without what else it says."""
    paths = pictures_in(folder, config.max_pictures)
    taken: list[Picture] = []
    broken: dict[str, str] = {}
    for number, path in enumerate(paths):
        told("reading pictures", number, len(paths))
        try:
            picture_size(path)
            photograph = load_picture(path, upright=True)
        except (PictureFileError, DatasetError) as error:
            broken[path.name] = str(error)
            continue
        focal = focal_length_35mm(photograph)
        pixels = _opaque(photograph)
        pixels.thumbnail((config.longest_side, config.longest_side), Image.Resampling.LANCZOS, reducing_gap=3.0)
        ending = ".jpg" if path.suffix.lower() in (".jpg", ".jpeg") else ".png"
        name = _free_name(file_name(path.stem), ending, {picture.name for picture in taken})
        save_picture(np.asarray(pixels), images / name)
        scale = math.hypot(*pixels.size) / _FULL_FRAME
        taken.append(
            Picture(name=name, source=path.name, size=pixels.size, focal=None if focal is None else focal * scale)
        )
    if len(taken) < FEWEST_PICTURES and broken:
        name, reason = next(iter(broken.items()))
        raise PreparationError(f"{len(broken)} of {len(paths)} pictures cannot be read, {name} for instance: {reason}")
    return taken, broken


def take_frames(video: Path, images: Path, config: PrepareConfig, told: Told) -> list[Picture]:
    """Write the sharpest pictures of a video into images/."""
    taken: list[Picture] = []
    frames = sharpest_frames(
        video,
        longest_side=config.longest_side,
        interval=config.interval,
        most=config.max_pictures,
        on_second=lambda done, total: told("reading the video", done, total),
    )
    for second, pixels in frames:
        name = f"frame_{len(taken):05d}.jpg"
        save_picture(pixels, images / name)
        taken.append(Picture(name=name, source=f"{second:.1f} s", size=(pixels.shape[1], pixels.shape[0])))
    if len(taken) < FEWEST_PICTURES:
        expected, got = (
            f"a video of at least {FEWEST_PICTURES} intervals",
            f"{len(taken)} of {config.interval:g} seconds",
        )
        error = PreparationError.of(str(video), expected, got, "pass a longer one, or a shorter interval")
        raise error.hinted("--interval")
    return taken


def _opaque(picture: Image.Image) -> Image.Image:
    """A picture in sRGB colours; over black where it is transparent."""
    if "A" not in picture.mode and "a" not in picture.mode and "transparency" not in picture.info:
        return picture.convert("RGB")
    layers = Image.new("RGBA", picture.size, "black"), picture.convert("RGBA")
    return Image.alpha_composite(*layers).convert("RGB")


def _free_name(stem: str, ending: str, taken: set[str]) -> str:
    """A name that no other picture has, on disks, too, that take small and capital letters for the same."""
    small, number, name = {other.lower() for other in taken}, 2, f"{stem}{ending}"
    while name.lower() in small:
        name, number = f"{stem}-{number}{ending}", number + 1
    return name
