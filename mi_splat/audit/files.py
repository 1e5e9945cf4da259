"""The files of an audit: the account as JSON, the two pictures, the splat coloured by heat, and the mask."""

import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.audit.lint.checking import Lint
from mi_splat.audit.lint.cost import overdraw_picture
from mi_splat.audit.pictures import SHOWS, PictureAudit
from mi_splat.audit.results import (
    COVERED,
    EXCESS,
    SUSPICION,
    Audit,
    Look,
    ObjectAudit,
    Pair,
    directions_in_words,
    summary,
)
from mi_splat.bounds import near_plane
from mi_splat.cameras import Camera
from mi_splat.datasets import Dataset
from mi_splat.io import save_splat
from mi_splat.io.camera_records import describe
from mi_splat.io.documents import save_json
from mi_splat.io.folders import RECORD, new_folder
from mi_splat.io.images import save_picture, to_bytes
from mi_splat.provenance import origin
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.scene_files import resized
from mi_splat.selection.select import save_mask
from mi_splat.sh import colour_to_dc, dc_to_colour

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


PAIR, HEAT, MASK, OVERDRAW = "pair.png", "heat.ply", "mask.npy", "overdraw.png"
HEAT_PICTURE = "heat.png"
EDITED, AGAINST, CHANGED = "edited.npy", "against.png", "changed.npy"
PICTURE = 512
"""Pixels along the longer side of each of the two pictures."""
_THRESHOLDS = {"excess": EXCESS, "covered": COVERED, "suspicion": SUSPICION}
_GAP = 8
_BACKGROUND = (0.55, 0.7, 0.9)


def document(audit: Audit | None, lint: Lint | None = None, *, unjudged: str = "") -> dict[str, Any]:
    """An audit as JSON can hold it."""
    return {**(_judged(audit) if audit else _unjudged(lint, unjudged)), **(lint.document() if lint else {})}


def _unjudged(lint: Lint | None, why: str) -> dict[str, Any]:
    """In the form of an audit that found no object."""
    return {
        "verdict": None,
        "summary": [f"not looked at for hidden looks: {why}"],
        "gaussians": lint.gaussians if lint else None,
        "carrying": 0,
        "near": 0.0,
        "thresholds": _THRESHOLDS,
        "objects": [],
    }


def _judged(audit: Audit) -> dict[str, Any]:
    return {
        "verdict": audit.verdict,
        "summary": summary(audit),
        "gaussians": len(audit.mask),
        "carrying": int(audit.mask.sum()),
        "near": audit.near,
        "thresholds": _THRESHOLDS,
        "objects": [_of_object(item) for item in audit.objects],
        **({"against": audit.against.as_dict()} if audit.against else {}),
        **({"up": list(audit.up)} if audit.up else {}),
    }


def _of_object(item: ObjectAudit) -> dict[str, Any]:
    cover = item.occluder
    return {
        "verdict": item.verdict,
        "evidence": item.evidence,
        "in_room": item.in_room,
        "gaussians": len(item.rows),
        "centre": item.centre,
        "radius": item.radius,
        "up": item.up,
        "pieces": item.pieces,
        "area": item.area,
        "uncontradicted": item.uncontradicted,
        "looks": [_of_look(look, item) for look in item.looks],
        "occluder": cover and {"axis": cover.axis, "transparent": cover.transparent, "score": cover.score},
        "edited": _of_edit(item),
        "seen_from": [
            {
                "direction": direction,
                "looks": [number for number, shows in enumerate(shown) if shows],
                "blocked": blocked,
            }
            for direction, shown, blocked in zip(
                item.directions.tolist(),
                torch.stack([look.shown for look in item.looks], 1).tolist(),
                cover.blocked.tolist() if cover else [0.0] * len(item.directions),
                strict=True,
            )
        ],
    }


def _of_edit(item: ObjectAudit) -> dict[str, Any] | None:
    edit = item.edit
    if edit is None:
        return None
    values = {name: getattr(edit, name) for name in ("score", "share", "usual_share", "grain", "usual_grain", "peak")}
    rows = sorted(edit.rows.tolist()) if item.edited else []
    return {**values, "camera": edit.direction if edit.camera_known else None, "rows": rows}


def _of_look(look: Look, item: ObjectAudit) -> dict[str, Any]:
    return {
        "where": directions_in_words(look.region, item.up),
        "score": look.score,
        "incidence": look.incidence,
        "mirror": look.mirror,
        "shift": look.shift,
        "fade": look.fade,
        "excess": look.excess,
        "area": look.area,
        "cameras": int(look.shown.sum()),
        "directions": dataclasses.asdict(look.region),
        "pair": look.pair and {"change": look.pair.change, "cameras": pair_cameras(look.pair)},
    }


def pair_cameras(pair: Pair, number: int = 1) -> list[dict[str, object]]:
    """The two cameras of a look with a number as JSON can hold them."""
    end = f" {number}" if number > 1 else ""
    return [describe(f"inside{end}", pair.inside), describe(f"outside{end}", pair.outside)]


