"""What every format comes down to: cameras with the files of their images."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from mi_splat.cameras.camera import Camera
from mi_splat.cameras.lens import Lens
from mi_splat.datasets.errors import DatasetError, DatasetWarning
from mi_splat.datasets.folders import SUFFIXES as SUFFIXES
from mi_splat.datasets.folders import is_smaller
from mi_splat.datasets.lenses import ImageLens, pinhole
from mi_splat.errors import InvalidValueError
from mi_splat.io.picture_files import (
    check_pixels,
    load_picture,
    picture_header,
    picture_orientation,
)
from mi_splat.io.points import PointCloud

_MODES = (
    "1",
    "L",
    "LA",
    "La",
    "P",
    "PA",
    "RGB",
    "RGBA",
    "RGBa",
    "RGBX",
    "CMYK",
    "YCbCr",
    "HSV",
    "LAB",
)

Pixels = NDArray[np.float32]
Size = tuple[int, int]

_QUARTER_TURNS = {1: 0, 6: 1, 3: 2, 8: 3}
"""Quarter turns clockwise that an EXIF orientation wants; the other four are mirror
images.
"""

Split = Literal["train", "test"]
HELD_OUT = 8
"""Where a format has no split of its own, images in the order of names are for tests at
multiples of this index.
"""

MOST_MISSING = 1 / 3
"""Share of the images that a set lists and does not have, above which it is refused."""

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Frame:
    """One image of a set.

    The image is turned, undistorted and turned again; its mask alike.
    """

    camera: Camera  # the pinhole camera of the result, at full size
    path: Path
    mask: Path | None = None  # a grey image, white where the image counts
    # of the image after the first turn; None if it is a pinhole camera's
    lens: ImageLens | None = None
    turns_before: int = 0  # quarter turns clockwise
    turns_after: int = 0

    @property
    def is_stored(self) -> bool:
        """Whether the image is what its file holds, neither turned nor undistorted."""
        return self.lens is None and not self.turns_before and not self.turns_after


class Found(NamedTuple):
    """What a reader found in the files of a set."""

    frames: list[Frame]  # of the split
    listed: frozenset[Path]  # every image that the files list, there or not
    points: PointCloud | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Photo:
    """A file with an image, known without decoding it."""

    path: Path
    stored: Size  # width and height in the file
    size: Size  # those that the set's intrinsics mean
    turns_before: int = 0
    turns_after: int = 0


def photo_of(path: Path, claimed: Size | None) -> Photo:
    """The image in a file, and how it becomes upright.

    EXIF says how a photograph is to be turned. Structure from motion works on the
    pixels as they are stored, so the camera is turned with the image. Where a set
    claims the size of the upright image, its camera is that of the upright image.
    """
    stored = picture_size(path)
    turns = quarter_turns(path)
    if claimed is None or claimed == stored:
        return Photo(path=path, stored=stored, size=stored, turns_after=turns)
    if turns % 2 and _are_alike(stored[::-1], claimed, path):
        return Photo(path=path, stored=stored, size=claimed, turns_before=turns)
    if _are_alike(stored, claimed, path):
        return Photo(path=path, stored=stored, size=claimed, turns_after=turns)
    got = f"{stored[0]} x {stored[1]}"
    do = "use the images from which the cameras were estimated"
    raise DatasetError.of(str(path), f"{claimed[0]} x {claimed[1]} pixels", got, do)


def _are_alike(stored: Size, claimed: Size, path: Path) -> bool:
    """Whether an image has the size that a set claims, or in a folder of smaller images
    its aspect.
    """
    if stored == claimed:
        return True
    scale = max(stored) / max(claimed)
    gaps = [
        abs(side - whole * scale) for side, whole in zip(stored, claimed, strict=True)
    ]
    return is_smaller(path) and max(gaps) <= 1


def quarter_turns(path: Path) -> int:
    """Quarter turns clockwise that make an image upright by its EXIF orientation; 0 for
    a mirror image.
    """
    return _QUARTER_TURNS.get(picture_orientation(path), 0)


def frame_of(
    photo: Photo, mask: Path | None, pose: Tensor, lens: ImageLens, where: str
) -> Frame:
    """The frame of an image whose set says so of its lens and its pose."""
    if mask is not None:
        check_mask(mask, photo)
    size = photo.stored if photo.turns_before % 2 == 0 else photo.stored[::-1]
    if lens.size != size:
        lens = lens.resized(size)
    try:
        flat = pinhole(lens)
    except InvalidValueError as error:
        raise DatasetError(f"{where}: {error}") from error
    if not lens.is_pinhole:
        check_pixels(f"{photo.path} without its distortion", *flat.size)
    camera = camera_of(pose, flat, where)
    return Frame(
        camera=turned_clockwise(camera, photo.turns_after),
        path=photo.path,
        mask=mask,
        lens=None if lens.is_pinhole else lens,
        turns_before=photo.turns_before,
        turns_after=photo.turns_after,
    )


def camera_of(pose: Tensor, lens: ImageLens, where: str) -> Camera:
    """The camera of a pose with a lens without distortion; errors name the place in the
    set.
    """
    try:
        flat = Lens(
            focal=lens.focal,
            size=lens.size,
            principal=lens.principal,
            projection=lens.projection,
        )
        return Camera(to_world=pose, lens=flat)
    except InvalidValueError as error:
        raise DatasetError(f"{where}: {error}") from error


def turned_clockwise(camera: Camera, quarter_turns: int) -> Camera:
    """The camera whose image is that of `camera`, turned clockwise by so many quarter
    turns.
    """
    for _ in range(quarter_turns % 4):
        pose = camera.to_world.clone()
        # What was up in the image is right now, and what was right is down.
        pose[:3, 0] = -camera.to_world[:3, 1]
        pose[:3, 1] = camera.to_world[:3, 0]
        lens = camera.lens
        across, down = lens.scale
        width, height = lens.size
        turned = replace(
            lens,
            focal=(down, across),
            size=(height, width),
            principal=(height - lens.cy, lens.cx),
        )
        camera = Camera(to_world=pose, lens=turned)
    return camera


def turned_image(values: Pixels, quarter_turns: int) -> Pixels:
    """(H, W, ...) pixels after so many quarter turns clockwise."""
    if quarter_turns % 4:
        return np.rot90(values, -quarter_turns)
    return values


def picture_size(path: Path, claimed: Size | None = None) -> Size:
    """Width and height of an image as it is stored, read off its header."""
    size, mode = picture_header(path)
    if mode not in _MODES:
        raise DatasetError.of(
            str(path), "8 bits a channel", f"mode {mode}", "convert it to 8 bits"
        )
    if claimed is not None and size != claimed:
        got = f"{size[0]} x {size[1]}"
        do = "use the images from which the cameras were estimated"
        raise DatasetError.of(str(path), f"{claimed[0]} x {claimed[1]} pixels", got, do)
    return size


def stored_pixels(
    path: Path, background: tuple[float, float, float], *, upright: bool = False
) -> tuple[Pixels, Pixels | None]:
    """(H, W, 3) sRGB of an image over a background, and its (H, W, 1) alpha if it has
    one.
    """
    picture = load_picture(path, upright=upright)
    has_alpha = (
        "A" in picture.mode or "a" in picture.mode or "transparency" in picture.info
    )
    values = np.asarray(
        picture.convert("RGBA" if has_alpha else "RGB"), np.float32
    ) / np.float32(255)
    if not has_alpha:
        return values, None
    alpha = values[..., 3:]
    blended = values[..., :3] * alpha + np.asarray(background, np.float32) * (1 - alpha)
    return blended, alpha


def read_picture(
    path: Path,
    *,
    downscale: int,
    background: tuple[float, float, float],
    upright: bool = False,
) -> tuple[Tensor, Tensor | None]:
    """An image over a background, and its alpha; upright as its EXIF orientation says,
    or as it is stored.
    """
    values, alpha = stored_pixels(path, background, upright=upright)
    image = torch.from_numpy(area_mean(values, downscale))
    return image, (
        None if alpha is None else torch.from_numpy(area_mean(alpha, downscale)[..., 0])
    )


def check_mask(path: Path, photo: Photo) -> None:
    """Raise if a mask has another shape than its image, which it may be larger or
    smaller than.
    """
    size = picture_size(path)
    is_upright = (photo.turns_before + photo.turns_after) % 2 and _have_one_aspect(
        size[::-1], photo.stored
    )
    if not is_upright and not _have_one_aspect(size, photo.stored):
        expected = f"a mask of {photo.stored[0]} x {photo.stored[1]} pixels"
        do = "make the mask as large as its image"
        raise DatasetError.of(str(path), expected, f"{size[0]} x {size[1]}", do)


def _have_one_aspect(size: Size, other: Size) -> bool:
    """Whether one of two images is the other one, made larger or smaller."""
    larger, smaller = sorted((size, other), reverse=True)
    scale = smaller[0] / larger[0]
    return abs(larger[1] * scale - smaller[1]) <= 1


def stored_mask(path: Path, image: Path, size: Size) -> Pixels:
    """(H, W, 1) mask in [0, 1], the grey values of a file, at the size of its image as
    that is stored.
    """
    mask = load_picture(path).convert("L")
    turns = quarter_turns(image)
    if turns % 2 and not _have_one_aspect(mask.size, size):
        # The mask was drawn on the upright image.
        mask = Image.fromarray(np.rot90(np.asarray(mask), turns))
    if mask.size != size:
        mask = mask.resize(size, Image.Resampling.BOX)
    return np.asarray(mask, np.float32)[..., None] / np.float32(255)


def resized_plane(plane: Pixels, size: Size) -> Pixels:
    """(h, w) values at another width and height; pixels are averaged."""
    image = Image.fromarray(np.ascontiguousarray(plane, np.float32))
    return np.asarray(image.resize(size, Image.Resampling.BOX), np.float32)


def area_mean(values: Pixels, factor: int) -> Pixels:
    """(H // factor, W // factor, C) means over squares of pixels; a rest at the right
    and at the bottom is cut off.
    """
    if factor == 1:
        return np.ascontiguousarray(values)
    height = values.shape[0] // factor
    width = values.shape[1] // factor
    rows = values[: height * factor].reshape(height, factor, values.shape[1], -1)
    # Sums of float32 images are exact in float64, in any order; of whole rows they
    # take a third of the time.
    sums = rows[:, 0].astype(np.float64)
    for row in range(1, factor):
        sums += rows[:, row]
    squares = sums[:, : width * factor].reshape(height, width, factor, -1)
    means: Pixels = (squares.sum(2) / factor**2).astype(np.float32)
    return means


def report_missing(missing: Sequence[Path], listed: int, source: Path) -> None:
    """Warn of images that are not there."""
    if not missing:
        return
    got = (
        f"{len(missing)} of {listed} images missing"
        f" ({missing[0].name}{', ...' if len(missing) > 1 else ''})"
    )
    if len(missing) > MOST_MISSING * listed:
        do = f"put them there, {missing[0]} for instance, or take them off the list"
        raise DatasetError.of(str(source), "the images that it lists", got, do)
    warnings.warn(
        f"{source}: {got}; going on without them", DatasetWarning, stacklevel=4
    )


def report_frames(frames: Sequence[Frame], source: Path) -> None:
    """Warn of images that are not read as a reader of the set would think."""
    small = sorted(
        {frame.path.parent.name for frame in frames if is_smaller(frame.path)}
    )
    if small:
        text = f"{source}: no images/, so the smaller ones in {small[0]} are used"
        warnings.warn(text, DatasetWarning, stacklevel=4)


def held_out(items: Sequence[Item], split: Split | None, every: int) -> list[Item]:
    """The part of a set without a split of its own: each `every`-th item for tests, the
    first included.
    """
    if split is None:
        return list(items)
    return [
        item
        for i, item in enumerate(items)
        if (i % every == 0 and len(items) > 1) == (split == "test")
    ]


def refuse_doubles(names: Iterable[str], source: Path) -> None:
    """Raise if a name comes twice."""
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise DatasetError.of(
                str(source),
                "every image once",
                f"{name} twice",
                "remove one of the two",
            )
        seen.add(name)
