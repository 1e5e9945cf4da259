"""The files of an audit: the account as JSON, an image of each contradiction, the splat
coloured by heat, and the mask.
"""

import dataclasses
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.against import Changes
from mi_splat.audit.linting import Lint, overdraw_picture
from mi_splat.audit.results import Audit, ConeView, ObjectAudit
from mi_splat.audit.viewpoints import SKY, basis
from mi_splat.cameras.framing import near_plane
from mi_splat.io import save_splat
from mi_splat.io.camera_records import describe
from mi_splat.io.documents import save_json
from mi_splat.io.folders import RECORD, new_folder
from mi_splat.io.images import save_picture, side_by_side
from mi_splat.maths.sh import colour_to_dc, dc_to_colour
from mi_splat.provenance import origin
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import resized
from mi_splat.scene import GaussianScene
from mi_splat.selection.select import save_mask

HEAT = "heat.ply"
MASK = "mask.npy"
OVERDRAW = "overdraw.png"
HEAT_PICTURE = "heat.png"
AGAINST = "against.png"
CHANGED = "changed.npy"
_SIDE = 384  # pixels of each of the three images of a cone
_GAP = 8
_EMPTY = 0.85  # grey of directions outside of the cone
_CONE = (0.8, 0.1, 0.1)


def document(
    audit: Audit | None, lint: Lint | None = None, *, unjudged: str = ""
) -> dict[str, Any]:
    """An audit as JSON can hold it; where no object was judged, with the reason."""
    numbers = lint.document() if lint else {}
    if audit is None:
        return {
            "verdict": None,
            "summary": [f"hidden appearance was not judged: {unjudged}"],
            "gaussians": lint and lint.gaussians,
            "objects": [],
            **numbers,
        }
    return {
        "verdict": audit.answer if audit.views else None,
        "summary": audit.summary(),
        "evidence": audit.evidence,
        "gaussians": len(audit.mask),
        "carrying": int(audit.mask.sum()),
        "near": audit.near,
        "missing": audit.missing,
        "objects": [_of_object(item) for item in audit.objects],
        "thresholds": dataclasses.asdict(audit.config),
        **({"against": audit.against.as_dict()} if audit.against else {}),
        **({"up": list(audit.up)} if audit.up else {}),
        **numbers,
    }


def _of_object(item: ObjectAudit) -> dict[str, Any]:
    directions = item.directions.tolist()
    inside = torch.zeros(len(directions), dtype=torch.bool)
    for view in item.views:
        if view.answer == "contradicted":
            inside |= view.inside
    return {
        "answer": item.answer,
        "evidence": item.evidence,
        "known_as": item.known_as,
        "gaussians": len(item.rows),
        "centre": item.centre,
        "radius": item.radius,
        "up": item.up,
        "cones": [_of_cone(view) for view in item.views],
        "seen_from": [
            {"direction": direction, "contradicted": is_inside}
            for direction, is_inside in zip(directions, inside.tolist(), strict=True)
        ],
    }


def _of_cone(view: ConeView) -> dict[str, Any]:
    return {
        "answer": view.answer,
        "sentence": view.sentence,
        "where": view.where,
        "axis": view.region.axis,
        "half_width": view.region.half_width,
        "evidence": view.evidence,
        "distance": view.distance,
        "rise": view.rise,
        "file_score": view.file_score,
        "gain": view.gain,
        "cameras": [
            describe(f"cone {number}", camera)
            for number, camera in enumerate(view.cameras, 1)
        ],
    }


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
    pictures = list[dict[str, Any]]()
    cameras = list[dict[str, object]]()
    with new_folder(target, force=force) as temporary:
        if audit is not None and scene is not None:
            shown = _shown(audit)
            pictures = _save_cones(shown, temporary)
            for number, view in enumerate(shown, 1):
                cameras.append(describe(f"cone {number}", view.cameras[0]))
            _save_carriers(audit, scene, temporary)
            _save_changes(audit, scene, temporary)
        if lint is not None and lint.overdraw is not None:
            save_picture(overdraw_picture(lint.overdraw), temporary / OVERDRAW)
        names = [RECORD, *sorted(file.name for file in temporary.iterdir())]
        record = {
            "story": "audit",
            "file": source,
            **document(audit, lint, unjudged=unjudged),
            "pictures": pictures,
            "cameras": cameras,
        }
        save_json({**record, **origin()}, temporary / RECORD)
    return [target / name for name in names]


def _shown(audit: Audit) -> list[ConeView]:
    """The cones that get an image: all that contradict the rest, or else the one that
    differs most.
    """
    if audit.contradicted:
        return list(audit.contradicted)
    found = [view for view in audit.views if view.answer == "differs"]
    return sorted(found, key=lambda view: -view.distance)[:1]


