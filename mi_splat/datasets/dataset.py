"""Sets of images with cameras, read an image at a time."""

from __future__ import annotations

import dataclasses
import operator
import os
import warnings
from collections import OrderedDict
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, overload

import numpy as np
import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera, View, ViewSet, odd_fields_of_view
from mi_splat.datasets.colmap import find_model, read_colmap
from mi_splat.datasets.errors import DatasetError, DatasetWarning
from mi_splat.datasets.frames import (
    HELD_OUT,
    Frame,
    Pixels,
    Split,
    area_mean,
    picture_size,
    resized_plane,
    stored_mask,
    stored_pixels,
    turned_image,
)
from mi_splat.datasets.lenses import pinhole, undistorted
from mi_splat.datasets.packed import Packed
from mi_splat.datasets.transforms import PARTS, SINGLE, find_transforms, read_transforms
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import sha256
from mi_splat.io.errors import folder_advice
from mi_splat.io.points import PointCloud
from mi_splat.io.up_axis import UpAxis, Z, cameras_up

CACHE_BYTES = 256 << 20
"""How much of a set a `Dataset` keeps in memory unless told otherwise."""


class _Entry(NamedTuple):
    """One image in memory, and (H, W) alpha and mask if it has them."""

    image: Packed
    alpha: Packed | None
    mask: Packed | None

    @property
    def bytes(self) -> int:
        """Memory that it takes."""
        planes = [
            plane for plane in (self.image, self.alpha, self.mask) if plane is not None
        ]
        return sum(plane.bytes for plane in planes)


