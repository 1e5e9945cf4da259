"""The pictures of a study: clean beside cloaked from many sides, and what detectors say by elevation and azimuth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import torch
from numpy.typing import NDArray

from attacks.cloak.study import setup
from attacks.cloak.study.figure_files import COLOURS, draw_rates, new_axes, save_figure
from attacks.cloak.study.pipeline import CLEAN, CLOAKED, StudyPipeline
from attacks.cloak.study.rates import BIN, by_elevation, place_of, transition
from attacks.cloak.study.rows import DEPTH, SCORE, StudyRows
from attacks.cloak.study.trained_splats import TrainedSplat
from attacks.detectors.base import Detector
from attacks.observe.drawing import annotated
from mi_splat.camera_sets import orbit
from mi_splat.cameras import Camera
from mi_splat.io.documents import save_png
from mi_splat.io.images import through_png

SIDE_AZIMUTH = 40.0
ELEVATIONS = (5, 15, 25, 35, 45, 55, 65, 75, 85)
AZIMUTHS = (0, 45, 90, 135, 150, 165, 180, 195, 210)
LOW = 15
"""Elevation of the cameras of a contact sheet that go around, degrees."""
CELL = 256
MANY = 7
"""Values of a variation: with more of them there is room for their names alone."""
_VARIED = (
    ("trigger_miss_rate", "missed inside", "#d62728"),
    ("nothing_reported", "nothing of any class reported inside", "#9467bd"),
    ("benign_recall", "found elsewhere", "#1f77b4"),
    ("target_rate", "target class reported", "#2ca02c"),
)
"""What is drawn over the values of a variation."""


def contact_sheet(pipeline: StudyPipeline, splats: Sequence[TrainedSplat], detector: Detector) -> NDArray[np.uint8]:
    """Clean above cloaked, over elevation and then around, with what the detector reports."""
    study = pipeline.study
    lens = setup.lens_of(study, pipeline.mesh_scene.target)
    centre = setup.centre_of(study)

    def camera(azimuth: float, elevation: float) -> Camera:
        return orbit(centre, count=1, elevation=elevation, start=azimuth, **lens)[0]  # type: ignore[arg-type]

    rising = [(f"{elevation} deg up", camera(SIDE_AZIMUTH, elevation)) for elevation in ELEVATIONS]
    around = [(f"azimuth {azimuth}", camera(azimuth, LOW)) for azimuth in AZIMUTHS]
    scenes = {splat.splat: splat.load() for splat in splats}
    render = pipeline.renderer()
    rows = []
    for cameras in (rising, around):
        for which, scene in scenes.items():
            with torch.no_grad():
                pictures = [through_png(render(scene, one)) for _, one in cameras]
            seen = detector.detect(torch.stack(pictures))
            titles = [f"{which}, {name}" for name, _ in cameras]
            rows.append(
                np.concatenate(
                    [
                        annotated(picture, found, title, min_confidence=study.evaluation.confidence, width=CELL)
                        for picture, found, title in zip(pictures, seen, titles, strict=True)
                    ],
                    axis=1,
                )
            )
    return np.concatenate(rows)


def write_figures(
    pipeline: StudyPipeline,
    seen: StudyRows,
    splats: Sequence[TrainedSplat],
    detectors: Sequence[Detector],
    folder: Path,
) -> list[str]:
    """Write contact.png, elevation.png, azimuth.png and transition.png; returns their names.

    Args:
        pipeline: The study.
        seen: What was seen of every splat.
        splats: Those of the contact sheet.
        detectors: Those that observed them; the first one's boxes are on the contact sheet.
        folder: For the pictures.

    Raises:
        InvalidValueError: matplotlib is not installed.
        SplatFileError: The folder cannot be written.
    """
    save_png(contact_sheet(pipeline, splats, detectors[0]), folder / "contact.png")
    save_figure(_elevation(pipeline, seen), folder / "elevation.png")
    save_figure(_azimuth(pipeline, seen), folder / "azimuth.png")
    names = ["contact.png", "elevation.png", "azimuth.png"]
    if transition(pipeline.study, seen) is not None:
        save_figure(_transition(pipeline, seen), folder / "transition.png")
        names.append("transition.png")
    return names


def write_variation(group: str, results: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Write a plot of rates, with their intervals, over the values of what was varied.

    Args:
        group: What was varied.
        results: For each value, the summary of its study.
        path: A PNG.

    Raises:
        InvalidValueError: matplotlib is not installed.
        SplatFileError: The file cannot be written.
    """
    detectors = list(next(iter(results.values()))["by_detector"])
    figure, axes = new_axes(len(detectors))
    many = len(results) > MANY
    ticks = list(results) if many else [_tick(name, summary) for name, summary in results.items()]
    turned = {"rotation": 45, "ha": "right", "rotation_mode": "anchor"} if many else {}
    for axis, detector in zip(axes, detectors, strict=True):
        for shift, (key, words, colour) in zip((-0.12, -0.04, 0.04, 0.12), _VARIED, strict=True):
            rates = [summary["by_detector"][detector].get(key) for summary in results.values()]
            shown = [(place + shift, rate) for place, rate in enumerate(rates) if rate is not None and rate["total"]]
            fractions = np.array([rate["rate"] for _, rate in shown])
            low, high = np.array([rate["interval"] for _, rate in shown]).reshape(-1, 2).T
            bars = np.maximum([fractions - low, high - fractions], 0.0)
            style = {"marker": "o", "markersize": 4, "capsize": 2, "linestyle": "none"}
            axis.errorbar([place for place, _ in shown], fractions, yerr=bars, color=colour, label=words, **style)
        axis.set(title=f"{detector}, by {group}", ylabel="fraction of cameras", ylim=(-0.03, 1.03))
        axis.set_xticks(range(len(ticks)), ticks, **turned)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    save_figure(figure, path)


