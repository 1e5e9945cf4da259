"""What every format comes down to: cameras with the files of their pictures."""

import os
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.cameras import Camera
from mi_splat.datasets.distortion import Intrinsics, pinhole
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.picture_files import lies_on_its_side, load_picture, picture_header


class DatasetError(MiSplatError):
    """A set of pictures cannot be read or written; the message names the file and says what to do."""


class DatasetWarning(UserWarning):
    """A set of pictures is read, but without something that it lists."""


SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".PNG", ".JPG", ".JPEG")
"""What is appended, in this order, to the name of a picture that has no suffix."""

_MODES = ("1", "L", "LA", "La", "P", "PA", "RGB", "RGBA", "RGBa", "RGBX", "CMYK", "YCbCr", "HSV", "LAB")

Pixels = NDArray[np.float32]


def picture_size(path: Path, claimed: tuple[int, int] | None = None) -> tuple[int, int]:
    """Width and height of a picture, read off its header."""
    size, mode = picture_header(path)
    if mode not in _MODES:
        raise DatasetError.of(str(path), "8 bits a channel", f"mode {mode}", "convert it to 8 bits")
    if claimed is not None and size != claimed:
        got, do = f"{size[0]} x {size[1]}", "use the pictures from which the cameras were made"
        raise DatasetError.of(str(path), f"{claimed[0]} x {claimed[1]} pixels", got, do)
    return size


def read_picture(
    path: Path, *, downscale: int, background: tuple[float, float, float], upright: bool = False
) -> tuple[Tensor, Tensor | None]:
    """A picture over a background, and its alpha."""
    picture = load_picture(path, upright=upright)
    has_alpha = "A" in picture.mode or "a" in picture.mode or "transparency" in picture.info
    values = np.asarray(picture.convert("RGBA" if has_alpha else "RGB"), np.float32) / np.float32(255)
    if not has_alpha:
        return torch.from_numpy(area_mean(values, downscale)), None
    alpha = values[..., 3:]
    blended = values[..., :3] * alpha + np.asarray(background, np.float32) * (1 - alpha)
    return torch.from_numpy(area_mean(blended, downscale)), torch.from_numpy(area_mean(alpha, downscale)[..., 0])


def read_mask(path: Path, *, downscale: int) -> Tensor:
    """(H, W) float32 mask in [0, 1] from a picture in its grey values."""
    values = np.asarray(load_picture(path).convert("L"), np.float32)[..., None] / np.float32(255)
    return torch.from_numpy(area_mean(values, downscale)[..., 0])


def area_mean(values: Pixels, factor: int) -> Pixels:
    """(H // factor, W // factor, C) means over squares of pixels; a rest at the right and at the bottom is cut off."""
    if factor == 1:
        return np.ascontiguousarray(values)
    height, width = values.shape[0] // factor, values.shape[1] // factor
    squares = values[: height * factor, : width * factor].reshape(height, factor, width, factor, -1)
    means: Pixels = squares.mean((1, 3), dtype=np.float64).astype(np.float32)
    return means


Split = Literal["train", "test"]
HELD_OUT = 8
"""Where a format has no split of its own, pictures in the order of names are for tests at multiples of this index."""

MOST_MISSING = 1 / 3
"""Share of the pictures that a set lists and does not have, above which it is refused."""

_FOLDERS = ("images", "masks")
_LONGEST_NAME = 255

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Frame:
    """One picture of a set."""

    camera: Camera  # the pinhole camera, at the picture's full size
    path: Path
    mask: Path | None = None  # a grey picture of the same size that is white where the picture counts
    lens: Intrinsics | None = None  # of the picture in the file; None if they are the camera's
    upright: bool = False  # whether the picture is turned as its EXIF orientation says
    shrunk: int = 1  # by what the picture in the file is smaller already


class Photograph(NamedTuple):
    """The files of a picture, and what is known of it without decoding it.

    `size` is that of which the set speaks, `stored` that of the file, which is smaller in a folder images_2.
    """

    path: Path
    mask: Path | None
    size: tuple[int, int]
    stored: tuple[int, int]
    upright: bool = False

    def frame(self, pose: Tensor, intrinsics: Intrinsics, shrunk: int, where: str) -> Frame:
        """The frame of a camera with this picture."""
        lens = intrinsics if self.stored == self.size else intrinsics.resized(self.stored)
        return Frame(
            camera=pinhole_camera(pose, lens, where),
            path=self.path,
            mask=self.mask,
            lens=None if lens.is_pinhole else lens,
            upright=self.upright,
            shrunk=1 if self.stored == self.size else shrunk,
        )


def pinhole_camera(pose: Tensor, lens: Intrinsics, where: str) -> Camera:
    """The camera that sees what a photograph shows, without its distortion."""
    try:
        lens = pinhole(lens)
        width, height = lens.size
        return Camera(to_world=pose, focal=lens.focal, width=width, height=height, principal=lens.principal)
    except InvalidValueError as error:
        raise DatasetError(f"{where}: {error}") from error


