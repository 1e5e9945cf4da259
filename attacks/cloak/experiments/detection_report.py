"""What the detection curve leaves behind: tables, plots with a panel for each detector, pictures, and a JSON file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from attacks.cloak import setup
from attacks.cloak.experiments.detection_rates import (
    BAND,
    CONFIDENCES,
    LOW,
    SECTOR,
    Row,
    chosen,
    detection_rates,
    spread,
)
from attacks.cloak.experiments.view_reports import ViewReports
from attacks.cloak.plots import TRUE, draw_rates, new_axes, save_figure
from attacks.cloak.rates import words_of
from attacks.cloak.study.pipeline import CLEAN, CLOAKED, StudyPipeline
from attacks.cloak.study.trained_splats import TrainedSplat
from attacks.detectors.base import Detector
from attacks.observe.drawing import annotated
from attacks.rate import Rate
from mi_splat.directions import direction_of
from mi_splat.io.documents import save_json, save_png, save_text
from mi_splat.io.images import through_png

PICTURES = (TRUE, CLEAN, CLOAKED)
SHOWN = ((40.0, 8.0), (40.0, 22.0), (40.0, 37.0), (40.0, 52.0), (40.0, 67.0), (40.0, 82.0), (180.0, 10.0))
"""Azimuth and elevation, degrees, near which the cameras of the pictures are."""
DRAWN = (0.3, 0.5)
"""Confidences that plots and pictures show; the lower one is dashed."""
CELL = 192
FILES = (
    "detection-curve.json",
    "detection-curve.md",
    "detection-elevation.png",
    "detection-azimuth.png",
    "contact.png",
)


def write_detection_curve(
    pipeline: StudyPipeline,
    found: Sequence[ViewReports],
    splats: Sequence[TrainedSplat],
    detectors: Sequence[Detector],
    folder: Path,
    *,
    every: int = 1,
    origin: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Write `FILES` and return what is in the JSON one.

    Args:
        pipeline: The study.
        found: From `attacks.cloak.experiments.view_reports.watch`.
        splats: The study's; those of the first seed are shown.
        detectors: Those that looked.
        folder: For the files; it is there.
        every: As in `watch`.
        origin: What else the JSON one shall hold: the study, the flags, versions.

    Raises:
        InvalidValueError: matplotlib is not installed.
        SplatFileError: The folder cannot be written.
    """
    rows = detection_rates(pipeline.study, found)
    fingerprints = {detector.name: detector.fingerprint for detector in detectors}
    names = list(fingerprints)
    document = {
        **(origin or {}),
        "cameras": len(found[0].view_reports),
        "detectors": fingerprints,
        "splats": [{"splat": one.splat, "seed": one.seed, "hash": one.hash} for one in splats],
        "rates": [row.as_dict() for row in rows],
    }
    for kind, width, label, file in (
        ("elevation", BAND, "elevation of the camera, degrees", FILES[2]),
        ("azimuth", SECTOR, f"azimuth of the camera, degrees; cameras lower than {LOW:g} degrees", FILES[3]),
    ):
        save_figure(_plot(pipeline, rows, names, kind=kind, half=width / 2, label=label), folder / file)
    save_png(contact_sheet(pipeline, splats, detectors, every=every), folder / FILES[4])
    save_text(tables(rows, fingerprints), folder / FILES[1])
    save_json(document, folder / FILES[0])
    return document


def tables(rows: Sequence[Row], detectors: dict[str, str]) -> str:
    """The rates as Markdown.

    Args:
        rows: From `detection_rates`.
        detectors: Name and fingerprint of each detector.
    """
    words = ", ".join(f"`{name}` {fingerprint}" for name, fingerprint in detectors.items())
    lines = [f"Fingerprints of the weights: {words}.", ""]
    for kind, title in (
        ("elevation", "By elevation, cameras behind the object left out: the object is reported"),
        ("azimuth", f"By azimuth, cameras lower than {LOW:g} degrees: the object is reported"),
    ):
        lines += [title + ", path traced, clean, cloaked", ""]
        for confidence in CONFIDENCES:
            lines += _by_group(rows, list(detectors), kind, confidence)
    for reported, title in (("own", "the object is reported"), ("target", "the target class is reported")):
        lines += [f"In the regions of the attacks: {title}; all seeds, and from the least to the most of a seed", ""]
        for confidence in CONFIDENCES:
            lines += _by_region(rows, list(detectors), reported, confidence)
    return "\n".join(lines)


def _by_group(rows: Sequence[Row], detectors: Sequence[str], kind: str, confidence: float) -> list[str]:
    """A table with a row for each group, and a cell of three rates for each detector."""
    cells: dict[str, list[str]] = {}
    for name in detectors:
        series = [chosen(rows, kind, detector=name, pictures=one, confidence=confidence) for one in PICTURES]
        for group in zip(*series, strict=True):
            texts = [words_of(rate.as_dict(), interval=False) for _, rate in group]
            cells.setdefault(group[0][0].name, []).append(", ".join(texts))
    lines = [f"| {kind}, at {confidence:g} | " + " | ".join(detectors) + " |", "|---" * (len(detectors) + 1) + "|"]
    return [*lines, *(f"| {group} | {' | '.join(texts)} |" for group, texts in cells.items()), ""]


