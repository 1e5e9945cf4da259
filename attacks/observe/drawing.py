"""Boxes on images and in lists, and what differs between images, as a report can
save them.
"""

import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from torch import Tensor

from attacks.detectors.base import Detections
from mi_splat.io.images import to_bytes
from mi_splat.io.labels import Plate, free_plate, plate_of, write_label

_LINE = 22
"""Pixels from one label to the next below it."""
_COLOURS = (
    "#e6194b",
    "#3cb44b",
    "#4363d8",
    "#f58231",
    "#911eb4",
    "#008080",
    "#9a6324",
    "#000075",
)


def annotated(
    picture: Tensor,
    detections: Detections,
    title: str,
    *,
    min_confidence: float = 0.3,
    width: int = 512,
) -> NDArray[np.uint8]:
    """An image with the boxes and confidences of its detections, and a title."""
    canvas = _enlarged(to_bytes(picture), width)
    draw = ImageDraw.Draw(canvas)
    scale = canvas.width / picture.shape[1]
    corner = (6, canvas.height - 26)
    taken = [plate_of(draw, corner, title)]
    draw_detections(
        draw, detections, scale=scale, min_confidence=min_confidence, taken=taken
    )
    write_label(draw, corner, title, "#000000")
    return np.asarray(canvas)


def draw_detections(
    draw: ImageDraw.ImageDraw,
    detections: Detections,
    *,
    scale: float = 1.0,
    min_confidence: float = 0.3,
    taken: Sequence[Plate] = (),
) -> None:
    """Draw boxes, labels and confidences, the best last and so on top; no label covers
    another one.
    """
    rows = zip(
        detections.labels,
        detections.scores.tolist(),
        (scale * detections.boxes).tolist(),
        strict=True,
    )
    shown = [
        (label, f"{label} {score:.0%}", box)
        for label, score, box in rows
        if score >= min_confidence
    ]
    for label, _, box in reversed(shown):
        draw.rectangle(box, outline=_colour(label), width=3)
    plates = list(taken)
    for label, text, box in shown:
        plate = free_plate(
            [plate_of(draw, corner, text) for corner in _corners(box, draw.im.size[1])],
            plates,
        )
        plates.append(plate)
        write_label(draw, plate[:2], text, _colour(label))


def _corners(box: Sequence[float], height: float) -> list[tuple[float, float]]:
    """Where the label of a box may begin, the best place first: above it, in it, at its
    right, below, anywhere.
    """
    x0, y0, x1, y1 = box
    inside = y0 + 2 if y0 < height else height
    lines = range(0, max(1, int(height) - _LINE), _LINE)
    return [
        *([(x0, y0 - _LINE)] if y0 >= _LINE else []),
        (x0, inside),
        *((x0, inside + line) for line in lines if inside + line + _LINE <= y1),
        (x1, inside),
        (x1, y1 - _LINE),
        (x0, y1 + 2),
        *((x, float(line)) for x in (x0, x1) for line in lines),
    ]


def difference(before: Sequence[Tensor], after: Sequence[Tensor]) -> NDArray[np.uint8]:
    """What changed in all views, amplified around grey; the factor is written into the
    image.
    """
    gaps = [b - a for a, b in zip(before, after, strict=True)]
    changed = torch.cat([gap.abs()[gap.abs().amax(-1) > 0].amax(-1) for gap in gaps])
    # The largest round factor that shows nearly every change without clipping; 1 at
    # least.
    if len(changed):
        typical = float(changed.sort().values[int(0.98 * (len(changed) - 1))])
    else:
        typical = 0.0
    factor = next((f for f in (100, 50, 20, 10, 5, 2) if f * typical <= 0.5), 1)
    pictures = []
    for gap in gaps:
        picture = _enlarged(to_bytes(0.5 + factor * gap))
        write_label(
            ImageDraw.Draw(picture),
            (6, 6),
            f"difference x {factor}, grey = none",
            "#000000",
        )
        pictures.append(np.asarray(picture))
    return stacked(pictures)


def stacked(pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """(H, W, 3) images below one another; narrower ones are filled up with black on
    the right.
    """
    width = max(picture.shape[1] for picture in pictures)
    return np.concatenate(
        [np.pad(p, ((0, 0), (0, width - p.shape[1]), (0, 0))) for p in pictures]
    )


def listed(detections: Detections) -> list[dict[str, Any]]:
    """Detections as JSON can hold them: label, score and box (x0, y0, x1, y1 in pixels)
    of each.
    """
    rows = zip(
        detections.labels,
        detections.scores.tolist(),
        detections.boxes.tolist(),
        strict=True,
    )
    return [
        {"label": a, "score": round(b, 6), "box": [round(x, 2) for x in c]}
        for a, b, c in rows
    ]


def _colour(label: str) -> str:
    # The same colour for a class in every image, whatever else was found.
    return _COLOURS[zlib.crc32(label.encode()) % len(_COLOURS)]


def _enlarged(pixels: NDArray[np.uint8], width: int = 512) -> Image.Image:
    """The image at a whole multiple of its size, at least so many pixels wide, so
    that labels are legible.
    """
    factor = max(1, -(-width // pixels.shape[1]))
    picture = Image.fromarray(pixels)
    return picture.resize(
        (picture.width * factor, picture.height * factor), Image.Resampling.NEAREST
    )
