"""What an attack leaves behind: images, the attacked splat, and one self-describing
JSON.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from attacks.dagger.figures import DRAWN, FIXED
from attacks.dagger.result import JudgedView, Result, Seen
from attacks.figures.frame import write_figures
from attacks.observe.drawing import annotated, difference, listed, stacked
from attacks.observe.views import CAMERAS, cameras_document
from attacks.search.loop import NOT_JUDGED
from mi_splat.io import save_splat
from mi_splat.io.camera_records import describe, values_of
from mi_splat.io.documents import save_json, save_png
from mi_splat.io.folders import RECORD, new_folder
from mi_splat.io.images import to_bytes

CONTACT = "held_out.png"
"""Held-out views of an attack on a distribution."""

ATTACKED = "attacked.ply"
_PAIRS = 8
_COLUMNS = 2
_WIDTH = 384
"""Of the contact sheet: views, pairs of images beside each other, and pixels across an
image.
"""
_DRAWN = 0.3
"""Confidence from which a detection is drawn."""


def write_report(
    result: Result, folder: str | Path, *, force: bool = False
) -> dict[str, Path]:
    """Write images, attacked.ply, result.json, cameras.json, and the rows of what was
    seen.

    The images of fixed views are before.png, after.png, difference.png and
    detections.png: several views make one image each, below one another; in
    detections.png several detectors do so, too. Those of drawn views are held_out.png.
    The folder appears whole or not at all.

    Args:
        result: What the attack did.
        folder: A new folder; those above it are made.
        force: Whether it may replace an older result.

    Returns:
        Path of every file by its name.

    Raises:
        SplatFileError: The folder is in use or cannot be written.
    """
    with new_folder(folder, force=force) as made:
        names = [path.name for path in write_files(result, made)]
    return {name: Path(folder) / name for name in names}


def write_files(result: Result, folder: Path) -> list[Path]:
    """Write the files of `write_report` into a folder that exists."""
    images = {CONTACT: contact_sheet(result)} if result.drawn else _pictures(result)
    for name, pixels in images.items():
        save_png(pixels, folder / name)
    save_splat(
        result.scene,
        folder / ATTACKED,
        antialiased=bool(result.origin.get("antialiased")),
    )
    save_json(_cameras(result), folder / CAMERAS, indent=0)
    save_json(summary(result), folder / RECORD)
    return [
        *(folder / name for name in (*images, ATTACKED, CAMERAS, RECORD)),
        *result.looked.write(folder),
        write_figures(result.figures, folder),
    ]


def _cameras(result: Result) -> dict[str, Any]:
    """cameras.json: each view once, as the first detector sees it."""
    entries = [
        {
            **describe(str(judged.view.index), judged.view.camera),
            "box": judged.target.box.tolist(),
            "change": dataclasses.asdict(judged.view.change),
        }
        for judged in result.pictures
    ]
    rendered = {
        name: result.origin[name]
        for name in ("background", "near", "antialiased")
        if name in result.origin
    }
    return cameras_document(entries, **rendered)


def summary(result: Result) -> dict[str, Any]:
    """The result as JSON can hold it; keys are explained in `Result` and in its
    configuration.

    What is counted from the rows stands beside it, in figures.csv.
    """
    config = result.config
    image = result.image
    thresholds = {view.detector: view.target.threshold for view in result.views}
    return {
        "story": DRAWN if result.drawn else FIXED,
        "success": result.success,
        "objective": result.objective.name,
        "target": result.objective.label,
        "steps": result.best.index,
        "evaluations": len(result.trace),
        "cpu_seconds": round(result.cpu_seconds, 3),
        "loss": min(line.loss for line in result.trace),
        "norm": config.norm,
        "eps": config.eps[0] if len(config.eps) == 1 else None,
        "radius": config.radius,
        "used": result.used,
        "used_in_file": result.used_in_file,
        "space": (
            "splat file: SH, world units, log-scales, quaternions before normalisation,"
            " logit opacities"
        ),
        "changed_gaussians": result.changed_gaussians,
        "object_gaussians": result.object_gaussians,
        "image_psnr": image.psnr,
        "psnr_definition": (
            "of the mean squared error over all pixels of all evaluation views, 8 bits,"
            " in dB"
        ),
        "image": dataclasses.asdict(image),
        "clamped_fraction": result.clamped_fraction,
        "zero_gradient_fraction": [
            line.zero_gradient_fraction for line in result.trace
        ],
        "control_psnr": _control_psnr(result),
        "redraws": result.redraws,
        **_levels(result),
        "warnings": list(result.warnings),
        "detectors": [
            {
                "detector": name,
                "detector_fingerprint": mark,
                "threshold": thresholds[name],
            }
            for name, mark in result.fingerprints.items()
        ],
        "views": [_view(view) for view in result.views],
        "trace": [_line(dataclasses.asdict(line)) for line in result.trace],
        "seed": config.seed,
        "config": {**dataclasses.asdict(config), **_settings(result)},
        **result.origin,
        "seconds": round(result.seconds, 3),
    }


def _control_psnr(result: Result) -> dict[str, list[float | None]]:
    """PSNR on the object of every draw, by the name of the control."""
    lists: dict[str, list[float | None]] = {}
    for (name, _), change in result.control_images.items():
        lists.setdefault(name, []).append(change.psnr_object)
    return lists


def _levels(result: Result) -> dict[str, Any]:
    """What each level of a ladder has led to, if there is one."""
    if not result.levels:
        return {}
    return {"levels": [dataclasses.asdict(level) for level in result.levels]}


def _settings(result: Result) -> dict[str, Any]:
    """The aim, and where views are drawn from if they are."""
    parts = {
        "objective": result.objective,
        "transformations": result.transformations,
        "evaluation": result.evaluation,
    }
    plain = {
        name: value
        for name, value in parts.items()
        if name == "objective" or value is not None
    }
    return {
        name: (
            {key: _plain(part) for key, part in dataclasses.asdict(value).items()}
            if dataclasses.is_dataclass(value) and not isinstance(value, type)
            else {}
        )
        for name, value in plain.items()
    }


def _plain(value: Any) -> Any:
    """A setting as JSON can hold it: of a function its name."""
    if callable(value):
        return f"{value.__module__}.{value.__qualname__}"
    return value


def _line(line: dict[str, Any]) -> dict[str, Any]:
    """A line of the trace; what was not judged has no verdict."""
    if line["score"] == NOT_JUDGED:
        return {"index": line["index"], "loss": line["loss"]}
    return line


def _view(judged: JudgedView) -> dict[str, Any]:
    """A view as a detector saw it, besides what is counted."""
    view = judged.view
    return {
        "index": view.index,
        "detector": judged.detector,
        "azimuth": view.direction.azimuth,
        "elevation": view.direction.elevation,
        "position": view.camera.position.tolist(),
        "camera": values_of(view.camera),
        "change": dataclasses.asdict(view.change),
        "box": [round(float(corner), 2) for corner in judged.target.box],
        "clean": listed(judged.clean.detections),
        "attacked": listed(judged.attacked.detections),
    }


def _pictures(result: Result) -> dict[str, NDArray[np.uint8]]:
    """The images of fixed views, by the names of their files."""
    views = result.pictures
    before = [view.clean.image for view in views]
    after = [view.attacked.image for view in views]
    named = len(result.detectors) > 1
    return {
        "before.png": stacked([to_bytes(image) for image in before]),
        "after.png": stacked([to_bytes(image) for image in after]),
        "difference.png": difference(before, after),
        "detections.png": stacked(
            [before_and_after(view, named=named) for view in result.views]
        ),
    }


def before_and_after(view: JudgedView, *, named: bool = False) -> NDArray[np.uint8]:
    """Boxes and confidences before (left) and after (right)."""
    of = f" ({view.detector})" if named else ""
    sides = [_boxes(view.clean, f"before{of}"), _boxes(view.attacked, f"after{of}")]
    return np.concatenate(sides, axis=1)


def _boxes(seen: Seen, title: str) -> NDArray[np.uint8]:
    return annotated(seen.image, seen.detections, title, min_confidence=_DRAWN)


def contact_sheet(result: Result) -> NDArray[np.uint8]:
    """Held-out views of the first detector with boxes, evenly around the object: clean
    beside attacked images.
    """
    views = sorted(result.pictures, key=lambda judged: judged.view.direction.azimuth)
    count = min(_PAIRS, len(views))
    pairs = [_pair(views[number * len(views) // count]) for number in range(count)]
    rows = [pairs[first : first + _COLUMNS] for first in range(0, count, _COLUMNS)]
    return stacked([np.concatenate(row, axis=1) for row in rows])


def _pair(judged: JudgedView) -> NDArray[np.uint8]:
    """One view: clean beside attacked, each `_WIDTH` pixels wide."""
    direction = judged.view.direction
    sides = []
    for seen, name in ((judged.clean, "clean"), (judged.attacked, "attacked")):
        title = f"{name}, {direction.azimuth:.0f} / {direction.elevation:.0f}"
        large = Image.fromarray(_boxes(seen, title))
        small = large.resize(
            (_WIDTH, max(1, round(large.height * _WIDTH / large.width))),
            Image.Resampling.LANCZOS,
        )
        sides.append(np.asarray(small))
    return np.concatenate(sides, axis=1)
