"""What an attack leaves behind: pictures, the attacked splat, and one self-describing JSON."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attacks.dagger.ensemble import DetectorResult
from attacks.dagger.problem import ViewResult
from attacks.dagger.result import Result
from attacks.observe.drawing import annotated, difference, listed, stacked
from mi_splat.io import save_splat
from mi_splat.io.camera_records import values_of
from mi_splat.io.documents import save_json, save_png
from mi_splat.io.folders import RECORD, new_folder
from mi_splat.io.images import to_bytes


def write_report(result: Result, folder: str | Path, *, force: bool = False) -> dict[str, Path]:
    """Write before.png, after.png, difference.png, detections.png, attacked.ply and result.json.

    Several views make one picture each, below one another; in detections.png several detectors do so, too. The folder
    appears whole or not at all.

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
        names = [path.name for path in write_files(result, place)]
    return {name: Path(folder) / name for name in names}


def write_files(result: Result, folder: Path) -> list[Path]:
    """Write the files of `write_report` into a folder that is there; returns their paths."""
    several = len(result.detectors) > 1
    views = result.detectors[0].views  # every detector looked at the same pictures
    images = {
        "before.png": stacked([to_bytes(view.before.image) for view in views]),
        "after.png": stacked([to_bytes(view.after.image) for view in views]),
        "difference.png": difference([view.before.image for view in views], [view.after.image for view in views]),
        "detections.png": stacked([before_and_after(view, named=several) for view in result.views]),
    }
    for name, pixels in images.items():
        save_png(pixels, folder / name)
    save_splat(result.scene, folder / "attacked.ply")
    save_json(summary(result), folder / RECORD)
    return [folder / name for name in (*images, "attacked.ply", RECORD)]


def summary(result: Result) -> dict[str, Any]:
    """The result as JSON can hold it; keys are explained in `Result` and `DaggerConfig`."""
    config, image = result.config, result.image
    return {
        "attack": "dagger",
        "objective": result.objective.name,
        "success": result.success,
        "unambiguous": result.verdict.unambiguous,
        "strict": result.strict,
        "target": result.objective.label,
        "target_confidence": result.target_confidence,
        "score": result.score,
        "steps": result.best.index,
        "norm": config.norm,
        "eps": config.eps[0] if len(config.eps) == 1 else None,
        "radius": config.radius,
        "used": result.used,
        "used_in_file": result.used_in_file,
        "space": "splat file: SH, world units, log-scales, quaternions before normalisation, logit opacities",
        "changed_gaussians": result.changed_gaussians,
        "object_gaussians": result.object_gaussians,
        "image_psnr": image.psnr,
        "image": dataclasses.asdict(image),
        "clamped_fraction": result.clamped_fraction,
        "zero_gradient_fraction": [line.zero_gradient_fraction for line in result.trace],
        "noise": {
            "scores": list(result.noise.scores),
            "successes": result.noise.successes,
            "draws": len(result.noise.scores),
        },
        "warnings": list(result.warnings),
        "detectors": [_detector(result, one) for one in result.detectors],
        "views": [
            {**_view(view, result.objective.label), **_noise(result, place)} for place, view in enumerate(result.views)
        ],
        "trace": [dataclasses.asdict(line) for line in result.trace],
        "seed": config.seed,
        "config": {
            **dataclasses.asdict(config),
            "objective": dataclasses.asdict(result.objective) if dataclasses.is_dataclass(result.objective) else {},
        },
        **result.origin,
        "seconds": round(result.seconds, 3),
    }


def _detector(result: Result, one: DetectorResult) -> dict[str, Any]:
    wanted = result.objective.label is not None
    return {
        "detector": one.detector,
        "detector_fingerprint": one.fingerprint,
        "success": one.verdict.success,
        "unambiguous": one.verdict.unambiguous,
        "score": one.verdict.score,
        "target_confidence": result.target_confidence_of(one) if wanted else None,
    }


def confidences(confidence: Callable[..., float], original: str | None, label: str | None) -> dict[str, Any]:
    """What a detector says of the object in one view, before and after.

    Args:
        confidence: Of a class, `attacked` or not.
        original: The class that was reported before; None if none was.
        label: The class that is wanted; None if none is.
    """
    return {
        "original": original,
        "clean_confidence": confidence(original, attacked=False) if original else 0.0,
        "original_confidence": confidence(original, attacked=True) if original else 0.0,
        "target_confidence": confidence(label, attacked=True) if label else None,
        "target_confidence_clean": confidence(label, attacked=False) if label else None,
    }


def _view(view: ViewResult, label: str | None) -> dict[str, Any]:
    target = view.before.target
    original = target.original
    return {
        "detector": view.after.detector,
        "success": view.verdict.success,
        "unambiguous": view.verdict.unambiguous,
        **confidences(view.confidence, original, label),
        "box": [round(float(x), 2) for x in target.box],
        "clean": listed(view.before.detections),
        "attacked": listed(view.after.detections),
        "camera": values_of(view.before.camera),
    }


def _noise(result: Result, place: int) -> dict[str, Any]:
    """What each draw of noise reached in one of the views."""
    verdicts = [draw[place] for draw in result.noise.views]
    return {
        "noise_scores": [verdict.score for verdict in verdicts],
        "noise_successes": [verdict.success for verdict in verdicts],
    }


def before_and_after(view: ViewResult, *, min_confidence: float = 0.3, named: bool = False) -> NDArray[np.uint8]:
    """Boxes and confidences before (left) and after (right).

    Args:
        view: The view.
        min_confidence: Confidence from which a detection is drawn, in [0, 1].
        named: Whether to write the detector's name into the pictures.
    """
    of = f" ({view.after.detector})" if named else ""
    sides = ((view.before.image, view.before.detections, "before"), (view.after.image, view.after.detections, "after"))
    drawn = [
        annotated(image, detections, f"{when}{of}", min_confidence=min_confidence) for image, detections, when in sides
    ]
    return np.concatenate(drawn, axis=1)