@dataclass(frozen=True, slots=True, eq=False, repr=False, kw_only=True)
class Dataset(ViewSet):
    """Views whose images are read when they are asked for; the last ones read are
    kept, those of 8 bits as bytes.
    """

    frames: tuple[Frame, ...]  # cameras with the files of their images
    # points from which a training may start; None if the set has none
    points: PointCloud | None = None
    # every image that the set's files name, there or not
    listed: frozenset[Path] = frozenset()
    downscale: int = 1  # integer factor by which images are made smaller
    # sRGB colour behind transparent pixels
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    cache_bytes: int = CACHE_BYTES  # how much is kept in memory
    # the camera of each view, at the size of its image
    cameras: tuple[Camera, ...] = field(init=False)
    _cache: OrderedDict[int, _Entry] = field(
        init=False, repr=False, default_factory=OrderedDict
    )

    def __post_init__(self) -> None:
        if not (isinstance(self.downscale, int) and self.downscale >= 1):
            raise InvalidValueError.of(
                "downscale", "a positive integer", self.downscale, "1 keeps the size"
            )
        if len(self.background) != 3 or not all(
            0 <= value <= 1 for value in self.background
        ):
            do = "white is (1, 1, 1)"
            raise InvalidValueError.of(
                "background", "three sRGB values in [0, 1]", self.background, do
            )
        cameras = tuple(
            frame.camera.downscaled(self.downscale) for frame in self.frames
        )
        object.__setattr__(self, "cameras", cameras)

    @property
    def paths(self) -> tuple[Path, ...]:
        """The file of each view's image."""
        return tuple(frame.path for frame in self.frames)

    @property
    def up(self) -> UpAxis:
        """The direction that is up in the set's world: as its cameras stand, else z."""
        poses = [camera.to_world[:3, :3].numpy() for camera in self.cameras]
        stood = cameras_up(np.array(poses)) if len(poses) > 1 else None
        if stood is None:
            return UpAxis(Z, "its cameras do not tell")
        return UpAxis(stood, "as the cameras stand")

    @property
    def fingerprint(self) -> str:
        """What tells this set from others: the bytes of its images and masks, and how
        they are read.
        """
        images = [_digest(path) for path in self.paths]
        masks = [
            None if frame.mask is None else _digest(frame.mask) for frame in self.frames
        ]
        changed = [
            (frame.lens, frame.turns_before, frame.turns_after)
            for frame in self.frames
            if not frame.is_stored
        ]
        more = ([masks] if any(masks) else []) + ([changed] if changed else [])
        return repr((images, self.downscale, self.background, *more))

    def __len__(self) -> int:
        """Number of views."""
        return len(self.frames)

    @overload
    def __getitem__(self, index: int) -> View: ...

    @overload
    def __getitem__(self, index: slice) -> Dataset: ...

    def __getitem__(self, index: int | slice) -> View | Dataset:
        """A view, or the set of some of them."""
        if isinstance(index, slice):
            return dataclasses.replace(self, frames=self.frames[index])
        return View(self.cameras[index], self._read(index).image.unpack())

    def without(self, paths: Collection[Path]) -> Dataset:
        """The set without the views of some files; those of other sets are ignored."""
        left = frozenset(paths)
        frames = tuple(frame for frame in self.frames if frame.path not in left)
        return dataclasses.replace(self, frames=frames)

    def alpha(self, index: int) -> Tensor | None:
        """(H, W) float32 in [0, 1], opacity of the image; None if it has none."""
        alpha = self._read(index).alpha
        if alpha is None:
            return None
        return alpha.unpack()

    def loss_mask(self, index: int) -> Tensor | None:
        """(H, W) float32 in [0, 1], 1 where the image counts in a loss; None if all of
        it does.

        It is 0 where the set's mask is black, and where an image that was undistorted
        shows nothing.
        """
        frame = self.frames[range(len(self.frames))[operator.index(index)]]
        if frame.mask is None and frame.lens is None:
            return None
        mask = self._read(index).mask
        if mask is None:
            return None
        return mask.unpack()

    def region(self, index: int, drawn: Pixels) -> Tensor:
        """(H, W) float32 in [0, 1], a region that was drawn on the file of an image, as
        the image is read: turned, undistorted and made smaller with it.

        Args:
            index: Which image.
            drawn: (h, w) in [0, 1], of the size of the file, or of that size made
                larger or smaller.

        Returns:
            The region at the size of the view's camera; 0 where an image that was
            undistorted shows nothing.
        """
        frame = self.frames[range(len(self.frames))[operator.index(index)]]
        size = picture_size(frame.path)
        if drawn.shape[1::-1] != size:
            drawn = resized_plane(drawn, size)
        plane = np.ascontiguousarray(drawn, np.float32)[..., None]
        if not frame.is_stored:
            _, _, mask = _upright(frame, plane.repeat(3, -1), None, plane)
            assert mask is not None
            plane = mask
        return torch.from_numpy(area_mean(plane, self.downscale)[..., 0].copy())

    def _read(self, index: int) -> _Entry:
        """An image with its alpha and its mask, from memory or from the disk."""
        index = range(len(self.frames))[operator.index(index)]
        if index in self._cache:
            self._cache.move_to_end(index)
            return self._cache[index]
        entry = self._cache[index] = self._load(index)
        held = sum(other.bytes for other in self._cache.values())
        while held > self.cache_bytes and len(self._cache) > 1:
            _, oldest = self._cache.popitem(last=False)
            held -= oldest.bytes
        return entry

    def _load(self, index: int) -> _Entry:
        """An image with its alpha and its mask from the disk."""
        frame = self.frames[index]
        camera = self.cameras[index]
        image, alpha = stored_pixels(frame.path, self.background)
        mask = None
        if frame.mask is not None:
            height, width, _ = image.shape
            mask = stored_mask(frame.mask, frame.path, (width, height))
        if not frame.is_stored:
            image, alpha, mask = _upright(frame, image, alpha, mask)
        image = area_mean(image, self.downscale)
        if tuple(image.shape[:2]) != (camera.height, camera.width):
            got = tuple(image.shape[:2])
            do = "it has changed: load the set again"
            raise DatasetError.of(
                str(frame.path),
                f"{(camera.height, camera.width)} rows and columns",
                got,
                do,
            )
        planes = [
            (
                None
                if plane is None
                else Packed.of(
                    torch.from_numpy(area_mean(plane, self.downscale)[..., 0])
                )
            )
            for plane in (alpha, mask)
        ]
        return _Entry(Packed.of(torch.from_numpy(image)), *planes)


def _upright(
    frame: Frame, image: Pixels, alpha: Pixels | None, mask: Pixels | None
) -> tuple[Pixels, Pixels | None, Pixels | None]:
    """The image of a frame's camera with its alpha and its mask, out of those in the
    files.
    """
    planes = [image, *(plane for plane in (alpha, mask) if plane is not None)]
    together = turned_image(np.concatenate(planes, -1), frame.turns_before)
    shown = None
    if frame.lens is not None:
        if together.shape[1::-1] != frame.lens.size:
            got = together.shape[:2]
            do = "it has changed: load the set again"
            expected = f"{frame.lens.size[::-1]} rows and columns"
            raise DatasetError.of(str(frame.path), expected, got, do)
        together, seen = undistorted(
            np.ascontiguousarray(together), frame.lens, pinhole(frame.lens)
        )
        if not seen.all():
            shown = turned_image(seen[..., None].astype(np.float32), frame.turns_after)
    together = turned_image(together, frame.turns_after)
    image = together[..., :3]
    alpha = None if alpha is None else together[..., 3:4]
    mask = None if mask is None else together[..., -1:]
    if shown is not None:
        mask = shown if mask is None else mask * shown
    return image, alpha, mask


