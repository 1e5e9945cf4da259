"""One picture of all pictures: which have a place in the world, which are held out, and which have no place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageOps

from mi_splat.io.picture_files import load_picture
from mi_splat.labels import write_label

Part = Literal["train", "test", "none"]
COLOURS: dict[Part, str] = {"train": "#000000", "test": "#1f5fbf", "none": "#c01818"}
"""Of the label, by the part of the set that a picture is in."""
MEANINGS: dict[Part, str] = {"train": "for training", "test": "held out", "none": "not placed"}
"""Of the parts, as the sheet says it."""

TILE = (192, 144)
"""Width and height of the place of a picture, pixels."""
_COLUMNS, _GAP, _HEAD, _LETTERS = 8, 4, 28, 24


@dataclass(frozen=True, slots=True, kw_only=True)
class Tile:
    """A picture of the sheet.

    Attributes:
        file: The picture.
        text: What is written on it.
        part: Of the set; "none" is grey and has a red frame.
    """

    file: Path
    text: str
    part: Part


def contact_sheet(tiles: Sequence[Tile]) -> NDArray[np.uint8]:
    """All pictures in rows, below a line that says what the colours of their labels mean.

    Args:
        tiles: At least one.

    Returns:
        (H, W, 3) sRGB bytes.

    Raises:
        PictureFileError: A picture cannot be read.
    """
    columns = min(_COLUMNS, max(4, len(tiles)))
    rows = -(-len(tiles) // columns)
    step = (TILE[0] + _GAP, TILE[1] + _GAP)
    sheet = Image.new("RGB", (columns * step[0] + _GAP, _HEAD + rows * step[1] + _GAP), "white")
    draw = ImageDraw.Draw(sheet)
    left = float(_GAP)
    for part, meaning in MEANINGS.items():
        text = f"{sum(tile.part == part for tile in tiles)} {meaning}"
        write_label(draw, (left, 4), text, COLOURS[part], size=14)
        left += 24 + draw.textlength(text, font_size=14)
    for number, tile in enumerate(tiles):
        corner = _GAP + number % columns * step[0], _HEAD + _GAP + number // columns * step[1]
        sheet.paste(_tile(tile), corner)
    return np.asarray(sheet)


def _tile(tile: Tile) -> Image.Image:
    """A picture in its place, with its label."""
    picture = load_picture(tile.file).convert("RGB")
    colour = COLOURS[tile.part]
    if tile.part == "none":
        picture = ImageOps.grayscale(picture).convert("RGB")
    place = ImageOps.pad(picture, TILE, color="#e8e8e8")
    draw = ImageDraw.Draw(place)
    if tile.part == "none":
        draw.rectangle((0, 0, TILE[0] - 1, TILE[1] - 1), outline=colour, width=4)
    text = tile.text if len(tile.text) <= _LETTERS else f"{tile.text[: _LETTERS - 3]}..."
    write_label(draw, (4, TILE[1] - 20), text, colour, size=12)
    return place
