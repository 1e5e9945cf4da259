"""Sets of training pictures on disk: a folder of 8-bit PNG files and one labels.json, which knows them by their bytes.

Making a set again continues where it stopped.
"""

from __future__ import annotations

import contextlib
import json
import math
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from attacks.detectors.catalogue import SMALL_CLASSES
from attacks.detectors.training.config import (
    BACKGROUNDS,
    EMPTY,
    PATH_TRACED,
    SPLAT_RENDERS,
    BackgroundConfig,
    PictureSetConfig,
    SplatConfig,
)
from attacks.detectors.training.pictures import (
    LabelledPicture,
    ViewingConditions,
    background_pictures,
    scene_pictures,
    splat_pictures,
)
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.documents import save_png, save_text, sha256
from mi_splat.io.fields import Fields
from mi_splat.io.noted_tensors import read_line
from mi_splat.io.parsing import DocumentReader
from mi_splat.io.picture_files import load_picture
from mi_splat.rendering import Renderer

OnStep = Callable[[int, int], None]
"""Called with the number of pictures, or of scenes, that are there and the number wanted."""
OnWork = Callable[[str, int, int], None]
"""Called with what is going on, the units of it that are done, and the number wanted."""
Record = dict[str, Any]
"""What labels.json says of one picture."""
_FIRST_SPLAT = 10_000
"""Number of the first scene that is made into a splat to be held out: none of the path-traced scenes."""
_LABELS = DocumentReader(expected="the labels of a data set", do="make it again", most=1 << 28)


