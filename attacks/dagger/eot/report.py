"""What an attack on a distribution of views leaves behind: held-out pictures, the attacked splat, and one JSON."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from attacks.dagger.eot.judging import JudgedView
from attacks.dagger.eot.rates import eot_figures
from attacks.dagger.eot.result import EotResult
from attacks.dagger.eot.search import NOT_JUDGED
from attacks.observe.drawing import annotated, stacked
from mi_splat.io import save_splat
from mi_splat.io.documents import save_json, save_png
from mi_splat.io.folders import RECORD, new_folder

CONTACT = "held_out.png"


def write_eot_report(result: EotResult, folder: str | Path, *, force: bool = False) -> dict[str, Path]:
    """Write held_out.png, attacked.ply and result.json. The folder appears whole or not at all.

    Args:
        result: What the attack did.
        folder: A new folder; those above it are made.
        force: Whether it may replace an older result.

    Returns:
        Path of every file by its name.

    Raises:
        SplatFileError: The folder is in use or cannot be written.
    """
    with new_folder(folder, force=force) as place:
        names = [path.name for path in write_eot_files(result, place)]
    return {name: Path(folder) / name for name in names}


def write_eot_files(result: EotResult, folder: Path) -> list[Path]:
    """Write the files of `write_eot_report` into a folder that is there; returns their paths."""
    save_png(contact_sheet(result), folder / CONTACT)
    save_splat(result.scene, folder / "attacked.ply")
    save_json(eot_summary(result), folder / RECORD)
    return [folder / name for name in (CONTACT, "attacked.ply", RECORD)]


def eot_summary(result: EotResult) -> dict[str, Any]:
    """The result as JSON can hold it; keys are explained in `EotResult` and `EotConfig`."""
    config, judgement = result.config, result.judgement
    return {
        "attack": "dagger-eot",
        "objective": result.objective.name,
        "target": result.objective.label,
        "success": result.success,
        **eot_figures(result.frame, result.detectors, result.judged.cameras.elevations),
        "image_psnr": judgement.image.psnr,
        "psnr_definition": "of the mean squared error over all pixels of all held-out views, 8 bits, in dB",
        "image": dataclasses.asdict(judgement.image),
        "noise_psnr": [image.psnr for image in judgement.noise_images],
        "steps": result.best.index,
        "norm": config.norm,
        "eps": config.eps[0] if len(config.eps) == 1 else None,
        "radius": config.radius,
        "used": result.used,
        "used_in_file": result.used_in_file,
        "space": "splat file: SH, world units, log-scales, quaternions before normalisation, logit opacities",
        "changed_gaussians": result.changed_gaussians,
        "object_gaussians": result.object_gaussians,
        "redraws": result.redraws,
        "warnings": list(result.warnings),
        "views": result.rows,
        "trace": [_line(dataclasses.asdict(line)) for line in result.trace],
        "seed": config.seed,
        "config": {
            **dataclasses.asdict(config),
            "transformations": dataclasses.asdict(result.transformations),
            "judged": dataclasses.asdict(result.judged),
            "objective": dataclasses.asdict(result.objective) if dataclasses.is_dataclass(result.objective) else {},
        },
        **result.origin,
        "seconds": round(result.seconds, 3),
    }


def _line(line: dict[str, Any]) -> dict[str, Any]:
    """A line of the trace; what was not judged has no verdict."""
    if line["score"] == NOT_JUDGED:
        return {"index": line["index"], "loss": line["loss"]}
    return {name: line[name] for name in ("index", "loss", "score", "success")}


def contact_sheet(
    result: EotResult, *, most: int = 8, columns: int = 2, side: int = 384, min_confidence: float = 0.3
) -> NDArray[np.uint8]:
    """Held-out views with boxes, evenly around the object: the clean picture beside the attacked one.

    Args:
        result: The attack.
        most: Views shown, by the first detector.
        columns: Pairs of pictures beside each other.
        side: Width of a picture, pixels.
        min_confidence: Confidence from which a detection is drawn, in [0, 1].
    """
    views = [one for one in result.judgement.views if one.detector == result.detectors[0]]
    views.sort(key=lambda one: one.view.direction.azimuth)
    count = min(most, len(views))
    pairs = [_pair(views[place * len(views) // count], side, min_confidence) for place in range(count)]
    rows = [pairs[first : first + columns] for first in range(0, count, columns)]
    return stacked([np.concatenate(row, axis=1) for row in rows])


def _pair(one: JudgedView, side: int, min_confidence: float) -> NDArray[np.uint8]:
    """One view: clean beside attacked, each `side` pixels wide."""
    direction = one.view.direction
    sides = ((one.images[0], one.clean, "clean"), (one.images[1], one.attacked, "attacked"))
    found = []
    for image, detections, name in sides:
        title = f"{name}, {direction.azimuth:.0f} / {direction.elevation:.0f}"
        large = Image.fromarray(annotated(image, detections, title, min_confidence=min_confidence))
        small = large.resize((side, max(1, round(large.height * side / large.width))), Image.Resampling.LANCZOS)
        found.append(np.asarray(small))
    return np.concatenate(found, axis=1)
