"""Sets of training pictures on disk: a folder of 8-bit PNG files and one labels.json, which knows them by their bytes.

Making a set again continues where it stopped.
"""

from __future__ import annotations

import contextlib
import json
import math
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from attacks.detectors.catalogue import SMALL_CLASSES
from attacks.detectors.training.conditions import ViewingConditions
from attacks.detectors.training.config import PictureSetConfig
from attacks.detectors.training.pictures import LabelledPicture, scene_labels, scene_pictures
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.documents import save_png, save_text, sha256
from mi_splat.io.fields import Fields
from mi_splat.io.noted_tensors import read_line
from mi_splat.io.parsing import DocumentReader
from mi_splat.io.picture_files import load_picture

OnStep = Callable[[int, int], None]
Record = dict[str, Any]


def _scene_to_disk(job: tuple[PictureSetConfig, int, Path]) -> dict[int, Record]:
    config, number, folder = job
    return {
        i: _save(one, folder, i) for i, one in enumerate(scene_pictures(config, number), start=number * config.shots)
    }


def _save(picture: LabelledPicture, folder: Path, number: int) -> Record:
    path = folder / f"{number:05d}.png"
    save_png(picture.image.numpy(), path)
    return {
        "sha256": sha256(path),
        "boxes": picture.boxes.tolist(),
        "labels": picture.labels.tolist(),
        "conditions": [asdict(one) for one in picture.conditions],
    }


def save_pictures(pictures: Sequence[LabelledPicture], folder: Path, note: dict[str, object]) -> None:
    """Write a whole data set; `note` says how it was made."""
    folder.mkdir(parents=True, exist_ok=True)
    _write(folder, note, {i: _save(picture, folder, i) for i, picture in enumerate(pictures)})


def check_note(folder: Path, note: dict[str, object]) -> None:
    """Raise unless a data set was made as `note` says; what is None is as good as absent, as in older sets.

    Raises:
        InvalidValueError: It was made otherwise.
    """
    noted = _labels(folder)["recipe"]
    if _without_none(noted) != _without_none(json.loads(json.dumps(note))):
        do = "choose an empty folder or the same configuration"
        raise InvalidValueError(message(f"folder {folder}", note, noted, do))


def _without_none(note: dict[str, Any]) -> dict[str, Any]:
    pairs = ((key, _without_none(value) if isinstance(value, dict) else value) for key, value in note.items())
    return {key: value for key, value in pairs if value is not None}


def _single_thread() -> None:
    torch.set_num_threads(1)


def make(config: PictureSetConfig, folder: Path, *, processes: int = 2, on_step: OnStep | None = None) -> None:
    """Make the pictures of a configuration that `folder` does not hold yet.

    Args:
        config: What to make.
        folder: Where; it is made if need be.
        processes: How many processes share the work; 0 does it in this one.
        on_step: Called with the number of pictures there are and the number wanted.

    Raises:
        InvalidValueError: the folder holds pictures of another configuration.
    """
    folder.mkdir(parents=True, exist_ok=True)
    records = _records(folder, config)
    scenes = math.ceil(config.count / config.shots)
    missing = [n for n in range(scenes) if any(n * config.shots + i not in records for i in range(config.shots))]
    if not missing:
        return
    with _mapper(processes) as each:
        for done, new in enumerate(each(_scene_to_disk, [(config, n, folder) for n in missing])):
            records |= new
            if done % 20 == 19:
                _write(folder, asdict(config), records)
            if on_step is not None:
                on_step(len(records), scenes * config.shots)
    _write(folder, asdict(config), records)


@contextlib.contextmanager
def _mapper(processes: int) -> Iterator[Callable[..., Iterator[dict[int, Record]]]]:
    """A `map` over fresh processes, or over this one if `processes` is 0."""
    if processes == 0:
        yield map
        return
    with multiprocessing.get_context("spawn").Pool(processes, initializer=_single_thread) as pool:
        yield pool.imap_unordered


def _write(folder: Path, note: dict[str, object], records: dict[int, Record]) -> None:
    names = {f"{i:05d}.png": records[i] for i in sorted(records)}
    _replace_labels(folder, {"recipe": note, "classes": list(SMALL_CLASSES), "pictures": names})


def _replace_labels(folder: Path, content: dict[str, Any]) -> None:
    save_text(json.dumps(content), folder / "labels.json")