def make(config: PictureSetConfig, folder: Path, *, processes: int = 2, on_step: OnStep | None = None) -> None:
    """Make the path-traced pictures of a configuration that `folder` does not hold yet.

    Args:
        config: What to make.
        folder: Where; it is made if need be.
        processes: How many processes share the work; 0 does it in this one.
        on_step: Called as scenes are done, with numbers of pictures.

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


def splat_set(
    scenes: PictureSetConfig, numbers: Sequence[int], folder: Path, config: SplatConfig, *, on_step: OnStep | None
) -> list[LabelledPicture]:
    """Labelled renders of splats of many scenes; what is missing is made.

    Args:
        scenes: What the scenes are made of.
        numbers: Which of these scenes.
        folder: Where the pictures are kept, each scene in a folder of its own.
        config: How splats are made.
        on_step: Called with numbers of scenes.

    Raises:
        InvalidValueError: The folder holds renders of other scenes, or of splats that were made otherwise.
    """
    render, pictures = Renderer(), []
    note = {"scenes": asdict(replace(scenes, count=1)), "splats": asdict(config)}
    for done, number in enumerate(numbers, start=1):
        pictures += kept_set(folder / f"{number}", note, partial(splat_pictures, scenes, number, config, render=render))
        if on_step is not None:
            on_step(done, len(numbers))
    return pictures


def background_sets(
    folder: Path,
    config: BackgroundConfig,
    *,
    kinds: Sequence[str] = BACKGROUNDS,
    on_step: OnStep | None = None,
) -> dict[str, list[LabelledPicture]]:
    """Pictures of kinds of background by kind; what is missing is made.

    Args:
        folder: Where the pictures are kept, each scene in a folder of its own.
        config: Their number, size and seeds.
        kinds: Which of `BACKGROUNDS`.
        on_step: Called with numbers of scenes.

    Raises:
        InvalidValueError: The folder holds pictures that were made otherwise.
    """
    note = {"backgrounds": asdict(replace(config, scenes=1))}
    sets: dict[str, list[LabelledPicture]] = {kind: [] for kind in kinds}
    jobs = [(kind, number) for kind in kinds for number in range(config.scenes)]
    for done, (kind, number) in enumerate(jobs, start=1):
        sets[kind] += kept_set(folder / f"{kind}-{number}", note, partial(background_pictures, kind, number, config))
        if on_step is not None:
            on_step(done, len(jobs))
    return sets


def held_out_sets(
    folder: Path,
    scenes: PictureSetConfig,
    *,
    splats: int,
    splat: SplatConfig,
    backgrounds: BackgroundConfig,
    processes: int,
    on_work: OnWork,
) -> dict[str, list[LabelledPicture]]:
    """Held-out pictures by set: path traced, renders of splats, and each kind of background.

    Args:
        folder: Where the pictures are kept; what is missing is made.
        scenes: Scenes with objects, and how many pictures of them.
        splats: Number of further such scenes that are made into splats; 0 leaves them out.
        splat: How splats are made.
        backgrounds: Pictures without objects.
        processes: How many processes make path-traced pictures; 0 makes them in this one.
        on_work: Called as pictures are made.

    Raises:
        InvalidValueError: The folder holds pictures that were made otherwise.
    """

    def step(text: str) -> Callable[[int, int], None]:
        return lambda done, total: on_work(text, done, total)

    make(scenes, folder / scenes.split, processes=processes, on_step=step("path-traced pictures"))
    sets = {PATH_TRACED: load(folder / scenes.split, limit=scenes.count)} if scenes.count else {}
    if splats:
        numbers = range(_FIRST_SPLAT, _FIRST_SPLAT + splats)
        sets[SPLAT_RENDERS] = splat_set(scenes, numbers, folder / "splats", splat, on_step=step("splats"))
    empty = background_sets(folder / "backgrounds", backgrounds, on_step=step("backgrounds"))
    return sets | {f"{EMPTY}{kind}": pictures for kind, pictures in empty.items() if pictures}


def kept_set(
    folder: Path, note: dict[str, Any], make: Callable[[], Sequence[LabelledPicture]]
) -> list[LabelledPicture]:
    """The set in a folder, which is made there if there is none.

    Raises:
        InvalidValueError: It was made otherwise than `note` says.
    """
    if not (folder / "labels.json").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder, note, {i: _save(picture, folder, i) for i, picture in enumerate(make())})
    _check_recipe(folder, _labels(folder)["recipe"], note)
    return load(folder)


def load(folder: Path, *, limit: int | None = None) -> list[LabelledPicture]:
    """Read a data set into memory.

    Args:
        folder: Where it is.
        limit: Read so many pictures only, in the order of their numbers.

    Raises:
        InvalidValueError: there is no data set in the folder, or a picture is missing or not the one that was made.
    """
    path = folder / "labels.json"
    if not path.is_file():
        raise InvalidValueError(message(f"folder {folder}", "a labels.json", "none", "make the data set first"))
    pictures = []
    records = Fields(_labels(folder)["pictures"], str(path), InvalidValueError, "make the data set again")
    for name in list(records.values)[:limit]:
        record = records.object(name)
        _check_bytes(folder / name, record.text("sha256"))
        image = torch.from_numpy(np.array(load_picture(folder / name)))
        labels = record.wholes("labels", 1, len(SMALL_CLASSES))
        boxes = torch.tensor(record.rows("boxes", len(labels), 4), dtype=torch.float32).reshape(-1, 4)
        conditions = tuple(read_line(ViewingConditions, values) for values in record.objects("conditions"))
        pictures.append(LabelledPicture(image, boxes, torch.tensor(labels, dtype=torch.int64), conditions))
    return pictures


@contextlib.contextmanager
def _mapper(processes: int) -> Iterator[Callable[..., Iterator[dict[int, Record]]]]:
    """A `map` over fresh processes, or over this one if `processes` is 0."""
    if processes == 0:
        yield map
        return
    with multiprocessing.get_context("spawn").Pool(processes, torch.set_num_threads, (1,)) as pool:
        yield pool.imap_unordered


def _scene_to_disk(job: tuple[PictureSetConfig, int, Path]) -> dict[int, Record]:
    config, number, folder = job
    pictures = enumerate(scene_pictures(config, number), start=number * config.shots)
    return {i: _save(picture, folder, i) for i, picture in pictures}


def _save(picture: LabelledPicture, folder: Path, number: int) -> Record:
    path = folder / f"{number:05d}.png"
    save_png(picture.image.numpy(), path)
    return {
        "sha256": sha256(path),
        "boxes": picture.boxes.tolist(),
        "labels": picture.labels.tolist(),
        "conditions": [asdict(seen) for seen in picture.conditions],
    }


def _write(folder: Path, recipe: dict[str, Any], records: dict[int, Record]) -> None:
    names = {f"{i:05d}.png": records[i] for i in sorted(records)}
    content = {"recipe": recipe, "classes": list(SMALL_CLASSES), "pictures": names}
    save_text(json.dumps(content), folder / "labels.json")


def _labels(folder: Path) -> dict[str, Any]:
    """What a data set says of its pictures."""
    content = _LABELS.read_json(folder / "labels.json")
    if not isinstance(content.get("recipe"), dict) or not isinstance(content.get("pictures"), dict):
        raise InvalidValueError(message(f"folder {folder}", "a recipe and pictures", "others", "make it again"))
    return content


def _records(folder: Path, config: PictureSetConfig) -> dict[int, Record]:
    """What there is by number of the picture; how many were asked for is no part of how they are made."""
    if not (folder / "labels.json").is_file():
        return {}
    content = _labels(folder)
    _check_recipe(folder, {**content["recipe"], "count": config.count}, asdict(config))
    return {int(Path(name).stem): record for name, record in content["pictures"].items() if Path(name).stem.isdecimal()}


def _check_recipe(folder: Path, noted: dict[str, Any], recipe: dict[str, Any]) -> None:
    """Raise unless a data set was made as `recipe` says."""
    if noted != json.loads(json.dumps(recipe)):
        do = "choose an empty folder or the same configuration"
        raise InvalidValueError(message(f"folder {folder}", recipe, noted, do))


def _check_bytes(path: Path, digest: str) -> None:
    """Raise unless a picture is the one that was made."""
    try:
        flaw = None if sha256(path) == digest else "other bytes"
    except OSError as error:
        flaw = error.strerror or str(error)
    if flaw:
        expected, do = "the picture that labels.json lists", f"delete the folder {path.parent} to have it made again"
        raise InvalidValueError(message(str(path), expected, flaw, do))
