"""The images in which `Selection` looks for an object: the photographs of a set, or
renderings of the splat from other cameras; and what is found there.
"""

from __future__ import annotations

import dataclasses
import warnings
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.cameras.camera import Camera, RenderFn
from mi_splat.datasets import Dataset, DatasetError, DatasetWarning, load_dataset
from mi_splat.datasets.folders import SetFiles
from mi_splat.datasets.frames import (
    Split,
    check_mask,
    photo_of,
    picture_size,
    quarter_turns,
    resized_plane,
    turned_image,
)
from mi_splat.errors import InvalidValueError
from mi_splat.io.camera_records import OF
from mi_splat.io.picture_files import load_picture
from mi_splat.render.scene_files import resized
from mi_splat.scene import GaussianScene
from mi_splat.selection.agreement import LEAST_FIT, box_fit
from mi_splat.selection.boxes import DrawnBox, load_boxes, of_image
from mi_splat.selection.config import Selection
from mi_splat.selection.outlines import BoxedImage, outlines_in_boxes
from mi_splat.selection.regions import ImageRegion, require_regions, vote

LONGEST_SIDE = 480
"""Pixels of the longer side of images: about as many as networks look at."""
MOST_IMAGES = 32
"""Images that are looked at, evenly chosen: more say little that is new."""

FindBoxes = Callable[[Tensor, Sequence[str]], list[Tensor]]
"""(H, W, 3) sRGB in [0, 1] and names of classes to the boxes of these classes in it:
(K, 4) pixels of each detector, the most confident first.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceImage:
    """An image from a camera of which the pose is known."""

    name: str
    camera: Camera

    @abstractmethod
    def pixels(self) -> Tensor:
        """(H, W, 3) sRGB in [0, 1]."""

    @abstractmethod
    def size(self) -> tuple[int, int]:
        """Width and height of the image as its file holds it."""

    @abstractmethod
    def region(self, drawn: NDArray[np.float32]) -> Tensor:
        """(H, W) in [0, 1], what was drawn on the image as its file holds it."""

    @abstractmethod
    def mask(self, folder: Path) -> NDArray[np.float32] | None:
        """(h, w) zeros and ones, the mask of the image in a folder; None if there is
        none.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class Photograph(SourceImage):
    """A photograph of a set, undistorted and upright."""

    views: Dataset
    index: int

    def pixels(self) -> Tensor:
        """(H, W, 3) sRGB in [0, 1]."""
        return self.views[self.index].image.clamp(0, 1)

    def size(self) -> tuple[int, int]:
        """Width and height of the photograph as its file holds it."""
        return picture_size(self.path)

    @property
    def path(self) -> Path:
        """Its file."""
        return self.views.paths[self.index]

    def region(self, drawn: NDArray[np.float32]) -> Tensor:
        """(H, W) in [0, 1], what was drawn on the file of the photograph."""
        return self.views.region(self.index, drawn)

    def mask(self, folder: Path) -> NDArray[np.float32] | None:
        """(h, w) zeros and ones, the mask of the photograph in a folder."""
        path = SetFiles(folder).mask([folder], self.path.name)
        if path is None:
            return None
        check_mask(path, photo_of(self.path, None))
        mask = _nonzero(path)
        turns = quarter_turns(self.path)
        width, height = self.size()
        is_upright = (mask.shape[1] > mask.shape[0]) != (width > height)
        if turns % 2 and is_upright:  # drawn on the upright photograph
            mask = np.ascontiguousarray(turned_image(mask, -turns))
        return mask


@dataclass(frozen=True, slots=True, kw_only=True)
class Rendering(SourceImage):
    """A rendering of a splat."""

    scene: GaussianScene
    render: RenderFn

    def pixels(self) -> Tensor:
        """(H, W, 3) sRGB in [0, 1]."""
        with torch.no_grad():
            return self.render(self.scene, self.camera)[..., :3].clamp(0, 1).cpu()

    def size(self) -> tuple[int, int]:
        """Width and height of the rendering."""
        return self.camera.width, self.camera.height

    def region(self, drawn: NDArray[np.float32]) -> Tensor:
        """(H, W) in [0, 1], what was drawn on the rendering, at whatever size."""
        return torch.from_numpy(resized_plane(drawn, self.size()).copy())

    def mask(self, folder: Path) -> NDArray[np.float32] | None:
        """(h, w) zeros and ones, the mask with the name of the camera in a folder."""
        path = SetFiles(folder).mask([folder], self.name)
        if path is None:
            return None
        return _nonzero(path)