def _save_cones(shown: list[ConeView], folder: Path) -> list[dict[str, Any]]:
    """Save an image of each: the file, the prediction, and from where."""
    pictures = []
    for number, view in enumerate(shown, 1):
        ending = f"-{number}" if number > 1 else ""
        name = f"{view.answer}{ending}.png"
        save_picture(cone_picture(view), folder / name)
        pictures.append(
            {"file": name, "object": view.object, "sentence": view.sentence}
        )
    return pictures


def cone_picture(view: ConeView) -> NDArray[np.uint8]:
    """(H, W, 3) what the file shows on the left, what the other directions predict in
    the middle, and the cone of directions on the right.
    """
    images = [_enlarged(view.file[0]), _enlarged(view.prediction[0]), _dome(view)]
    return side_by_side(images)


def _enlarged(image: Tensor) -> Tensor:
    planes = image.movedim(-1, 0)[None]
    size = (_SIDE, _SIDE)
    scaled = functional.interpolate(planes, size=size, mode="bilinear")
    return scaled[0].movedim(0, -1)


def _dome(view: ConeView) -> Tensor:
    """(S, S, 3) the directions around an object seen from above, the horizon as the
    rim: the cone is red.
    """
    up = None if view.up is None else torch.tensor(view.up, dtype=torch.float64)
    axis = torch.tensor(view.region.axis, dtype=torch.float64) @ basis(up)
    across = torch.linspace(-1.1, 1.1, _SIDE, dtype=torch.float64)
    y, x = torch.meshgrid(-across, across, indexing="ij")
    off = (x * x + y * y).sqrt()
    # the distance from the middle is the angle from above
    angle = off * math.pi / 2
    flat = angle.sin() / off.clamp(min=1e-9)
    ways = torch.stack([x * flat, y * flat, angle.cos()], -1)
    image = torch.ones(_SIDE, _SIDE, 3)
    image[off <= 1] = _EMPTY
    inside = ways @ axis > math.cos(math.radians(view.region.half_width))
    image[inside & (off <= 1)] = torch.tensor(_CONE)
    return image


def _save_carriers(audit: Audit, scene: GaussianScene, folder: Path) -> None:
    """Save the splat coloured by heat, its view from the clearest cone beside the file,
    and the mask.
    """
    if not bool(audit.mask.any()):
        return
    hot = heated(scene, audit.heat)
    save_splat(hot, folder / HEAT)
    save_mask(audit.mask, folder / MASK)
    camera = resized(audit.contradicted[0].cameras[0], (_SIDE, _SIDE))
    near = near_plane(scene, [camera])
    render = Renderer(RenderSettings(background=SKY, near=near))
    with torch.no_grad():
        images = [render(one, camera) for one in (scene, hot)]
    save_picture(side_by_side(images), folder / HEAT_PICTURE)


def _save_changes(audit: Audit, scene: GaussianScene, folder: Path) -> None:
    """Save what changed since a clean splat, if one was given."""
    against = audit.against
    if against is None:
        return
    if against.cameras:
        save_picture(changes_picture(against, scene), folder / AGAINST)
    if bool(against.mask.any()):
        save_mask(against.mask, folder / CHANGED)


def changes_picture(changes: Changes, scene: GaussianScene) -> NDArray[np.uint8]:
    """(H, W, 3) the clean splat on the left, another on the right, a row for each
    camera.
    """
    render = Renderer(
        RenderSettings(background=SKY, near=near_plane(scene, changes.cameras))
    )
    with torch.no_grad():
        rows = [
            side_by_side([render(item, camera) for item in (changes.clean, scene)])
            for camera in changes.cameras
        ]
    gap = np.full((_GAP, rows[0].shape[1], 3), 255, np.uint8)
    return np.concatenate([part for row in rows for part in (gap, row)][1:])


def heated(scene: GaussianScene, heat: Tensor) -> GaussianScene:
    """The splat in pale grey, redder the more heat a Gaussian has; the same from
    everywhere.
    """
    share = (heat / heat.max().clamp(min=1e-12)).sqrt()[:, None].to(scene.sh)
    grey = 0.4 + 0.5 * dc_to_colour(scene.sh[:, 0]).clamp(0, 1).mean(
        1, keepdim=True
    ).expand(-1, 3)
    colour = (1 - share) * grey + share * grey.new_tensor([0.9, 0.05, 0.0])
    return GaussianScene.unchecked(*scene.tensors()[:4], colour_to_dc(colour)[:, None])
