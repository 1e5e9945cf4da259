"""What an attack leaves behind: pictures, the attacked splat, and one self-describing JSON."""

from __future__ import annotations

import dataclasses
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from attacks.dagger.attack import Result
from attacks.dagger.problem import ViewResult
from attacks.detectors.base import Detections
from mi_splat.io import save_splat
from mi_splat.io.documents import save_json, save_png
from mi_splat.io.images import to_bytes

_COLOURS = ("#e6194b", "#3cb44b", "#4363d8", "#f58231", "#911eb4", "#008080", "#9a6324", "#000075")


def write_report(result: Result, folder: Path) -> dict[str, Path]:
    """Write before.png, after.png, difference.png, detections.png, attacked.ply and result.json.

    Several views make one picture each, below one another. Every file appears whole or not at all; result.json comes
    last, so a folder that holds one is complete.

    Args:
        result: What the attack did.
        folder: Made if it is not there.

    Returns:
        Path of every file by its name.

    Raises:
        SplatFileError: The folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    images = {
        "before.png": _stacked([to_bytes(view.before.image) for view in result.views]),
        "after.png": _stacked([to_bytes(view.after) for view in result.views]),
        "difference.png": difference(result),
        "detections.png": _stacked([detections(view) for view in result.views]),
    }
    for name, pixels in images.items():
        save_png(pixels, folder / name)
    save_splat(result.scene, folder / "attacked.ply")
    save_json(summary(result), folder / "result.json")
    return {name: folder / name for name in (*images, "attacked.ply", "result.json")}


def summary(result: Result) -> dict[str, Any]:
    """The result as JSON-ready values; every key is explained in docs of `Result` and `DaggerConfig`."""
    config, image = result.config, result.image
    return {
        "attack": "dagger",
        "objective": result.objective.name,
        "success": result.success,
        "unambiguous": result.verdict.unambiguous,
        "target": result.objective.label,
        "target_confidence": result.target_confidence,
        "score": result.score,
        "steps": result.best.index,
        "norm": config.norm,
        "eps": config.eps[0] if len(config.eps) == 1 else None,
        "radius": dict(config.budget.radius),
        "used": result.used,
        "used_in_file": result.in_file,
        "space": "splat file: SH, world units, log-scales, quaternions before normalisation, logit opacities",
        "changed_gaussians": result.changed,
        "object_gaussians": result.size,
        "image_psnr": image.psnr,
        "image": dataclasses.asdict(image),
        "clamped_fraction": result.clamped,
        "zero_gradient_fraction": [line.zero_gradient_fraction for line in result.trace],
        "noise": {**dataclasses.asdict(result.noise), "draws": len(result.noise.scores)},
        "warnings": list(result.warnings),
        "views": [_view(view, result.objective.label) for view in result.views],
        "trace": [dataclasses.asdict(line) for line in result.trace],
        "seed": config.seed,
        "config": {
            **dataclasses.asdict(config),
            "objective": dataclasses.asdict(result.objective) if dataclasses.is_dataclass(result.objective) else {},
        },
        **result.origin,
        "seconds": round(result.seconds, 3),
    }


def _view(view: ViewResult, label: str | None) -> dict[str, Any]:
    target, camera = view.before.target, view.before.camera
    original = target.original
    return {
        "success": view.verdict.success,
        "unambiguous": view.verdict.unambiguous,
        "original": original,
        "clean_confidence": view.confidence(original, attacked=False) if original else 0.0,
        "original_confidence": view.confidence(original, attacked=True) if original else 0.0,
        "target_confidence": view.confidence(label, attacked=True) if label else None,
        "target_confidence_clean": view.confidence(label, attacked=False) if label else None,
        "box": [round(float(x), 2) for x in target.box],
        "clean": _listed(view.before.detections),
        "attacked": _listed(view.attacked),
        "camera": {
            "to_world": camera.to_world.tolist(),
            "focal": [camera.fx, camera.fy],
            "principal": [camera.cx, camera.cy],
            "size": [camera.width, camera.height],
        },
    }


def _listed(found: Detections) -> list[dict[str, Any]]:
    rows = zip(found.labels, found.scores.tolist(), found.boxes.tolist(), strict=True)
    return [{"label": a, "score": round(b, 6), "box": [round(x, 2) for x in c]} for a, b, c in rows]


def difference(result: Result) -> NDArray[np.uint8]:
    """What changed in all views, amplified around grey; the factor is written into the picture.

    Returns:
        (H, W, 3): 128 + factor * (after - before), enlarged to be legible.
    """
    gaps = [view.after - view.before.image for view in result.views]
    changed = torch.cat([gap.abs()[gap.abs().amax(-1) > 0].amax(-1) for gap in gaps])
    # The largest round factor that shows nearly every change without clipping; 1 at least.
    typical = float(changed.sort().values[int(0.98 * (len(changed) - 1))]) if len(changed) else 0.0
    factor = next((f for f in (100, 50, 20, 10, 5, 2) if f * typical <= 0.5), 1)
    pictures = []
    for gap in gaps:
        picture = _enlarged(to_bytes(0.5 + factor * gap))
        _write(ImageDraw.Draw(picture), (6, 6), f"difference x {factor}, grey = none", "#000000")
        pictures.append(np.asarray(picture))
    return _stacked(pictures)


def detections(view: ViewResult, *, least: float = 0.3) -> NDArray[np.uint8]:
    """Boxes and confidences before (left) and after (right), of detections that score at least `least`."""
    sides = ((view.before.image, view.before.detections, "before"), (view.after, view.attacked, "after"))
    return np.concatenate([annotated(*side, least=least) for side in sides], axis=1)


def annotated(
    picture: Tensor, found: Detections, title: str, *, least: float = 0.3, width: int = 512
) -> NDArray[np.uint8]:
    """A picture with the boxes and confidences of the detections that score at least `least`, and a title.

    Args:
        picture: (H, W, 3) sRGB in [0, 1].
        found: What is in it.
        title: Written into the lower left corner.
        least: Confidence.
        width: Pixels that the result is wide, at least; it is a whole multiple of the picture.
    """
    canvas = _enlarged(to_bytes(picture), width)
    draw, scale = ImageDraw.Draw(canvas), canvas.width / picture.shape[1]
    for label, score, box in reversed(
        list(zip(found.labels, found.scores.tolist(), found.boxes.tolist(), strict=True))
    ):
        if score >= least:
            colour = _colour(label)
            x0, y0, x1, y1 = (scale * x for x in box)
            draw.rectangle((x0, y0, x1, y1), outline=colour, width=3)
            _write(draw, (x0, y0 - 22 if y0 >= 22 else y0 + 2), f"{label} {score:.0%}", colour)
    _write(draw, (6, canvas.height - 26), title, "#000000")
    return np.asarray(canvas)


def _colour(label: str) -> str:
    # The same colour for a class in every picture, whatever else was found.
    return _COLOURS[zlib.crc32(label.encode()) % len(_COLOURS)]


def _write(draw: ImageDraw.ImageDraw, corner: tuple[float, float], text: str, colour: str) -> None:
    """Text in white on a filled plate, kept inside the picture."""
    font = ImageFont.load_default(size=16)
    left, top, right, bottom = draw.textbbox((0, 0), text, font=font)
    width, height = right - left + 8, bottom - top + 6
    x = min(max(corner[0], 0), max(draw.im.size[0] - width, 0))
    y = min(max(corner[1], 0), max(draw.im.size[1] - height, 0))
    draw.rectangle((x, y, x + width, y + height), fill=colour)
    draw.text((x + 4 - left, y + 3 - top), text, fill="#ffffff", font=font)


def _enlarged(pixels: NDArray[np.uint8], width: int = 512) -> Image.Image:
    """The picture at a whole multiple of its size, at least so many pixels wide, so that labels are legible."""
    factor = max(1, -(-width // pixels.shape[1]))
    picture = Image.fromarray(pixels)
    return picture.resize((picture.width * factor, picture.height * factor), Image.Resampling.NEAREST)


def _stacked(pictures: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Pictures below one another; narrower ones are filled up with black on the right."""
    width = max(picture.shape[1] for picture in pictures)
    return np.concatenate([np.pad(p, ((0, 0), (0, width - p.shape[1]), (0, 0))) for p in pictures])