def _nonzero(path: Path) -> NDArray[np.float32]:
    return (np.asarray(load_picture(path).convert("L")) > 0).astype(np.float32)


def photographs(
    views: Dataset, *, most: int = MOST_IMAGES, longest: int = LONGEST_SIDE
) -> list[SourceImage]:
    """The photographs of a set, evenly chosen, and no larger than detectors need."""
    side = max(max(camera.width, camera.height) for camera in views.cameras)
    factor = max(1, round(side / longest))
    small = dataclasses.replace(views, downscale=factor * views.downscale)
    return [
        Photograph(
            name=small.paths[index].stem,
            camera=small.cameras[index],
            views=small,
            index=index,
        )
        for index in _evenly(len(small), most)
    ]


def renderings(
    scene: GaussianScene, cameras: Mapping[str, Camera], render: RenderFn
) -> list[SourceImage]:
    """Renderings of a splat from cameras, evenly chosen, no larger than detectors
    need.
    """
    names = list(cameras)
    return [
        Rendering(
            name=names[index],
            camera=_small(cameras[names[index]]),
            scene=scene,
            render=render,
        )
        for index in _evenly(len(names), MOST_IMAGES)
    ]


def source_images(
    scene: GaussianScene,
    cameras: Mapping[str, Camera],
    texts: Sequence[str],
    *,
    render: RenderFn,
    split: Split | None,
) -> list[SourceImage]:
    """The images of the cameras that `--cameras` names: photographs where all of it are
    folders of photographs that can be read, else renderings.
    """
    sets = [_photographs_of(text, split) for text in texts]
    if sets and all(item is not None for item in sets):
        return [image for item in sets if item is not None for image in item]
    return renderings(scene, cameras, render)


def _photographs_of(text: str, split: Split | None) -> list[SourceImage] | None:
    folder, mark, name = text.rpartition(OF)
    if not mark or Path(text).exists():
        folder = text
        name = ""
    if not Path(folder).is_dir():
        return None
    try:
        with warnings.catch_warnings():
            # of missing images the cameras have told already
            warnings.simplefilter("ignore", DatasetWarning)
            found = photographs(load_dataset(folder, split=split))
    except DatasetError:  # poses without photographs
        return None
    return [image for image in found if not name or image.name == name]


def _small(camera: Camera) -> Camera:
    factor = LONGEST_SIDE / max(camera.width, camera.height)
    if factor >= 1:
        return camera
    size = (round(camera.width * factor), round(camera.height * factor))
    return resized(camera, size)


