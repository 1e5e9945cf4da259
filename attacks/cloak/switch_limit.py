"""How sharply colour alone can switch over elevation, with one layer of Gaussians and with more.

Spherical harmonics of each degree are fitted by least squares to a step that is 0 at the study's benign cameras and, in
the hiding trigger, 1 or what the study's emphasis makes of it, not clipped. The limit is that of one Gaussian that is
seen from everywhere. What a splat does besides (geometry, clipped colours, Gaussians that are seen from few sides) is
not in it.

Two layers (`attacks.cloak.layers`) switch faster, for each may be far below zero where it shall be black. Their limit
depends on how far below: coefficients that are too large do not survive coarse file formats, and show in an audit. A
look in two layers of its own, one of them for its edge, switches faster still.

The figure draws both by elevation, and against the largest coefficient that they need.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from attacks.cloak import setup
from attacks.cloak.config import LayerConfig, StudyConfig
from attacks.cloak.layers import DIRECTIONS, layered_attacks, switched
from attacks.cloak.plots import new_axes, save_figure
from attacks.cloak.switches import shares
from attacks.cloak.transition import fit_transition
from mi_splat.camera_sets import hemisphere
from mi_splat.sh import colour_to_dc, sh_basis

ELEVATIONS = [0.5 * step for step in range(181)]
AZIMUTHS = range(0, 360, 15)
LOWEST = (-1.0, -3.0, -10.0, -100.0)
"""Lowest values of a layer, in multiples of what it shows."""
BANDS = (8.0, 12.0, 16.0, 24.0)
"""Degrees over which a look passes from the layer for its edge to the one for further inside."""


def measure_transition_limit(study: StudyConfig) -> list[dict[str, Any]]:
    """For each SH degree, with and without emphasis: the transition of the best fit, and how far it overshoots.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around.
    """
    rows: list[dict[str, Any]] = []
    for emphasised in (False, True):
        for degree in range(1, 4):
            curve, gain = one_layer_curve(study, degree, emphasised=emphasised)
            extremes = {"lowest": min(curve), "highest": max(curve)}
            rows.append({"sh_degree": degree, "emphasis": gain, **_band(curve), **extremes})
    return rows


def measure_layer_limit(study: StudyConfig) -> list[dict[str, Any]]:
    """The same for two layers, for each SH degree and each lowest value of a layer.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around.
    """
    makings = [LayerConfig(degree=degree, lowest=lowest) for degree in range(1, 4) for lowest in LOWEST]
    return [{"sh_degree": making.degree, "lowest": making.lowest, **_of_layers(study, making)} for making in makings]


def measure_band_limit(study: StudyConfig) -> list[dict[str, Any]]:
    """The same with a layer more for the edge of each look, for each SH degree and each width of the band.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around.
    """
    makings = [LayerConfig(degree=degree, band=band) for degree in range(2, 4) for band in BANDS]
    return [{"sh_degree": making.degree, "band": making.band, **_of_layers(study, making)} for making in makings]


def _of_layers(study: StudyConfig, making: LayerConfig) -> dict[str, Any]:
    """The largest coefficient of layers, and where they switch."""
    curve, largest = layered_curve(study, making)
    return {"largest_coefficient": largest, **_band(curve)}


def one_layer_curve(study: StudyConfig, degree: int, *, emphasised: bool = False) -> tuple[list[float], float]:
    """The way from the benign to the hidden look at `ELEVATIONS`, mean over azimuths, and the emphasis at the edge.

    Args:
        study: Its cameras and its trigger count.
        degree: SH degree of the least-squares fit.
        emphasised: Whether the step is overdone as the study overdoes it.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around.
    """
    attack, centre = setup.need_overhead(study), setup.centre_of(study)
    cameras = setup.training_cameras(study, setup.target_of(study.scene))
    middle = torch.tensor(centre, dtype=torch.float64)
    directions = torch.stack([middle - camera.position.double() for camera in cameras])
    inside = torch.tensor([attack.cone.angle_to_edge(camera, centre=centre) for camera in cameras], dtype=torch.float64)
    emphasis = attack.emphasis if emphasised else 1.0
    gain = 1 + (emphasis - 1) * (1 - inside / attack.emphasis_depth).clamp(0, 1)
    wanted = (inside >= 0).double() * gain
    fitted = torch.linalg.lstsq(_basis(directions, degree), wanted[:, None]).solution[:, 0]
    return [float((_basis(_around(elevation), degree) @ fitted).mean()) for elevation in ELEVATIONS], emphasis


def layered_curve(study: StudyConfig, making: LayerConfig) -> tuple[list[float], float]:
    """The same for a Gaussian in the middle that is in layers, and the largest of their coefficients.

    Of a picture that shows a share b of the benign look and a share h of the hidden one, each the sum of its layers,
    which are cut at zero, the way from one to the other is (1 - b + h) / 2.

    Args:
        study: Its trigger counts.
        making: How the layers are made.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around.
    """
    attack, centre = setup.need_overhead(study), setup.centre_of(study)
    lens = setup.lens_of(study, setup.target_of(study.scene))
    cameras = hemisphere(centre, count=DIRECTIONS, **lens)  # type: ignore[arg-type]
    middle, white = torch.tensor([centre]), colour_to_dc(torch.ones(1, 1, 3))
    much = torch.ones(1, len(cameras))
    parts = shares([attack.cone], cameras, centre=centre, config=making)
    layers = torch.stack(
        [switched(middle, cameras, share, white, much, making)[0, :, 0].double() for share in parts], 1
    )
    hidden = torch.tensor([share.look == 1 for share in parts])
    curve = []
    for elevation in ELEVATIONS:
        shown = (_basis(_around(elevation), making.degree) @ layers).clamp(min=0).mean(0)
        curve.append(float((1 - shown[~hidden].sum() + shown[hidden].sum()) / 2))
    return curve, float(layers.abs().max())


def making_from_above(study: StudyConfig) -> LayerConfig:
    """How the study makes the layer that is seen from above; as the library does it if the study has none."""
    attack = setup.need_overhead(study)
    if study.layers is None or attack.name not in study.layers.attacks:
        return LayerConfig()
    number = [other.name for other in layered_attacks(study)].index(attack.name)
    return study.layers.making.for_trigger(number)


def _band(curve: list[float]) -> dict[str, float | None]:
    """Where a curve goes from 10 to 90 % of its way."""
    band = fit_transition(ELEVATIONS, curve)
    return {"from": band.start, "to": band.end, "width": band.width}


def _basis(directions: Tensor, degree: int) -> Tensor:
    return sh_basis(torch.nn.functional.normalize(directions, dim=1), degree)


def _around(elevation: float) -> Tensor:
    """Directions from cameras at one elevation to the centre."""
    up, out = math.sin(math.radians(elevation)), math.cos(math.radians(elevation))
    turns = [math.radians(azimuth) for azimuth in AZIMUTHS]
    return -torch.tensor([[out * math.cos(a), out * math.sin(a), up] for a in turns], dtype=torch.float64)


_DEGREES = {1: "#bbbbbb", 2: "#7aa6c2", 3: "#1f77b4"}
"""SH degree to the colour of its lines."""

_TWO_LAYERS, _WITH_BANDS = "#d62728", "#8c3fa8"
"""Colours of what two layers show, and of what they show with a layer more for each edge."""


def write_limit_figure(
    study: StudyConfig,
    limits: Mapping[str, Sequence[Mapping[str, Any]]],
    measured: Mapping[str, Any] | None,
    path: Path,
) -> None:
    """Draw the switches of one layer, of two and of more, and the widths that go with the largest coefficients.

    Args:
        study: Its trigger counts, and how its layers are made if it has some.
        limits: `two_layers` of `measure_layer_limit` and `bands` of `measure_band_limit`.
        measured: The entry `transition` of a finished study's summary, which is drawn beside; None draws none.
        path: PNG file to write.

    Raises:
        InvalidValueError: The study has no appearance that is seen from all around, or matplotlib is not installed.
        SplatFileError: The file cannot be written.
    """
    figure, (by_elevation, by_size) = new_axes(2, columns=2)
    making = making_from_above(study)
    for degree, colour in _DEGREES.items():
        by_elevation.plot(
            ELEVATIONS, one_layer_curve(study, degree)[0], color=colour, linestyle="--", label=f"one layer, SH {degree}"
        )
    two = replace(making, band=0.0)
    by_elevation.plot(
        ELEVATIONS, layered_curve(study, two)[0], color=_TWO_LAYERS, label=f"two layers, SH {making.degree}"
    )
    if making != two:
        label = f"a layer more for each edge, SH {making.degree}"
        by_elevation.plot(ELEVATIONS, layered_curve(study, making)[0], color=_WITH_BANDS, label=label)
    if measured is not None and measured.get("from") is not None and measured.get("to") is not None:
        low, high = float(measured["from"]), float(measured["to"])
        drawn = _TWO_LAYERS if making == two else _WITH_BANDS
        by_elevation.axvspan(low, high, color=drawn, alpha=0.15, label=f"measured, {high - low:.1f} degrees")
    by_elevation.set(
        title="From the benign look (0) to the hidden one (1)",
        xlabel="elevation of the camera, degrees",
        ylabel="fraction of the way",
        ylim=(-0.3, 1.3),
    )
    by_elevation.legend(fontsize=7)
    for degree, colour in _DEGREES.items():
        sizes, widths = _of_degree(limits["two_layers"], degree)
        by_size.plot(sizes, widths, color=colour, marker="o", label=f"two layers, SH {degree}")
        sizes, widths = _of_degree(limits["bands"], degree)
        if sizes:
            label = f"a layer more for each edge, SH {degree}"
            by_size.plot(sizes, widths, color=colour, marker="x", linestyle="", label=label)
    by_size.set(
        title="What the switch needs",
        xlabel="largest SH coefficient",
        ylabel="10 to 90 % of the way, degrees",
        xscale="log",
    )
    by_size.set_ylim(bottom=0)
    by_size.legend(fontsize=7)
    save_figure(figure, path)


def _of_degree(rows: Sequence[Mapping[str, Any]], degree: int) -> tuple[list[float], list[float]]:
    """Largest coefficients and widths of the rows of one SH degree, in the order of the former."""
    chosen = sorted((row for row in rows if row["sh_degree"] == degree), key=lambda row: row["largest_coefficient"])
    return [row["largest_coefficient"] for row in chosen], [row["width"] for row in chosen]