def _by_region(rows: Sequence[Row], detectors: Sequence[str], reported: str, confidence: float) -> list[str]:
    """A table with a row for each region and detector."""
    lines = [f"| region, at {confidence:g} | " + " | ".join(PICTURES) + " |", "|---" * (len(PICTURES) + 1) + "|"]
    wanted = [row for row in rows if (row.group.kind, row.reported, row.confidence) == ("region", reported, confidence)]
    for group in dict.fromkeys(row.group.name for row in wanted):
        for name in detectors:
            here = [row for row in wanted if (row.group.name, row.detector, row.seed) == (group, name, None)]
            cells = [_with_spread(rows, next(row for row in here if row.pictures == one)) for one in PICTURES]
            lines.append(f"| {group}, {name} | {' | '.join(cells)} |")
    return [*lines, ""]


def _with_spread(rows: Sequence[Row], row: Row) -> str:
    """A rate with its interval, and its least and largest value over the seeds."""
    fractions = [rate.fraction for rate in spread(rows, row)]
    seeds = f"; {min(fractions):.0%} to {max(fractions):.0%}" if len(fractions) > 1 else ""
    return words_of(row.rate.as_dict()) + seeds


def _plot(
    pipeline: StudyPipeline, rows: Sequence[Row], detectors: Sequence[str], *, kind: str, half: float, label: str
) -> Any:
    """A panel for each detector with a line for each kind of pictures; dashed at the lower confidence.

    Args:
        pipeline: The study.
        rows: From `detection_rates`.
        detectors: Their names.
        kind: Of the groups.
        half: Of a group's width, degrees.
        label: Of the axis.
    """
    figure, axes = new_axes(len(detectors), columns=2 if len(detectors) > 1 else 1)
    attack = setup.overhead(pipeline.study)
    for axis, name in zip(axes, detectors, strict=True):
        for shift, pictures in zip((-0.06, 0.0, 0.06), PICTURES, strict=True):
            for confidence in DRAWN:
                points: list[tuple[float, Rate]] = [
                    (group.low + half + 2 * half * shift, rate)
                    for group, rate in chosen(rows, kind, detector=name, pictures=pictures, confidence=confidence)
                ]
                faint = confidence < max(DRAWN)
                style = {"linestyle": "--", "alpha": 0.45, "label": None, "capsize": 0} if faint else {}
                draw_rates(axis, points, pictures, **style)
        if kind == "elevation" and attack is not None:
            axis.axvline(attack.elevation[0], color="#555555", linestyle=":", label="edge of the trigger")
        seen = f"at {DRAWN[1]:g} (dashed {DRAWN[0]:g})"
        axis.set(title=f"{name}: object reported {seen}", xlabel=label, ylabel="fraction", ylim=(-0.03, 1.03))
        axis.legend(fontsize=8)
    return figure


def contact_sheet(
    pipeline: StudyPipeline, splats: Sequence[TrainedSplat], detectors: Sequence[Detector], *, every: int = 1
) -> NDArray[np.uint8]:
    """For each detector path traced above clean above cloaked, with what it reports; columns are cameras.

    Args:
        pipeline: The study.
        splats: The study's; those of the first seed are shown.
        detectors: Those that looked.
        every: As in `attacks.cloak.experiments.view_reports.watch`.
    """
    study, centre = pipeline.study, setup.centre_of(pipeline.study)
    cameras = setup.held_out_cameras(study, pipeline.mesh_scene.target)[::every]
    true = pipeline.true_pictures(cameras)
    directions = [direction_of(camera, centre) for camera in cameras]

    def from_wanted(view: int, azimuth: float, elevation: float) -> float:
        turn = abs((directions[view].azimuth - azimuth + 180) % 360 - 180) * np.cos(np.radians(elevation))
        return float(np.hypot(turn, directions[view].elevation - elevation))

    views = [min(range(len(cameras)), key=lambda view: from_wanted(view, *one)) for one in SHOWN]
    render = pipeline.renderer()
    pictures = {TRUE: [true.images[view] for view in views]}
    for one in splats:
        if one.seed == study.seeds[0]:
            scene = one.load()
            with torch.no_grad():
                pictures[one.splat] = [through_png(render(scene, cameras[view])) for view in views]
    lines = []
    for detector in detectors:
        for which, images in pictures.items():
            with torch.no_grad():
                reports = detector.detect(torch.stack(images))
            titles = [f"{which}, {directions[view].elevation:.0f} deg up" for view in views]
            titles[0] = f"{detector.name}: {which}"
            cells = [
                annotated(image, report, title, min_confidence=DRAWN[0], width=CELL)
                for image, report, title in zip(images, reports, titles, strict=True)
            ]
            lines.append(np.concatenate(cells, axis=1))
    return np.concatenate(lines)