def _labels(folder: Path) -> dict[str, Any]:
    """What a data set says of its pictures."""
    found = DocumentReader(expected="the labels of a data set", do="make it again", most=1 << 28).read_json(
        folder / "labels.json"
    )
    if not isinstance(found.get("recipe"), dict) or not isinstance(found.get("pictures"), dict):
        raise InvalidValueError(message(f"folder {folder}", "a recipe and pictures", "others", "make it again"))
    return found


def _records(folder: Path, config: PictureSetConfig) -> dict[int, Record]:
    if not (folder / "labels.json").is_file():
        return {}
    content = _labels(folder)
    noted: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in content["recipe"].items()
    }
    unknown = noted.keys() - {field.name for field in fields(PictureSetConfig)}
    if unknown or replace(PictureSetConfig(**noted), count=config.count) != config:
        raise InvalidValueError(
            message(f"folder {folder}", config, content["recipe"], "choose an empty folder or the same configuration")
        )
    return {int(Path(name).stem): record for name, record in content["pictures"].items() if Path(name).stem.isdecimal()}


def load(folder: Path, *, limit: int | None = None) -> list[LabelledPicture]:
    """Read a data set into memory.

    Args:
        folder: Where it is.
        limit: Read so many pictures only, in the order of their numbers.

    Raises:
        InvalidValueError: there is no data set in the folder, or a picture is missing or not the one that was made;
            that cannot be told of older sets, which have no digests.
    """
    path = folder / "labels.json"
    if not path.is_file():
        raise InvalidValueError(message(f"folder {folder}", "a labels.json", "none", "make the data set first"))
    pictures = []
    records = Fields(_labels(folder)["pictures"], str(path), InvalidValueError, "make the data set again")
    for name in list(records.values)[:limit]:
        record = records.object(name)
        _check_bytes(folder / name, dict(record.values))
        image = torch.from_numpy(np.array(load_picture(folder / name)))
        labels = record.wholes("labels", 1, len(SMALL_CLASSES))
        boxes = torch.tensor(record.rows("boxes", len(labels), 4), dtype=torch.float32).reshape(-1, 4)
        conditions = tuple(read_line(ViewingConditions, values) for values in record.objects("conditions"))
        pictures.append(LabelledPicture(image, boxes, torch.tensor(labels, dtype=torch.int64), conditions))
    return pictures


def _check_bytes(path: Path, record: Record) -> None:
    """Raise unless a picture is the one that was made, as far as its record knows that."""
    try:
        digest = sha256(path)
        found = None if digest == record.get("sha256", digest) else "other bytes"
    except OSError as error:
        found = error.strerror or str(error)
    if found:
        expected, do = "the picture that labels.json lists", f"delete the folder {path.parent} to have it made again"
        raise InvalidValueError(message(str(path), expected, found, do))


def fill_conditions(
    folder: Path, scenes: PictureSetConfig, firsts: Mapping[int, int], *, on_step: OnStep | None = None
) -> None:
    """Record how objects are seen in pictures that were made before that was recorded, without rendering them again.

    Args:
        folder: A data set; its labels.json is replaced if something was missing.
        scenes: What the pictures show; `shots` is the number of pictures of each scene.
        firsts: Number of a scene to the number of its first picture.
        on_step: Called with the number of scenes done and the number wanted.

    Raises:
        InvalidValueError: The pictures show something else.
    """
    content = _labels(folder)
    changed = False
    for done, (number, first) in enumerate(firsts.items(), start=1):
        records = [content["pictures"][f"{i:05d}.png"] for i in range(first, first + scenes.shots)]
        if any(len(record.get("conditions", ())) < len(record["labels"]) for record in records):
            for record, picture in zip(records, scene_labels(scenes, number), strict=True):
                _check_labels(folder, number, record, picture)
                record["conditions"] = [asdict(one) for one in picture.conditions]
            changed = True
        if on_step is not None:
            on_step(done, len(firsts))
    if changed:
        _replace_labels(folder, content)


def _check_labels(folder: Path, number: int, record: Record, picture: LabelledPicture) -> None:
    """Raise unless what was recorded of a picture is what its scene gives now, boxes to a pixel or two."""
    boxes = torch.tensor(record["boxes"], dtype=torch.float32).reshape(-1, 4)
    same = record["labels"] == picture.labels.tolist() and torch.allclose(boxes, picture.boxes, rtol=0, atol=2)
    if not same:
        got = f"labels {picture.labels.tolist()} at {picture.boxes.tolist()}"
        expected = f"labels {record['labels']} at {record['boxes']}, as recorded"
        do = "it was made by another version; choose an empty folder to make the pictures again"
        raise InvalidValueError(message(f"folder {folder}, scene {number}", expected, got, do))
