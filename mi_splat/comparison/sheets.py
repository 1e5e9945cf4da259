"""Pictures of a comparison: the methods side by side, and below them where each two differ."""

from collections.abc import Mapping
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from torch import Tensor

from mi_splat.io.documents import file_name, save_png
from mi_splat.io.images import to_bytes
from mi_splat.labels import write_label

WIDTH = 256
"""Pixels that a picture is wide on a sheet, at least."""
GAP = 4
PICTURES = "pictures"
"""Folder that has a folder for each method, whose pictures can be compared again."""


def sheet(pictures: Mapping[str, Tensor], *, factor: float) -> NDArray[np.uint8]:
    """The pictures of one camera: the methods, and after them the absolute differences of each two."""
    tiles = [_labelled(to_bytes(picture), name) for name, picture in pictures.items()]
    for (first_name, first), (second_name, second) in combinations(pictures.items(), 2):
        gap = (first.clamp(0, 1) - second.clamp(0, 1)).abs()
        tiles.append(_labelled(to_bytes(factor * gap), f"|{first_name} - {second_name}| x {factor:g}"))
    columns = max(3, len(pictures))  # of two, the difference stands beside them
    height, width = tiles[0].shape[:2]
    rows = -(-len(tiles) // columns)
    canvas = np.full((rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), 255, np.uint8)
    for number, tile in enumerate(tiles):
        y, x = number // columns * (height + GAP), number % columns * (width + GAP)
        canvas[y : y + height, x : x + width] = tile
    return canvas


def _labelled(pixels: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    """A picture, large enough for its label, with the label."""
    factor = max(1, -(-WIDTH // pixels.shape[1]))
    picture = Image.fromarray(pixels)
    picture = picture.resize((picture.width * factor, picture.height * factor), Image.Resampling.NEAREST)
    write_label(ImageDraw.Draw(picture), (4, 4), text, "#000000", size=14)
    return np.asarray(picture)


def save_sheets(pictures: Mapping[str, Mapping[str, Tensor]], folder: Path, *, factor: float) -> list[Path]:
    """Write a sheet for each camera, and each picture on its own."""
    sheets = []
    for view, seen in pictures.items():
        sheets.append(folder / f"{file_name(view)}.png")
        save_png(sheet(seen, factor=factor), sheets[-1])
        for name, picture in seen.items():
            pictures_folder = folder / PICTURES / file_name(name)
            pictures_folder.mkdir(parents=True, exist_ok=True)
            save_png(to_bytes(picture), pictures_folder / f"{file_name(view)}.png")
    return sheets
