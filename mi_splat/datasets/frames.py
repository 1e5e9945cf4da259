"""What every format comes down to: cameras with the files of their pictures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

from mi_splat.cameras import Camera
from mi_splat.datasets.errors import DatasetError
from mi_splat.datasets.pictures import SUFFIXES, picture_size
from mi_splat.errors import message

Split = Literal["train", "test"]
HELD_OUT = 8
"""Where a format has no split of its own, pictures in the order of names are for tests at multiples of this index."""

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Frame:
    """One picture of a set.

    Attributes:
        camera: The camera, at the picture's full size.
        path: The picture.
        mask: A grey picture of the same size that is white where the picture counts; None if there is none.
    """

    camera: Camera
    path: Path
    mask: Path | None = None


def downscaled(camera: Camera, factor: int) -> Camera:
    """The camera of a picture that was made smaller by an integer factor; a rest of the size is cut off.

    Raises:
        InvalidValueError: Nothing is left of the picture.
    """
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


def find_mask(folder: Path, name: Path, size: tuple[int, int]) -> Path | None:
    """The mask of a picture in a folder: under the picture's name, or that with .png appended or as its suffix.

    Raises:
        DatasetError: The mask does not have the size of the picture.
    """
    if name.is_absolute() or ".." in name.parts:  # which would lead out of the folder, perhaps to the picture itself
        name = Path(name.name)
    names = (name, name.with_name(f"{name.name}.png"), name.with_suffix(".png"))
    mask = next((folder / candidate for candidate in names if (folder / candidate).is_file()), None)
    if mask is not None:
        picture_size(mask, size)
    return mask


def held_out(items: Sequence[Item], split: Split | None, every: int) -> list[Item]:
    """The part of a set without a split of its own: each `every`-th item for tests, the first included."""
    if split is None:
        return list(items)
    return [item for i, item in enumerate(items) if (i % every == 0) == (split == "test")]


def refuse_doubles(names: Iterable[str], source: Path) -> None:
    """Raise if a name comes twice.

    Raises:
        DatasetError: It does.
    """
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise DatasetError(message(str(source), "every picture once", f"{name} twice", "remove one of the two"))
        seen.add(name)