def pair_picture(scene: GaussianScene, pair: Pair) -> NDArray[np.uint8]:
    """(H, W, 3) the two images that prove an appearance: from inside its directions left, from outside right."""
    cameras = [_enlarged(camera) for camera in (pair.inside, pair.outside)]
    render = Renderer(RenderSettings(background=_BACKGROUND, near=near_plane(scene, cameras)))
    with torch.no_grad():
        return beside([render(scene, camera) for camera in cameras])


def beside(pictures: Sequence[Tensor]) -> NDArray[np.uint8]:
    """(H, W, 3) pictures beside each other, white between them and below lower ones."""
    pixels = [to_bytes(picture.clamp(0, 1)) for picture in pictures]
    height = max(map(len, pixels))
    gap = np.full((height, _GAP, 3), 255, np.uint8)
    parts = [np.pad(p, ((0, height - len(p)), (0, 0), (0, 0)), constant_values=255) for p in pixels]
    return np.concatenate([part for shown in parts for part in (gap, shown)][1:], axis=1)


def _enlarged(camera: Camera) -> Camera:
    factor = PICTURE / max(camera.width, camera.height)
    return resized(camera, (round(camera.width * factor), round(camera.height * factor)))


def heated(scene: GaussianScene, heat: Tensor) -> GaussianScene:
    """The splat in pale grey, redder the more heat a Gaussian has; the same from everywhere."""
    share = (heat / heat.max().clamp(min=1e-12))[:, None].to(scene.sh)
    grey = 0.4 + 0.5 * dc_to_colour(scene.sh[:, 0]).clamp(0, 1).mean(1, keepdim=True).expand(-1, 3)
    colour = (1 - share) * grey + share * grey.new_tensor([0.9, 0.05, 0.0])
    return GaussianScene.unchecked(*scene.tensors()[:4], colour_to_dc(colour)[:, None])


def write(
    audit: Audit | None,
    scene: GaussianScene | None,
    folder: str | os.PathLike[str],
    *,
    source: str,
    lint: Lint | None = None,
    unjudged: str = "",
    force: bool = False,
) -> list[Path]:
    """Write the files of an audit into a new folder, whole or not at all."""
    target = Path(folder)
    names, more = [RECORD], dict[str, Any](pictures=[], cameras=[])
    with new_folder(target, force=force) as temporary:
        if audit is not None and scene is not None:
            more = _evidence(audit, scene, temporary, names)
        if lint is not None and lint.overdraw is not None:
            save_picture(overdraw_picture(lint.overdraw), temporary / OVERDRAW)
            names.append(OVERDRAW)
        record = {"story": "audit", "file": source, **document(audit, lint, unjudged=unjudged), **more}
        save_json({**record, **origin()}, temporary / RECORD)
    return [target / name for name in names]


def _evidence(audit: Audit, scene: GaussianScene, folder: Path, names: list[str]) -> dict[str, Any]:
    """Save what proves an audit, add the files to `names`, and say which pictures and cameras they show."""
    shown = save_pairs(audit, folder, lambda pair: pair_picture(scene, pair))
    names += [picture["file"] for picture in shown["pictures"]]
    if bool(audit.mask.any()):
        hot = heated(scene, audit.heat)
        save_splat(hot, folder / HEAT)
        save_mask(audit.mask, folder / MASK)
        names += [HEAT, MASK]
        if audit.strongest.look.pair is not None:
            save_picture(pair_picture(hot, audit.strongest.look.pair), folder / HEAT_PICTURE)
            names.append(HEAT_PICTURE)
    edited = [item.edit.rows for item in audit.objects if item.edit is not None and item.edited]
    if edited:
        save_mask(torch.zeros(len(scene), dtype=torch.bool).index_fill_(0, torch.cat(edited), True), folder / EDITED)
        names.append(EDITED)
    if audit.against is not None and audit.against.cameras:
        save_picture(audit.against.pictures(scene), folder / AGAINST)
        names.append(AGAINST)
    if audit.against is not None and bool(audit.against.mask.any()):
        save_mask(audit.against.mask, folder / CHANGED)
        names.append(CHANGED)
    return shown


def save_pairs(audit: Audit, folder: Path, show: Callable[[Pair], NDArray[np.uint8]]) -> dict[str, Any]:
    """Save the pictures that prove looks."""
    pictures, cameras = list[dict[str, Any]](), list[dict[str, object]]()
    for number, (numbers, pair) in enumerate(shown_pairs(audit), 1):
        name = PAIR if number == 1 else f"pair-{number}.png"
        save_picture(show(pair), folder / name)
        pictures.append({"file": name, "object": numbers[0], "look": numbers[1], "change": pair.change})
        cameras += pair_cameras(pair, number)
    return {"pictures": pictures, "cameras": cameras}


def shown_pairs(audit: Audit) -> list[tuple[tuple[int, int], Pair]]:
    """Pairs of cameras that are worth a picture, the strongest first: all with evidence, of none at least one."""
    looks = [
        ((index, number), look)
        for index, item in enumerate(audit.objects)
        for number, look in enumerate(item.looks)
        if look.pair is not None and (look.evidence >= SUSPICION or item is audit.strongest)
    ]
    looks.sort(key=lambda entry: (audit.objects[entry[0][0]] is not audit.strongest, -entry[1].evidence))
    return [(numbers, look.pair) for numbers, look in looks if look.pair is not None]