def photograph(picture: Path, mask: Path | None, claimed: tuple[int, int] | None, shrunk: int) -> Photograph | None:
    """A picture with its mask, both from folders of smaller ones if there are such; None if there is no picture."""
    small, small_mask = (_smaller(file, shrunk) if file and shrunk > 1 else None for file in (picture, mask))
    if small is not None and (mask is None or small_mask is not None):
        whole = claimed or (picture_size(picture) if picture.is_file() else None)
        return _small_photograph(small, small_mask, whole, shrunk)
    if not picture.is_file():
        return None
    stored = picture_size(picture)
    upright = claimed is not None and claimed != stored and claimed == stored[::-1] and lies_on_its_side(picture)
    size = stored[::-1] if upright else picture_size(picture, claimed)
    if mask is not None:
        picture_size(mask, size)
    return Photograph(picture, mask, size, size, upright)


def _small_photograph(path: Path, mask: Path | None, size: tuple[int, int] | None, shrunk: int) -> Photograph:
    stored = picture_size(path)
    size = size or (stored[0] * shrunk, stored[1] * shrunk)
    if any(abs(side - whole / shrunk) >= 1 for side, whole in zip(stored, size, strict=True)):
        expected = f"{size[0] / shrunk:g} x {size[1] / shrunk:g} pixels, rounded"
        do = f"make the smaller pictures again, or remove their folder; {path.parent.name} is used for that downscale"
        raise DatasetError.of(str(path), expected, f"{stored[0]} x {stored[1]}", do)
    if mask is not None:
        picture_size(mask, stored)
    return Photograph(path, mask, size, stored)


def _smaller(file: Path, factor: int) -> Path | None:
    """The same file in a folder images_2 in place of images, if there is one."""
    for folder in file.parents[:3]:
        if folder.name in _FOLDERS:
            small = find_picture(folder.with_name(f"{folder.name}_{factor}") / file.relative_to(folder))
            return small if small.is_file() else None
    return None


def within(folder: Path, name: str, source: str, *, above: int = 0) -> Path:
    """A file that a set names, which has to lie in the set."""
    relative = os.path.relpath(name, os.path.abspath(folder)) if os.path.isabs(name) else os.path.normpath(name)
    parts = Path(relative).parts
    if parts[: above + 1] == ("..",) * (above + 1):
        do = "put the set's files into its folder, and name them from there"
        raise DatasetError.of(source, "the name of a file in the set", repr(name[:80]), do)
    if any(len(part.encode("utf-8", "replace")) > _LONGEST_NAME for part in parts) or len(name) > 4 * _LONGEST_NAME:
        got, do = f"one of {len(name)} characters", "repair it"
        raise DatasetError.of(source, f"the name of a file, parts up to {_LONGEST_NAME} bytes", got, do)
    return folder / name


def report_missing(missing: Sequence[Path], listed: int, source: Path) -> None:
    """Warn of pictures that are not there."""
    if not missing:
        return
    got = f"{len(missing)} of {listed} pictures missing ({missing[0].name}{', ...' if len(missing) > 1 else ''})"
    if len(missing) > MOST_MISSING * listed:
        do = f"put them there, {missing[0]} for instance, or take them off the list"
        raise DatasetError.of(str(source), "the pictures that it lists", got, do)
    warnings.warn(f"{source}: {got}; going on without them", DatasetWarning, stacklevel=4)


def downscaled(camera: Camera, factor: int) -> Camera:
    """The camera of a picture that was made smaller by an integer factor; a rest of the size is cut off."""
    if factor == 1:
        return camera
    return Camera(
        to_world=camera.to_world,
        focal=(camera.fx / factor, camera.fy / factor),
        width=camera.width // factor,
        height=camera.height // factor,
        principal=(camera.cx / factor, camera.cy / factor),
    )


def find_picture(path: Path) -> Path:
    """The picture called `path`, whose name may lack its suffix; `path` itself if there is none."""
    if path.is_file():
        return path
    candidates = (path.with_name(path.name + suffix) for suffix in SUFFIXES)
    return next((candidate for candidate in candidates if candidate.is_file()), path)


def find_mask(folder: Path, name: Path) -> Path | None:
    """The mask of a picture in a folder: under the picture's name, or that with .png appended or as its suffix."""
    if name.is_absolute() or ".." in name.parts:  # which would lead out of the folder, perhaps to the picture itself
        name = Path(name.name)
    names = (name, name.with_name(f"{name.name}.png"), name.with_suffix(".png"))
    return next((folder / candidate for candidate in names if (folder / candidate).is_file()), None)


def held_out(items: Sequence[Item], split: Split | None, every: int) -> list[Item]:
    """The part of a set without a split of its own: each `every`-th item for tests, the first included."""
    if split is None:
        return list(items)
    return [item for i, item in enumerate(items) if (i % every == 0 and len(items) > 1) == (split == "test")]


def refuse_doubles(names: Iterable[str], source: Path) -> None:
    """Raise if a name comes twice."""
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise DatasetError.of(str(source), "every picture once", f"{name} twice", "remove one of the two")
        seen.add(name)
