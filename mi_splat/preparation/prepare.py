"""From a folder of photographs or a video to a set that every command reads: pictures, a COLMAP model, a sheet."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageOps

from mi_splat import provenance
from mi_splat.datasets import load_dataset
from mi_splat.datasets.writing import IMAGES
from mi_splat.io.documents import save_json
from mi_splat.io.folders import check_new_folder, new_folder
from mi_splat.io.picture_files import load_picture
from mi_splat.io.pictures import save_picture
from mi_splat.labels import write_label
from mi_splat.preparation.config import PreparationError, PrepareConfig
from mi_splat.preparation.pictures import OnProgress, Picture, check_video, pictures_in, take_frames, take_photographs
from mi_splat.preparation.reconstruction import Reconstruct, Reconstruction, by_colmap, check_colmap

RECORD = "prepare.json"
"""What was placed and what was not; by it a set that was prepared is known."""
SHEET = "contact_sheet.png"
"""All pictures, and which of them were placed."""


def prepare(
    source: Path,
    out: Path,
    config: PrepareConfig,
    *,
    force: bool = False,
    on_progress: OnProgress,
    reconstruct: Reconstruct | None = None,
) -> dict[str, Any]:
    """Write a set of pictures with cameras, whole or not at all: images/, sparse/0, the sheet and the record.

    Lenses keep their distortion in the model; it is undone as the set is loaded. Pictures that could not be placed are
    on the sheet and in the record, and not in images/.
    """
    check_new_folder(out, force=force, record=RECORD)
    is_video = not source.is_dir()
    if is_video:
        check_video(source)
    else:
        pictures_in(source, config.max_pictures)
    if reconstruct is None:
        check_colmap()
    with new_folder(out, force=force, record=RECORD) as root:
        images = root / IMAGES
        images.mkdir()
        broken: Mapping[str, str] = {}
        if is_video:
            pictures = take_frames(source, images, config, on_progress)
        else:
            pictures, broken = take_photographs(source, images, config, on_progress)
        done = (reconstruct or by_colmap)(root, pictures, is_video, config.features, on_progress)
        if not done.models:
            raise _nothing_placed(source, pictures, done)
        shutil.rmtree(root / "colmap", ignore_errors=True)
        parts = _parts(root)
        tiles = [
            Tile(file=images / picture.name, text=picture.source, part=parts.get(picture.name, "none"))
            for picture in pictures
        ]
        save_picture(contact_sheet(tiles), root / SHEET)
        for tile in tiles:
            if tile.part == "none":
                tile.file.unlink()
        record = {
            "source": str(source),
            **dataclasses.asdict(config),
            "cameras_by": done.made_by,
            "models": list(done.models),
            "reprojection_error": done.error,
            "points": _points(root),
            "pictures": [_row(picture, done, parts) for picture in pictures],
            "broken": dict(broken),
            **provenance.origin(),
        }
        save_json(record, root / RECORD)
    return record


def not_placed(record: Mapping[str, Any]) -> list[str]:
    """What of a record could not be placed, each with the reason, as far as one is known."""
    unplaced = [row for row in record["pictures"] if row["part"] == "none"]
    reasons = [
        f"{row['source']} ({row['features']} features, overlaps with {row['overlaps']} pictures)" for row in unplaced
    ]
    return reasons + [f"{name} ({reason})" for name, reason in record["broken"].items()]


def _parts(root: Path) -> dict[str, Part]:
    """Which part of the set each picture is in, as those who load the set find it."""
    parts: dict[str, Part] = {}
    for part in ("train", "test"):
        parts |= {path.name: part for path in load_dataset(root, split=part).paths}
    return parts


def _points(root: Path) -> int:
    """How many points the set has to begin a training with."""
    points = load_dataset(root, split=None).points
    return 0 if points is None else len(points.points)


def _row(picture: Picture, done: Reconstruction, parts: Mapping[str, Part]) -> dict[str, Any]:
    """What the record says of a picture."""
    return {
        "name": picture.name,
        "source": picture.source,
        "part": parts.get(picture.name, "none"),
        "features": done.features.get(picture.name, 0),
        "overlaps": done.overlaps.get(picture.name, 0),
        "points": done.points.get(picture.name, 0),
    }


def _nothing_placed(source: Path, pictures: Sequence[Picture], done: Reconstruction) -> PreparationError:
    """What is said where no picture could be placed: what may be at fault."""
    features = sorted(done.features.get(picture.name, 0) for picture in pictures)
    alone = sum(not done.overlaps.get(picture.name) for picture in pictures)
    got = f"none (features: {features[len(features) // 2]} in the middle; overlapping with no other: {alone})"
    do = (
        "take sharp pictures of things with texture, each from another place, that overlap by two thirds"
        if features[len(features) // 2] >= 200
        else "pass larger or sharper pictures, of things with texture"
    )
    return PreparationError.of(str(source), f"{len(pictures)} pictures that can be placed", got, do)


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
    """A picture of the sheet."""

    file: Path
    text: str
    part: Part


def contact_sheet(tiles: Sequence[Tile]) -> NDArray[np.uint8]:
    """All pictures in rows, below a line that says what the colours of their labels mean."""
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
    framed = ImageOps.pad(picture, TILE, color="#e8e8e8")
    draw = ImageDraw.Draw(framed)
    if tile.part == "none":
        draw.rectangle((0, 0, TILE[0] - 1, TILE[1] - 1), outline=colour, width=4)
    text = tile.text if len(tile.text) <= _LETTERS else f"{tile.text[: _LETTERS - 3]}..."
    write_label(draw, (4, TILE[1] - 20), text, colour, size=12)
    return framed
