"""From a folder of photographs or a video to a set that every command reads: pictures, a COLMAP model, a sheet."""

from __future__ import annotations

import dataclasses
import itertools
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageOps

from mi_splat import provenance
from mi_splat.datasets import load_dataset
from mi_splat.datasets.frames import Split
from mi_splat.datasets.writing import IMAGES
from mi_splat.directions import up_of
from mi_splat.errors import install
from mi_splat.io.documents import save_json
from mi_splat.io.folders import check_new_folder, new_folder
from mi_splat.io.images import save_picture
from mi_splat.io.picture_files import load_picture
from mi_splat.labels import write_label
from mi_splat.preparation.config import PreparationError, PrepareConfig
from mi_splat.preparation.pictures import (
    FEWEST_PICTURES,
    OnProgress,
    Picture,
    check_video,
    pictures_in,
    take_frames,
    take_photographs,
)
from mi_splat.rotation import from_z

# pycolmap is imported where it is needed alone, since it takes over what a process does on signals. Lenses are
# SIMPLE_RADIAL: a focal length and one coefficient, alike for all pictures of one size and focal length.

ALL_PAIRS = 100
"""Pictures up to which each is compared with every other one, unless they come from a video."""
NEIGHBOURS = 10
"""Of a video or of many pictures, each is compared with so many after it."""
ANCHORS = 40
"""And so many of them, evenly spread, with each other: they find where the way comes back to."""

FEWEST_POINTS = 30
"""Of the model that a picture has to show. COLMAP places none with fewer, but may take some away again later."""
_FOCAL = 1.2
"""Focal length in longest sides, where the camera has not written it; COLMAP's default."""
_CHUNK = 8
_PAIRS_AT_ONCE = 100
_SEED = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Reconstruction:
    """What came of a reconstruction, whose largest model was written; by the names of pictures."""

    models: tuple[int, ...]  # how many pictures each model has, the largest first
    error: float = 0.0  # mean distance of points from where pictures show them, pixels
    features: Mapping[str, int]  # points by which each picture could be found in others
    overlaps: Mapping[str, int]  # how many others each picture has enough of them in common with
    points: Mapping[str, int] = field(default_factory=dict)  # how many points of the model each of its pictures shows
    made_by: str = ""  # the program, and its version


def check_colmap() -> None:
    """Raise, before any work is done, if COLMAP's library is not installed."""
    if find_spec("pycolmap") is None:
        expected = "pycolmap, which finds out where pictures were taken from"
        raise PreparationError.of("prepare", expected, "no such package", install("colmap"))


