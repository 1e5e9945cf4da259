"""The pictures of a study: clean beside cloaked from many sides, and what detectors say by elevation and azimuth."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import torch
from numpy.typing import NDArray

from attacks.cloak import setup
from attacks.cloak.rates import BIN, NAMES, Tables, by_elevation, place_of, transition
from attacks.cloak.steps import StudySteps, TrainedSplat
from attacks.detectors.base import Detector
from attacks.observe.drawing import annotated
from attacks.observe.rows import ATTACKED, CLEAN, DEPTH, ROWS, TARGET_SCORE, TRANSITION
from attacks.rate import Rate
from mi_splat.camera_sets import orbit
from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError, install, message
from mi_splat.io.atomic import atomic_write
from mi_splat.io.documents import save_png
from mi_splat.io.images import through_png

COLOURS = {CLEAN: "#1f77b4", ATTACKED: "#d62728"}
"""Splat as rows call it to the colour of its lines."""


def need_matplotlib() -> None:
    """Raise if plots cannot be drawn.

    Raises:
        InvalidValueError: matplotlib is not installed.
    """
    if importlib.util.find_spec("matplotlib") is None:
        do = install("figures")
        raise InvalidValueError(message("matplotlib", "the package, for plots", "not installed", do))


def new_axes(count: int) -> tuple[Any, list[Any]]:
    """A figure, and its axes from the top down.

    Raises:
        InvalidValueError: matplotlib is not installed.
    """
    need_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 3.4 * count), dpi=130, layout="constrained")
    return figure, [figure.add_subplot(count, 1, number + 1) for number in range(count)]


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure as PNG.

    Raises:
        SplatFileError: The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    with atomic_write(path) as file:
        figure.savefig(file, format="png")


def _draw_rates(axis: Any, points: Sequence[tuple[float, Rate]], which: str) -> None:
    """A line of rates over an axis, with their intervals, in the colour of a splat."""
    fractions = [rate.fraction for _, rate in points]
    below = [rate.fraction - rate.interval[0] for _, rate in points]
    above = [rate.interval[1] - rate.fraction for _, rate in points]
    style = {"color": COLOURS[which], "marker": "o", "markersize": 3, "capsize": 2, "label": NAMES[which]}
    axis.errorbar([x for x, _ in points], fractions, yerr=np.maximum([below, above], 0.0), **style)


SIDE_AZIMUTH = 40.0
ELEVATIONS = (5, 15, 25, 35, 45, 55, 65, 75, 85)
AZIMUTHS = (0, 45, 90, 135, 150, 165, 180, 195, 210)
LOW = 15
"""Elevation of the cameras of a contact sheet that go around, degrees."""
CELL = 256


def contact_sheet(steps: StudySteps, splats: Sequence[TrainedSplat], detector: Detector) -> NDArray[np.uint8]:
    """Clean above cloaked, over elevation and then around, with what the detector reports."""
    study = steps.study
    lens = setup.lens_of(study, steps.mesh_scene.target)
    centre = setup.centre_of(study)

    def camera(azimuth: float, elevation: float) -> Camera:
        return orbit(centre, count=1, elevation=elevation, start=azimuth, **lens)[0]  # type: ignore[arg-type]

    rising = [(f"{elevation} deg up", camera(SIDE_AZIMUTH, elevation)) for elevation in ELEVATIONS]
    around = [(f"azimuth {azimuth}", camera(azimuth, LOW)) for azimuth in AZIMUTHS]
    scenes = {splat.splat: splat.load() for splat in splats}
    render = steps.renderer()
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
                        annotated(picture, detections, title, min_confidence=study.evaluation.confidence, width=CELL)
                        for picture, detections, title in zip(pictures, seen, titles, strict=True)
                    ],
                    axis=1,
                )
            )
    return np.concatenate(rows)


def write_figures(
    steps: StudySteps,
    tables: Tables,
    splats: Sequence[TrainedSplat],
    detectors: Sequence[Detector],
    folder: Path,
) -> list[str]:
    """Write contact.png, elevation.png, azimuth.png and transition.png; returns their names.

    Args:
        steps: The study.
        tables: What was seen of every splat.
        splats: Those of the contact sheet.
        detectors: Those that observed them; the first one's boxes are on the contact sheet.
        folder: For the pictures.

    Raises:
        InvalidValueError: matplotlib is not installed.
        SplatFileError: The folder cannot be written.
    """
    save_png(contact_sheet(steps, splats, detectors[0]), folder / "contact.png")
    save_figure(_elevation(steps, tables), folder / "elevation.png")
    save_figure(_azimuth(steps, tables), folder / "azimuth.png")
    names = ["contact.png", "elevation.png", "azimuth.png"]
    if transition(steps.study, tables) is not None:
        save_figure(_transition(steps, tables), folder / "transition.png")
        names.append("transition.png")
    return names


def _elevation(steps: StudySteps, tables: Tables) -> Any:
    """For each detector: confidence in the object at every camera, and the fraction found in bands of elevation."""
    study = steps.study
    figure, axes = new_axes(len(study.evaluation.detectors))
    turned = [pl.col(f"{DEPTH}{attack.name}") < 0 for attack in study.attack if attack.azimuth is not None]
    bands = by_elevation(study, tables[ROWS])
    for axis, name in zip(axes, study.evaluation.detectors, strict=True):
        for which in NAMES:
            shown = tables[ROWS].filter(*turned, detector=name, splat=which)
            axis.scatter(
                shown["elevation"],
                shown["original_score"],
                s=5,
                alpha=0.25,
                color=COLOURS[which],
                linewidths=0,
            )
        for index, which in enumerate(NAMES):
            _draw_rates(axis, [(low + BIN / 2, row[index]) for low, *row in bands[name]], which)
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


def _azimuth(steps: StudySteps, tables: Tables) -> Any:
    """For each detector, below all hiding triggers: confidence in the object and in what is wanted, by azimuth."""
    study = steps.study
    figure, axes = new_axes(len(study.evaluation.detectors))
    hiding = [pl.col(f"{DEPTH}{attack.name}") < 0 for attack in study.attack if attack.azimuth is None]
    wanted = {attack.target_class: f"{TARGET_SCORE}{attack.name}" for attack in study.attack if attack.target_class}
    for axis, name in zip(axes, study.evaluation.detectors, strict=True):
        shown = tables[ROWS].filter(*hiding, detector=name, splat=ATTACKED)
        for label, column, colour in (
            (study.scene.class_name, "original_score", COLOURS[CLEAN]),
            *((label, column, COLOURS[ATTACKED]) for label, column in wanted.items()),
        ):
            axis.scatter(shown["azimuth"], shown[column], s=7, color=colour, label=label)
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


def _transition(steps: StudySteps, tables: Tables) -> Any:
    """How far the splats are on the way from the benign to the hidden appearance, by elevation or depth in a sector."""
    study, (figure, (axis,)) = steps.study, new_axes(1)
    for which in NAMES:
        blends, band = tables[TRANSITION].filter(splat=which), transition(study, tables, which)
        assert band is not None
        axis.scatter(blends[place_of(study)], blends["fraction"], s=6, color=COLOURS[which], alpha=0.4, linewidths=0)
        axis.plot(band.angles, band.fitted, color=COLOURS[which], label=NAMES[which])
        if which == ATTACKED and band.start is not None and band.end is not None:
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
