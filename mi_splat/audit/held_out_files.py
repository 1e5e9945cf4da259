"""The account of held-out directions: sentences, JSON, and an image of each
contradiction.
"""

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.held_out import ConeView, HeldOut
from mi_splat.audit.results import directions_in_words
from mi_splat.audit.viewpoints import basis
from mi_splat.io.camera_records import describe
from mi_splat.io.images import save_picture, side_by_side

_SIDE = 384  # pixels of each of the three images
_SKY = 0.85
_CONE = (0.8, 0.1, 0.1)


def held_out_lines(found: HeldOut) -> list[str]:
    """The answer in sentences, the clearest contradiction first."""
    missing = [found.missing] if found.missing else []
    contradictions = [_contradiction(view) for view in found.contradicted]
    if contradictions:
        return [*(f"contradicted: {one}" for one in contradictions), *missing]
    if not found.views:
        return ["not compared: the cameras stand on too few sides of each object"]
    names = sorted({name for name in found.known_as if name is not None})
    known = f"the detector knows: {', '.join(names) or 'no object'}"
    if found.answer == "consistent":
        line = f"consistent: no cone of directions contradicts the others ({known})"
        return [line, *missing]
    worst = max(found.views, key=lambda view: view.distance)
    where = directions_in_words(worst.region, worst.up)
    line = (
        f"differs: {where}, the file looks unlike what the other directions predict, as"
        f" honest gloss and fog do, too ({known})"
    )
    return [line, *missing]


def _contradiction(view: ConeView) -> str:
    where = directions_in_words(view.region, view.up)
    if view.gain > view.distance:
        return (
            f"{where}, the other directions predict a {view.known_as}"
            f" ({view.file_score + view.gain:.2f}), and the file shows none"
            f" ({view.file_score:.2f})"
        )
    return (
        f"{where}, the file shows something else than the other directions predict:"
        f" features {view.distance:.2f} apart"
    )


def held_out_document(found: HeldOut) -> dict[str, Any]:
    """Held-out directions as JSON can hold them."""
    return {
        "answer": found.answer,
        "evidence": found.evidence,
        "summary": held_out_lines(found),
        "contradictions": [_contradiction(view) for view in found.contradicted],
        "known_as": list(found.known_as),
        "cones": [_cone_document(view) for view in found.views],
    }


def _cone_document(view: ConeView) -> dict[str, Any]:
    return {
        "object": view.object,
        "axis": list(view.region.axis),
        "half_width": view.region.half_width,
        "answer": view.answer,
        "evidence": view.evidence,
        "distance": view.distance,
        "rise": view.rise,
        "file_score": view.file_score,
        "gain": view.gain,
        "cameras": [
            describe(f"held-out {number}", camera)
            for number, camera in enumerate(view.cameras, 1)
        ],
    }


def contradiction_file(number: int) -> str:
    """Name of the image of a contradiction, counted from 0, the clearest first."""
    ending = f"-{number + 1}" if number else ""
    return f"contradicted{ending}.png"


def save_contradictions(found: HeldOut, folder: Path) -> list[str]:
    """Save an image of each contradiction, and return their names: the file, the
    prediction, and from where.
    """
    names = []
    for number, view in enumerate(found.contradicted):
        names.append(contradiction_file(number))
        images = [_enlarged(view.file[0]), _enlarged(view.prediction[0]), _dome(view)]
        save_picture(side_by_side(images), folder / names[-1])
    return names


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
    image[off <= 1] = _SKY
    inside = ways @ axis > math.cos(math.radians(view.region.half_width))
    image[inside & (off <= 1)] = torch.tensor(_CONE)
    return image