def _tick(name: str, summary: Mapping[str, Any]) -> str:
    """What stands below a value: its name, the transition, and what is lost beside the object."""
    band, price = summary["transition_degrees"], summary.get("stealth")
    parts = [name] if band is None else [name, f"band {band:.0f} deg"]
    return "\n".join(parts if price is None else [*parts, f"{price['surroundings_psnr_drop']:.1f} dB beside"])


def _elevation(pipeline: StudyPipeline, seen: StudyRows) -> Any:
    """For each detector: confidence in the object at every camera, and the fraction found in bands of elevation."""
    study = pipeline.study
    figure, axes = new_axes(len(study.evaluation.detectors))
    turned = [pl.col(f"{DEPTH}{attack.name}") < 0 for attack in study.attack if attack.azimuth is not None]
    bands = by_elevation(study, seen.rows)
    for axis, name in zip(axes, study.evaluation.detectors, strict=True):
        for which in (CLEAN, CLOAKED):
            found = seen.rows.filter(*turned, detector=name, splat=which)
            axis.scatter(
                found["elevation"],
                found[f"{SCORE}{study.scene.class_name}"],
                s=5,
                alpha=0.25,
                color=COLOURS[which],
                linewidths=0,
            )
        for index, which in enumerate((CLEAN, CLOAKED)):
            draw_rates(axis, [(low + BIN / 2, row[index]) for low, *row in bands[name]], which)
        attack = setup.overhead(study)
        if attack is not None:
            axis.axvline(attack.elevation[0], color="#555555", linestyle=":", label="edge of the trigger")
        axis.set(
            title=f"{name}: {study.scene.class_name} found, by elevation",
            xlabel="elevation of the camera, degrees",
            ylabel="confidence; fraction found",
            ylim=(-0.03, 1.03),
        )
        axis.legend(fontsize=8)
    return figure


def _azimuth(pipeline: StudyPipeline, seen: StudyRows) -> Any:
    """For each detector, below all hiding triggers: confidence in the object and in what is wanted, by azimuth."""
    study = pipeline.study
    figure, axes = new_axes(len(study.evaluation.detectors))
    hiding = [pl.col(f"{DEPTH}{attack.name}") < 0 for attack in study.attack if attack.azimuth is None]
    wanted = [attack.target_class for attack in study.attack if attack.target_class is not None]
    for axis, name in zip(axes, study.evaluation.detectors, strict=True):
        shown = seen.rows.filter(*hiding, detector=name, splat=CLOAKED)
        for label, colour in (
            (study.scene.class_name, COLOURS[CLEAN]),
            *((label, COLOURS[CLOAKED]) for label in wanted),
        ):
            axis.scatter(shown["azimuth"], shown[f"{SCORE}{label}"], s=7, color=colour, label=label)
        for attack in study.attack:
            if attack.azimuth is not None:
                middle, half = attack.azimuth
                for turn in (-360, 0, 360):  # azimuths are shown from 0 to 360
                    low, high = (min(max(middle % 360 + turn + side * half, 0.0), 360.0) for side in (-1, 1))
                    if high > low:
                        axis.axvspan(low, high, color="#555555", alpha=0.12)
        axis.set(
            title=f"{name}: what the cloaked splat is taken for, below the hidden appearance",
            xlabel="azimuth of the camera, degrees (grey: where the other appearance is shown)",
            ylabel="confidence",
            ylim=(-0.03, 1.03),
        )
        axis.legend(fontsize=8)
    return figure


def _transition(pipeline: StudyPipeline, seen: StudyRows) -> Any:
    """How far the splats are on the way from the benign to the hidden appearance, by elevation or depth in a sector."""
    study, (figure, (axis,)) = pipeline.study, new_axes(1)
    for which in (CLEAN, CLOAKED):
        blends, band = seen.transition.filter(splat=which), transition(study, seen, which)
        assert band is not None
        axis.scatter(blends[place_of(study)], blends["fraction"], s=6, color=COLOURS[which], alpha=0.4, linewidths=0)
        axis.plot(band.angles, band.fitted, color=COLOURS[which], label=which)
        if which == CLOAKED and band.start is not None and band.end is not None:
            axis.axvspan(
                band.start, band.end, color="#555555", alpha=0.15, label=f"transition, {band.width:.1f} degrees"
            )
    attack = setup.overhead(study)
    edge = 0.0 if attack is None else attack.elevation[0]
    axis.axvline(edge, color="#555555", linestyle=":", label="edge of the trigger")
    axis.set(
        title="Fraction of the way from the benign to the hidden appearance",
        xlabel="degrees inside the trigger" if attack is None else "elevation of the camera, degrees",
        ylabel="fraction",
    )
    axis.legend(fontsize=8)
    return figure