def pairs_of(count: int, *, in_order: bool) -> list[tuple[int, int]]:
    """Which pictures are compared with which, by their numbers."""
    if count <= ALL_PAIRS and not in_order:
        return list(itertools.combinations(range(count), 2))
    near = {(i, j) for i in range(count) for j in range(i + 1, min(i + NEIGHBOURS + 1, count))}
    return sorted(near.union(itertools.combinations(range(0, count, -(-count // ANCHORS)), 2)))


def by_colmap(
    root: Path, pictures: Sequence[Picture], in_order: bool, features: int, on_progress: OnProgress
) -> Reconstruction:
    """Find the cameras of pictures, and write the largest model, turned so that z is up, into sparse/0."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    pycolmap.set_random_seed(_SEED)
    database = root / "colmap" / "database.db"
    database.parent.mkdir()
    _extract(pycolmap, database, root / "images", pictures, features, on_progress)
    _match(pycolmap, database, pictures, pairs_of(len(pictures), in_order=in_order), on_progress)
    counted, overlaps = _statistics(pycolmap, database)
    mapped = _map(pycolmap, database, root / "images", len(pictures), on_progress)
    models = _trimmed(mapped)
    points: dict[str, int] = {}
    if models:
        points = {image.name: image.num_points3D for image in _placed(models[0])}
        _turn_up(pycolmap, models[0])
        target = root / "sparse" / "0"
        target.mkdir(parents=True)
        models[0].write_binary(str(target))
    return Reconstruction(
        models=tuple(model.num_reg_images() for model in models),
        error=float(models[0].compute_mean_reprojection_error()) if models else 0.0,
        features=counted,
        overlaps=overlaps,
        points=points,
        made_by=f"pycolmap {pycolmap.__version__}",
    )


def _extract(
    pycolmap: Any, database: Path, images: Path, pictures: Sequence[Picture], features: int, on_progress: OnProgress
) -> None:
    """Find the features of all pictures; those of one size and focal length have one camera."""
    options = pycolmap.FeatureExtractionOptions(max_image_size=max(max(p.size) for p in pictures))
    options.sift.max_num_features = features
    done = 0
    lenses: dict[tuple[tuple[int, int], float | None], list[str]] = {}
    for picture in pictures:
        lenses.setdefault((picture.size, picture.focal), []).append(picture.name)
    for (size, focal), names in lenses.items():
        with pycolmap.Database.open(str(database)) as opened:
            camera = pycolmap.Camera(
                model="SIMPLE_RADIAL",
                width=size[0],
                height=size[1],
                params=[focal or _FOCAL * max(size), size[0] / 2, size[1] / 2, 0.0],
                has_prior_focal_length=focal is not None,
            )
            number = opened.write_camera(camera)
        for start in range(0, len(names), _CHUNK):
            on_progress("finding features", done, len(pictures))
            chunk = names[start : start + _CHUNK]
            pycolmap.extract_features(
                database_path=str(database),
                image_path=str(images),
                image_names=chunk,
                reader_options=pycolmap.ImageReaderOptions(existing_camera_id=number),
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            done += len(chunk)


def _match(
    pycolmap: Any,
    database: Path,
    pictures: Sequence[Picture],
    pairs: Sequence[tuple[int, int]],
    on_progress: OnProgress,
) -> None:
    listed = database.with_name("pairs.txt")
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = _SEED
    for start in range(0, len(pairs), _PAIRS_AT_ONCE):
        on_progress("comparing pairs of pictures", start, len(pairs))
        chunk = pairs[start : start + _PAIRS_AT_ONCE]
        listed.write_text("".join(f"{pictures[i].name} {pictures[j].name}\n" for i, j in chunk), "utf-8")
        pycolmap.match_image_pairs(
            database_path=str(database),
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=str(listed)),
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )


def _statistics(pycolmap: Any, database: Path) -> tuple[dict[str, int], dict[str, int]]:
    """Features of each picture, and with how many others it overlaps, by its name."""
    with pycolmap.Database.open(str(database)) as opened:
        images = {image.image_id: image.name for image in opened.read_all_images()}
        features = {name: opened.num_keypoints_for_image(number) for number, name in images.items()}
        overlaps = dict.fromkeys(features, 0)
        pairs, inliers = opened.read_two_view_geometry_num_inliers()
        for pair, count in zip(pairs, inliers, strict=True):
            if count:
                for number in pycolmap.pair_id_to_image_pair(pair) if isinstance(pair, int) else pair:
                    overlaps[images[number]] += 1
    return features, overlaps


def _map(pycolmap: Any, database: Path, images: Path, count: int, on_progress: OnProgress) -> list[Any]:
    placed = itertools.count(2)

    def one_more() -> None:
        on_progress("placing cameras", min(next(placed), count), count)

    options = pycolmap.IncrementalPipelineOptions(min_model_size=FEWEST_PICTURES, random_seed=_SEED)
    output = database.with_name("models")
    output.mkdir()
    models: dict[int, Any] = pycolmap.incremental_mapping(
        database_path=str(database),
        image_path=str(images),
        output_path=str(output),
        options=options,
        initial_image_pair_callback=one_more,
        next_image_callback=one_more,
    )
    return list(models.values())


def _trimmed(models: Sequence[Any]) -> list[Any]:
    """Models without the pictures that show too few points, the largest first; those with too few pictures are gone."""
    for model in models:
        few = [image.frame_id for image in _placed(model) if image.num_points3D < FEWEST_POINTS]
        for frame in few:
            model.deregister_frame(frame)
    whole = [model for model in models if model.num_reg_images() >= FEWEST_PICTURES]
    return sorted(whole, key=lambda model: -model.num_reg_images())


def _placed(model: Any) -> list[Any]:
    return [image for image in model.images.values() if image.has_pose]


def _turn_up(pycolmap: Any, model: Any) -> None:
    turns = np.stack([image.cam_from_world().rotation.matrix().T for image in _placed(model)])
    rotation = from_z(up_of(torch.from_numpy(turns))).T.numpy()
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(rotation), np.zeros(3)))


RECORD = "prepare.json"
"""What was placed and what was not; by it a set that was prepared is known."""
SHEET = "contact_sheet.png"
"""All pictures, and which of them were placed."""


def prepare(
    source: Path, out: Path, config: PrepareConfig, *, force: bool = False, on_progress: OnProgress
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
    check_colmap()
    with new_folder(out, force=force, record=RECORD) as root:
        images = root / IMAGES
        images.mkdir()
        broken: Mapping[str, str] = {}
        if is_video:
            pictures = take_frames(source, images, config, on_progress)
        else:
            pictures, broken = take_photographs(source, images, config, on_progress)
        done = by_colmap(root, pictures, is_video, config.features, on_progress)
        if not done.models:
            raise _nothing_placed(source, pictures, done)
        shutil.rmtree(root / "colmap", ignore_errors=True)
        parts = _parts(root)
        save_picture(contact_sheet(images, pictures, parts), root / SHEET)
        for picture in pictures:
            if picture.name not in parts:
                (images / picture.name).unlink()
        points = load_dataset(root, split=None).points
        record = {
            "source": str(source),
            **dataclasses.asdict(config),
            "cameras_by": done.made_by,
            "models": list(done.models),
            "reprojection_error": done.error,
            "points": 0 if points is None else len(points),
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


def _parts(root: Path) -> dict[str, str]:
    """Which part of the set each picture is in, as those who load the set find it."""
    splits: tuple[Split, ...] = ("train", "test")
    return {path.name: split for split in splits for path in load_dataset(root, split=split).paths}


def _row(picture: Picture, done: Reconstruction, parts: Mapping[str, str]) -> dict[str, Any]:
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


PARTS = {"train": ("#000000", "for training"), "test": ("#1f5fbf", "held out"), "none": ("#c01818", "not placed")}
"""Colour of the label and meaning of each part of the set that a picture may be in."""

TILE = (192, 144)
"""Width and height of the place of a picture, pixels."""
_COLUMNS, _GAP, _HEAD, _LETTERS = 8, 4, 28, 24


def contact_sheet(images: Path, pictures: Sequence[Picture], parts: Mapping[str, str]) -> NDArray[np.uint8]:
    """All pictures in rows, below a line that says what the colours of their labels mean."""
    columns = min(_COLUMNS, max(4, len(pictures)))
    rows = -(-len(pictures) // columns)
    step = (TILE[0] + _GAP, TILE[1] + _GAP)
    sheet = Image.new("RGB", (columns * step[0] + _GAP, _HEAD + rows * step[1] + _GAP), "white")
    draw = ImageDraw.Draw(sheet)
    left = float(_GAP)
    for part, (colour, meaning) in PARTS.items():
        text = f"{sum(parts.get(picture.name, 'none') == part for picture in pictures)} {meaning}"
        write_label(draw, (left, 4), text, colour, size=14)
        left += 24 + draw.textlength(text, font_size=14)
    for number, picture in enumerate(pictures):
        corner = _GAP + number % columns * step[0], _HEAD + _GAP + number // columns * step[1]
        sheet.paste(_tile(images / picture.name, picture.source, parts.get(picture.name, "none")), corner)
    return np.asarray(sheet)


def _tile(file: Path, text: str, part: str) -> Image.Image:
    picture = load_picture(file).convert("RGB")
    colour, _ = PARTS[part]
    if part == "none":
        picture = ImageOps.grayscale(picture).convert("RGB")
    framed = ImageOps.pad(picture, TILE, color="#e8e8e8")
    draw = ImageDraw.Draw(framed)
    if part == "none":
        draw.rectangle((0, 0, TILE[0] - 1, TILE[1] - 1), outline=colour, width=4)
    text = text if len(text) <= _LETTERS else f"{text[: _LETTERS - 3]}..."
    write_label(draw, (4, TILE[1] - 20), text, colour, size=12)
    return framed
