"""Files of boxes that somebody drew around an object in several images.

    {"boxes": [{"image": "0001.jpg", "box": [40, 32, 210, 180]}, ...]}

A box is x0, y0, x1, y1 in pixels of the image as its file holds it, from the upper left
corner; `size`, [width, height], says of which size the image was where that is another
one. With `cameras` in the file, as the viewer writes it, images are renderings from
these cameras.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mi_splat.cameras.camera import Camera
from mi_splat.errors import InvalidValueError
from mi_splat.io.camera_records import describe, recorded_cameras
from mi_splat.io.parsing import DocumentReader, Fields

PixelBox = tuple[float, float, float, float]
"""x0, y0, x1, y1 in pixels from the upper left corner of an image."""

MOST = 10_000
"""Boxes of a file."""
_MOST_PIXELS = 1 << 31
_DO = 'write {"boxes": [{"image": "0001.jpg", "box": [40, 32, 210, 180]}]}'
_READER = DocumentReader(expected="a JSON file of boxes", do=_DO)


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnBox:
    """A box around an object in one image.

    Attributes:
        image: Name of the image's file, or of its camera.
        box: x0, y0, x1, y1 in pixels.
        size: Width and height of the image that the box was drawn on; None is the
            image's own.
    """

    image: str
    box: PixelBox
    size: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnBoxes:
    """The boxes of a file.

    Attributes:
        boxes: One for each image that shows the object.
        cameras: The cameras of the images by their names; empty where the images are
            those of the command's own cameras.
    """

    boxes: tuple[DrawnBox, ...]
    cameras: Mapping[str, Camera] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """The boxes as their file has them."""
        return {
            "boxes": [_written(item) for item in self.boxes],
            "cameras": [describe(name, item) for name, item in self.cameras.items()],
        }


def load_boxes(path: Path) -> DrawnBoxes:
    """The boxes in a file.

    Args:
        path: The JSON file.

    Returns:
        Its boxes, and its cameras if it has some.

    Raises:
        InvalidValueError: The file cannot be read, or is none of boxes.
    """
    root = Fields(_READER.read_json(path), str(path), InvalidValueError, _DO)
    entries = root.objects("boxes")
    if not 1 <= len(entries) <= MOST:
        raise root.bad("boxes", f"1 to {MOST:,} boxes", len(entries))
    boxes = tuple(_drawn(entry) for entry in entries)
    cameras = recorded_cameras(path) if root.values.get("cameras") else None
    return DrawnBoxes(boxes=boxes, cameras=cameras or {})


def _drawn(entry: Fields) -> DrawnBox:
    x0, y0, x1, y1 = entry.numbers("box", 4, 4)
    if not (x0 < x1 and y0 < y1):
        raise entry.bad("box", "x0 < x1 and y0 < y1", [x0, y0, x1, y1])
    size = None
    if "size" in entry.values:
        width, height = entry.wholes("size", 1, _MOST_PIXELS, 2)
        size = (width, height)
    return DrawnBox(image=entry.text("image"), box=(x0, y0, x1, y1), size=size)


def _written(item: DrawnBox) -> dict[str, Any]:
    values: dict[str, Any] = {"image": item.image, "box": list(item.box)}
    if item.size is not None:
        values["size"] = list(item.size)
    return values


def of_image(boxes: Sequence[DrawnBox], name: str) -> list[DrawnBox]:
    """The boxes of an image, by its name with or without the ending of a file."""
    return [item for item in boxes if name in (item.image, Path(item.image).stem)]