def _evenly(count: int, most: int) -> list[int]:
    if count <= most:
        return list(range(count))
    return [number * count // most for number in range(most)]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """What images say of an object: its Gaussians, and where it is in each image."""

    mask: Tensor  # (N,) bool
    regions: Mapping[str, ImageRegion]
    lines: tuple[str, ...] = ()  # of what was found in how many images
    doubts: tuple[str, ...] = ()  # reasons to look twice at it


def find_in_images(
    scene: GaussianScene,
    images: Sequence[SourceImage],
    selection: Selection,
    *,
    render: RenderFn,
    find_boxes: FindBoxes | None = None,
) -> Found:
    """The Gaussians that all of detections, boxes and masks select in images."""
    found = []
    if selection.detect:
        found.append(_detected(scene, images, selection, render, find_boxes))
    if selection.boxes is not None:
        found.append(_boxed(scene, images, selection.boxes, render))
    if selection.masks is not None:
        found.append(_masked(scene, images, selection.masks, render))
    mask = torch.ones(len(scene), dtype=torch.bool)
    regions = dict[str, ImageRegion]()
    for part in found:
        mask &= part.mask
        regions |= part.regions
    return Found(
        mask=mask,
        regions=regions,
        lines=tuple(line for part in found for line in part.lines),
        doubts=tuple(text for part in found for text in part.doubts),
    )


def _detected(
    scene: GaussianScene,
    images: Sequence[SourceImage],
    selection: Selection,
    render: RenderFn,
    find_boxes: FindBoxes | None,
) -> Found:
    if find_boxes is None:
        raise InvalidValueError.of(
            "detect", "detectors that find the object", "none", "name them"
        ).hinted("--detectors")
    boxed = dict[str, BoxedImage]()
    for image in images:
        pixels = image.pixels()
        for number, boxes in enumerate(find_boxes(pixels, selection.detect)):
            if len(boxes):
                boxed[f"{image.name} {number}"] = BoxedImage(
                    camera=image.camera, image=pixels, boxes=boxes
                )
    classes = " or ".join(selection.detect)
    require_regions(len(boxed), f"detections of {classes} in {len(images)} images")
    return _cut_out(scene, boxed, render, f"boxes of {classes}", len(images))


def _boxed(
    scene: GaussianScene, images: Sequence[SourceImage], path: Path, render: RenderFn
) -> Found:
    drawn = load_boxes(path)
    if drawn.cameras:
        images = renderings(scene, drawn.cameras, render)
    boxed = dict[str, BoxedImage]()
    for image in images:
        for number, item in enumerate(of_image(drawn.boxes, image.name)):
            box = _as_read(item, image)
            boxed[f"{image.name} {number}"] = BoxedImage(
                camera=image.camera, image=image.pixels(), boxes=torch.tensor([box])
            )
    require_regions(len(boxed), f"boxes in {path} of {len(images)} images")
    return _cut_out(scene, boxed, render, f"boxes of {path}", len(images))


def _as_read(item: DrawnBox, image: SourceImage) -> list[float]:
    """A box that was drawn on the file of an image, in the image as it is read."""
    width, height = image.size()
    across, down = item.size or image.size()
    x0, x1 = (_within(value * width / across, width) for value in item.box[::2])
    y0, y1 = (_within(value * height / down, height) for value in item.box[1::2])
    plane = np.zeros((height, width), np.float32)
    plane[y0:y1, x0:x1] = 1
    rows, columns = torch.nonzero(image.region(plane) >= 0.5, as_tuple=True)
    if not len(rows):
        raise InvalidValueError.of(
            f"box of {item.image}",
            f"a box inside {across} x {down} pixels",
            list(item.box),
            "count pixels from the upper left corner",
        )
    corners = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    return [float(value) for value in corners]


def _within(value: float, size: int) -> int:
    """A place on a side of so many pixels."""
    return min(max(round(value), 0), size)


def _cut_out(
    scene: GaussianScene,
    boxed: Mapping[str, BoxedImage],
    render: RenderFn,
    what: str,
    images: int,
) -> Found:
    mask, outlines = outlines_in_boxes(scene, list(boxed.values()), render=render)
    regions = {
        name: outline
        for name, outline in zip(boxed, outlines, strict=True)
        if outline is not None
    }
    line = f"{what}: {len(regions)} of {len(boxed)} in {images} images are one object's"
    fits = [
        box_fit(region.inside, boxed[name].boxes) for name, region in regions.items()
    ]
    doubts = []
    if median(fits) < LEAST_FIT:
        doubts.append(
            f"what is cut out of the {what} fills them poorly: intersection over union"
            f" of the boxes {median(fits):.2f} in the median; a part may be missing"
        )
    return Found(mask=mask, regions=regions, lines=(line,), doubts=tuple(doubts))


def _masked(
    scene: GaussianScene, images: Sequence[SourceImage], folder: Path, render: RenderFn
) -> Found:
    if not folder.is_dir():
        raise InvalidValueError.of(
            str(folder), "a folder of masks", "no such folder", "check the path"
        )
    regions = dict[str, ImageRegion]()
    for image in images:
        mask = image.mask(folder)
        if mask is not None:
            inside = image.region(mask)
            regions[image.name] = ImageRegion(camera=image.camera, inside=inside)
    require_regions(len(regions), f"masks in {folder}")
    chosen = vote(scene, list(regions.values()), render=render)
    line = f"masks of {len(regions)} of {len(images)} images"
    return Found(mask=chosen, regions=regions, lines=(line,))
