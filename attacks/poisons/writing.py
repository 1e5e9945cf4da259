"""A poisoned set as files: images that stayed keep their bytes, changed ones their
alpha and their masks.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from attacks.poisons.base import Change, Poisoned, PoisonedViews
from mi_splat.cameras.camera import View
from mi_splat.datasets import Dataset
from mi_splat.datasets.writing import (
    IMAGES,
    MASKS,
    list_transforms,
    make_folder,
    picture_name,
)
from mi_splat.io.documents import save_png
from mi_splat.io.images import PICTURES, quantise, save_picture, to_bytes

_ROUNDING = 1e-3
"""By how much of a step of 1/255 a difference of 8 bits may fall short of whole steps
in float32.
"""
_SHOWN = 5
_TIMES = 10.0
_LARGEST = 320
"""Images on a sheet, how much their difference is enlarged, and the most rows and
columns that are shown of each.
"""


def write_poisoned(
    folder: Path,
    clean: Dataset,
    done: Poisoned,
    *,
    held_out: Dataset | None = None,
    changes_count: bool = False,
    keeps_alpha: bool = False,
    names: Mapping[str, Sequence[str]] | None = None,
    is_single: bool = False,
) -> None:
    """Write a poisoned set: transforms files, images, masks, points.

    An image that stayed keeps its bytes if it is a file that is read as it is, and its
    pixels otherwise. With `changes_count`, pixels that changed count for a victim even
    where the clean set masks them. `names` are those of the images of each split, which
    else are numbered PNG files; `is_single` is that of `list_transforms`.
    """
    images = make_folder(folder / IMAGES)
    parts: dict[str, tuple[Dataset, Mapping[int, View]]] = {
        "train": (clean, done.views.replaced)
    }
    if held_out:
        parts["test"] = (held_out, {})
    listing = {}
    for split, (views, replaced) in parts.items():
        if names is None:
            called = [picture_name(split, index) for index in range(len(views))]
        else:
            called = list(names[split])
        listing[split] = list(zip(called, views.cameras, strict=True))
        for index, name in enumerate(called):
            file = images / name
            make_folder(file.parent)
            if index not in replaced and _is_its_file(views, index, file):
                shutil.copyfile(views.paths[index], file)
            else:
                new = replaced.get(index)
                opaque = None if new is None or keeps_alpha else to_bytes(new.image)
                save_image = save_png if file.suffix.lower() == ".png" else save_picture
                save_image(
                    _pixels(views, index, new) if opaque is None else opaque, file
                )
            mask = _counting(
                views, index, replaced.get(index) if changes_count else None
            )
            if mask is not None:
                place = (folder / MASKS / name).with_suffix(".png")
                make_folder(place.parent)
                save_png(to_bytes(mask), place)
    list_transforms(folder, listing, clean.points, is_single=is_single)


def names_as_before(
    clean: Dataset, held_out: Dataset, *, is_lossy: bool
) -> dict[str, list[str]]:
    """The names of the images of each split as the clean set has them, from the folder
    that holds them all.

    Formats that are not written become PNG, and unless `is_lossy`, JPEG does, too.
    Where two images would then have one name, all are numbered.
    """
    paths = {"train": clean.paths, "test": held_out.paths}
    every = [path for part in paths.values() for path in part]
    folder = Path(os.path.commonpath([path.parent for path in every]))
    kept = PICTURES if is_lossy else (".png",)
    names = {
        split: [
            (path if path.suffix.lower() in kept else path.with_suffix(".png"))
            .relative_to(folder)
            .as_posix()
            for path in part
        ]
        for split, part in paths.items()
    }
    stems = {
        str(PurePosixPath(name).with_suffix(""))
        for part in names.values()
        for name in part
    }
    if len(stems) == len(every):
        return names
    return {
        split: [picture_name(split, index) for index in range(len(part))]
        for split, part in paths.items()
    }


def as_files_hold(done: Poisoned, clean: Dataset) -> Poisoned:
    """A poisoned set as its files can hold it: images with alpha keep it, and nothing
    changes where they are clear.

    There the colour of the file is moved by whole steps of 1/255, as many as do not go
    beyond what was asked for. Other images, and what is said of them, stay as they
    are.
    """
    replaced = dict(done.views.replaced)
    changes = list[Change]()
    for change in done.changes:
        before = clean[change.index]
        alpha = clean.alpha(change.index)
        if alpha is None:
            changes.append(change)
            continue
        opacity = alpha[..., None]
        behind = (1 - opacity) * torch.tensor(clean.background)
        steps = (
            (replaced[change.index].image - before.image)
            / opacity.clamp(min=1 / 255)
            * 255
        )
        whole = torch.where(
            opacity > 0, steps.sign() * (steps.abs() + _ROUNDING).floor(), 0.0
        )
        colour = ((_straight(before.image, alpha, behind) * 255).round() + whole).clamp(
            0, 255
        ) / 255
        image = torch.where(whole == 0, before.image, colour * opacity + behind)
        replaced[change.index] = View(before.camera, image)
        measured = Change.between(change.index, before, replaced[change.index])
        changes.append(replace(change, **asdict(measured)))
    return replace(
        done,
        views=PoisonedViews(done.views.untouched, replaced),
        changes=tuple(changes),
    )


def difference_sheet(done: Poisoned) -> NDArray[np.uint8]:
    """(H, W, 3) sheet of some images: as they were, as they are now, and ten times
    the difference on grey.

    Of a large image a part is shown, around the middle of what was changed.
    """
    changes = [change.index for change in done.changes if change.pixels_changed] or [0]
    chosen = sorted(
        {
            changes[i]
            for i in np.linspace(0, len(changes) - 1, _SHOWN).round().astype(int)
        }
    )
    columns = []
    for index in chosen:
        before, after = (
            quantise(views[index].image) for views in (done.views.untouched, done.views)
        )
        rows, across = (_part((before != after).any(-1).any(axis)) for axis in (1, 0))
        before = before[rows, across]
        after = after[rows, across]
        columns.append(
            torch.stack([before, after, (0.5 + _TIMES * (after - before)).clamp(0, 1)])
        )
    tallest = max(column.shape[1] for column in columns)
    padded = [
        pad(column, (0, 0, 0, 0, 0, tallest - column.shape[1]), value=1.0)
        for column in columns
    ]
    return to_bytes(torch.cat([*torch.cat(padded, 2)]))


def _part(changed: Tensor) -> slice:
    count = len(changed)
    indices = changed.nonzero().flatten().tolist()
    middle = (indices[0] + indices[-1]) // 2 if indices else count // 2
    start = max(0, min(middle - _LARGEST // 2, count - _LARGEST))
    return slice(start, start + _LARGEST)


def _is_its_file(views: Dataset, index: int, copy: Path) -> bool:
    """Whether an image is what its file holds, neither made smaller, turned nor
    undistorted, so that a copy of that name is it, too.
    """
    frame = views.frames[index]
    is_same = frame.is_stored and views.downscale == 1
    return is_same and frame.path.suffix == copy.suffix


def _counting(views: Dataset, index: int, changed: View | None) -> Tensor | None:
    """(H, W) what of an image counts for who trains on it: what counted before, and
    all that was changed.
    """
    mask = views.loss_mask(index)
    if mask is None or changed is None:
        return mask
    # as files have them
    differs = quantise(changed.image) != quantise(views[index].image)
    return torch.where(differs.any(-1), 1.0, mask)


def _pixels(views: Dataset, index: int, new: View | None) -> NDArray[np.uint8]:
    """(H, W, 3) or, with alpha, (H, W, 4) of an image's file."""
    image = (new or views[index]).image
    alpha = views.alpha(index)
    if alpha is None:
        return to_bytes(image)
    behind = (1 - alpha[..., None]) * torch.tensor(views.background)
    return to_bytes(torch.cat([_straight(image, alpha, behind), alpha[..., None]], -1))


def _straight(image: Tensor, alpha: Tensor, behind: Tensor) -> Tensor:
    """(H, W, 3) colour of the file, out of the one that is blended with what is
    behind.
    """
    return ((image - behind) / alpha.clamp(min=1 / 255)[..., None]).clamp(0, 1)
