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
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.picture_files import load_picture, picture_header


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


def read_picture(path: Path, *, downscale: int, background: tuple[float, float, float]) -> tuple[Tensor, Tensor | None]:
    """A picture over a background, and its alpha."""
    picture = load_picture(path)
    has_alpha = "A" in picture.mode or "a" in picture.mode or "transparency" in picture.info
    values = np.asarray(picture.convert("RGBA" if has_alpha else "RGB"), np.float32) / np.float32(255)
    if not has_alpha:
        return torch.from_numpy(area_mean(values, downscale)), None
    alpha = values[..., 3:]
    blended = values[..., :3] * alpha + np.asarray(background, np.float32) * (1 - alpha)
    return torch.from_numpy(area_mean(blended, downscale)), torch.from_numpy(area_mean(alpha, downscale)[..., 0])


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

_LONGEST_NAME = 255

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Frame:
    """One picture of a set."""

    camera: Camera  # at the picture's full size
    path: Path


class Intrinsics(NamedTuple):
    """What a set says of a camera without distortion, in pixels."""

    focal: tuple[float, float]
    principal: tuple[float, float]
    size: tuple[int, int]  # width and height


UNDISTORT = "undistort the pictures first, for instance with colmap image_undistorter"
"""What to do about lenses that bend straight lines, and about panoramas."""


def camera_of(pose: Tensor, lens: Intrinsics, where: str) -> Camera:
    """The camera of a pose; errors name the place in the set."""
    width, height = lens.size
    try:
        return Camera(to_world=pose, focal=lens.focal, width=width, height=height, principal=lens.principal)
    except InvalidValueError as error:
        raise DatasetError(f"{where}: {error}") from error


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
