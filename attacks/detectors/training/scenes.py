"""A job of the ledger: the labelled pictures of one scene, as 8-bit PNG files and one labels.json."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from attacks.detectors.catalogue import SMALL_CLASSES
from attacks.detectors.training.config import BackgroundConfig, PictureSetConfig, SplatConfig
from attacks.detectors.training.pictures import (
    LabelledPicture,
    ViewingConditions,
    background_pictures,
    scene_pictures,
    splat_pictures,
)
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import save_png, save_text
from mi_splat.io.fields import Fields
from mi_splat.io.noted_tensors import read_line
from mi_splat.io.parsing import DocumentReader
from mi_splat.io.picture_files import load_picture
from mi_splat.rendering import Renderer

if TYPE_CHECKING:
    from mi_splat.ledger import Out

LABELS = "labels.json"
_READER = DocumentReader(expected="the labels of pictures", do="make them again", most=1 << 28)


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneConfig:
    """Which pictures.

    Attributes:
        scenes: What the scenes are made of, with objects or without any.
        number: Which of them.
        kind: Key of `BACKGROUNDS`, of a scene without objects; empty for others.
        splat: How the scene is made into a splat, of which the pictures are renders; None path traces them.
    """

    scenes: PictureSetConfig | BackgroundConfig
    number: int
    kind: str = ""
    splat: SplatConfig | None = None


def run(config: SceneConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Make the pictures."""
    save(pictures_of(config), out.files)


def pictures_of(config: SceneConfig) -> list[LabelledPicture]:
    """The pictures, a pure function of the configuration."""
    if isinstance(config.scenes, BackgroundConfig):
        return background_pictures(config.kind, config.number, config.scenes)
    if config.splat is None:
        return scene_pictures(config.scenes, config.number)
    return splat_pictures(config.scenes, config.number, config.splat, render=Renderer())


def save(pictures: Sequence[LabelledPicture], folder: Path) -> None:
    """Write pictures and their labels into a folder."""
    records = {}
    for number, picture in enumerate(pictures):
        name = f"{number:05d}.png"
        save_png(picture.image.numpy(), folder / name)
        records[name] = {
            "boxes": picture.boxes.tolist(),
            "labels": picture.labels.tolist(),
            "conditions": [asdict(seen) for seen in picture.conditions],
        }
    save_text(json.dumps(records), folder / LABELS)


def load(folder: Path) -> list[LabelledPicture]:
    """Read pictures and labels into memory."""
    path, pictures = folder / LABELS, []
    records = Fields(_READER.read_json(path), str(path), InvalidValueError, _READER.do)
    for name in records.values:
        record = records.object(name)
        image = torch.from_numpy(np.array(load_picture(folder / Path(name).name)))
        labels = record.wholes("labels", 1, len(SMALL_CLASSES))
        boxes = torch.tensor(record.rows("boxes", len(labels), 4), dtype=torch.float32).reshape(-1, 4)
        conditions = tuple(read_line(ViewingConditions, values) for values in record.objects("conditions"))
        pictures.append(LabelledPicture(image, boxes, torch.tensor(labels, dtype=torch.int64), conditions))
    return pictures
