"""The files of an audit of pictures: the account as JSON, and the two pictures that contradict each other most."""

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_splat.audit.files import PICTURE, beside, document, save_pairs
from mi_splat.audit.pictures import SHOWS, PictureAudit
from mi_splat.audit.results import Pair
from mi_splat.datasets import Dataset
from mi_splat.io.documents import save_json
from mi_splat.io.folders import RECORD, new_folder
from mi_splat.provenance import origin

MOST_NAMED = 8
"""Pictures of a set that are named in a line."""


def document_of_pictures(judged: PictureAudit, views: Dataset, count: int) -> dict[str, Any]:
    """An audit of pictures as JSON can hold it."""
    amounts = judged.amounts.tolist()
    files = [str(views.frames[number].path) for number in judged.numbers.tolist()]
    shown = [Path(file).name for file, amount in zip(files, amounts, strict=True) if amount > SHOWS]
    more = f" and {len(shown) - MOST_NAMED} more" if len(shown) > MOST_NAMED else ""
    names = ", ".join(shown[:MOST_NAMED])
    line = f"{len(shown)} of {len(files)} pictures show what the others contradict: {names}{more}"
    rest = f"{len(files)} of the {count} pictures of the set were compared; nothing is said of the others"
    values = document(judged.audit)
    return {
        **values,
        "summary": [*values["summary"], *([line] if shown else []), *([rest] if len(files) < count else [])],
        "pictures_in_set": count,
        "views": [
            {"picture": file, "amount": amount, "contradicts": amount > SHOWS}
            for file, amount in zip(files, amounts, strict=True)
        ],
    }


def write_pictures(
    judged: PictureAudit,
    views: Dataset,
    folder: str | os.PathLike[str],
    *,
    account: dict[str, Any],
    source: str,
    force: bool = False,
) -> list[Path]:
    """Write the files of an audit of pictures into a new folder, whole or not at all."""
    longer = max(max(camera.width, camera.height) for camera in views.cameras)
    shown = dataclasses.replace(views, downscale=views.downscale * max(1, longer // PICTURE))

    def show(pair: Pair) -> NDArray[np.uint8]:
        return beside([shown[int(judged.numbers[number])].image for number in pair.numbers])

    target = Path(folder)
    with new_folder(target, force=force) as temporary:
        pairs = save_pairs(judged.audit, temporary, show)
        record = {"story": "audit", "file": source, **account, **pairs}
        save_json({**record, **origin()}, temporary / RECORD)
    return [target / name for name in (RECORD, *(picture["file"] for picture in pairs["pictures"]))]