def _digest(file: Path) -> str:
    try:
        return sha256(file)
    except OSError as error:
        got = error.strerror or str(error)
        raise DatasetError.of(
            str(file), "the file of an image", got, "load the set again"
        ) from error


def load_dataset(
    path: str | os.PathLike[str],
    *,
    split: Split | None = "train",
    downscale: int = 1,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    test_every: int = HELD_OUT,
    cache_bytes: int = CACHE_BYTES,
) -> Dataset:
    """Load a set of images with cameras: Blender, NeRF and nerfstudio transforms, or
    a COLMAP model.

    The format is found by itself: transforms_train.json and transforms_test.json, or
    transforms.json, or a COLMAP model in sparse/0, in sparse or in the folder itself,
    with images in images/. The world stays as it is in the files. Headers of all
    images are read, and what does not fit is refused now; pixels are read later.
    Images that are listed and not there are left out, with a `DatasetWarning`.

    Images of lenses with distortion are undistorted as they are read
    (`mi_splat.datasets.lenses`), and images that EXIF says to turn are turned, each
    with its camera and its mask. Masks are those that frames name (`mask_path`), or
    that lie in masks/ under the name of the image with .png appended, the same name, or
    the same stem; see `Dataset.loss_mask`. Where the set has no images/, those of
    images_2, images_4 or images_8 are read, and intrinsics are scaled to them.

    Args:
        path: The folder, or a transforms file.
        split: "train" or "test"; None is both. Where the set has no split, every
            `test_every`-th image in the order of names, the first included, is for
            tests, unless it is the only one; "test" may then be empty.
        downscale: Integer factor by which images and intrinsics shrink; pixels are
            averaged.
        background: sRGB colour behind transparent pixels.
        test_every: See `split`.
        cache_bytes: How much of the set may stay in memory.

    Returns:
        The views, whose images are read when they are needed, and the points of
        the set if it has some.

    Raises:
        DatasetError: The set is of neither kind, empty, or something in it is broken or
            cannot be undistorted, or more than a third of the images are missing.
        PictureFileError: An image cannot be read.
        SplatFileError: The point cloud beside transforms cannot be read.
        InvalidValueError: An argument is out of range.
    """
    if split not in ("train", "test", None):
        raise InvalidValueError.of(
            "split", "'train', 'test' or None", repr(split), "pass one of these"
        )
    if test_every < 2:
        raise InvalidValueError.of("test_every", "2 or more", test_every, "8 is usual")
    root = Path(path)
    transforms = find_transforms(root)
    model = None if transforms else find_model(root)
    if transforms:
        found = read_transforms(transforms, split, test_every)
    elif model:
        found = read_colmap(root, model, split, test_every)
    else:
        expected = (
            "transforms.json, transforms_train.json or a COLMAP model in sparse/0"
        )
        got = "none of these" if root.is_dir() else "no such folder"
        raise DatasetError.of(
            str(root),
            expected,
            got,
            folder_advice(root, "pass the folder of a data set"),
        )
    frames = tuple(found.frames)
    if not frames and split != "test":
        do = "choose another split or test_every"
        raise DatasetError.of(
            str(root), "at least one image", f"none for split {split!r}", do
        )
    odd = odd_fields_of_view([frame.camera for frame in frames])
    if odd is not None:
        warnings.warn(f"{root}: {odd}", DatasetWarning, stacklevel=2)
    return Dataset(
        frames=frames,
        points=found.points,
        listed=found.listed,
        downscale=downscale,
        background=background,
        cache_bytes=cache_bytes,
    )


def is_dataset(path: str | os.PathLike[str]) -> bool:
    """Whether a path is a set of images to `load_dataset`, and no splat: a folder of
    one, or its transforms file.
    """
    root = Path(path)
    if root.is_dir():
        return find_transforms(root) is not None or find_model(root) is not None
    return root.name in (SINGLE, *PARTS.values())
