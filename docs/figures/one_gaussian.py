"""Follows one Gaussian over five views: `python docs/figures/one_gaussian.py SPLAT
[--gaussian ROW] [--out PICTURE]`.

Above, the splat from five elevations, and a part of each view about the Gaussian, whose
border at two standard deviations is drawn. Below, its colour by elevation, and its SH
coefficients. If no row is named, it is the Gaussian whose colour changes most, of those
that show in all five views.
"""

import argparse
import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mi_splat import Camera, GaussianScene, Renderer, RenderSettings, load_splat
from mi_splat.cameras.camera import orbit_pose
from mi_splat.cameras.lens import Lens, focal_of
from mi_splat.maths.sh import sh_basis
from mi_splat.viewer.picking import border, colours

PICTURE = Path(__file__).resolve().parents[2] / "docs" / "images" / "one_gaussian.png"
ELEVATIONS = (10.0, 25.0, 40.0, 55.0, 75.0)
_SIZE = 320
_FOV = 45.0
_PART = 48
_SKY = (0.55, 0.7, 0.9)
_LEAST = 20.0
"""Pixels that the Gaussian makes up at least in each view."""


def camera(
    elevation: float,
    azimuth: float,
    target: tuple[float, float, float],
    distance: float,
) -> Camera:
    """A camera on a sphere about a point."""
    pose = orbit_pose(target, azimuth=azimuth, elevation=elevation, distance=distance)
    return Camera(
        to_world=pose,
        lens=Lens(focal=focal_of(math.radians(_FOV), _SIZE), size=(_SIZE, _SIZE)),
    )


def chosen(scene: GaussianScene, cameras: list[Camera], render: Renderer) -> int:
    """The Gaussian whose colour changes most, of those that make up some pixels of
    every view.
    """
    shares = []
    for view in cameras:
        # an image without colour has no clamps
        white = torch.zeros_like(scene.sh[:, :1]).requires_grad_(True)
        (share,) = torch.autograd.grad(
            render(scene.replace(sh=white), view).sum(), white
        )
        shares.append(share.abs().sum((1, 2)))
    seen = colours(scene, torch.arange(len(scene)), cameras)
    change = (seen.amax(0) - seen.amin(0)).norm(dim=-1)
    pixels = torch.stack(shares).amin(0) / (
        3 * float(sh_basis(torch.tensor([0.0, 0.0, 1.0]), 0))
    )
    return int(torch.where(pixels >= _LEAST, change, 0).argmax())


def draw(
    scene: GaussianScene,
    row: int,
    cameras: list[Camera],
    render: Renderer,
    strip: Tensor,
    path: Path,
) -> None:
    """The figure."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    pyplot.style.use(Path(__file__).with_name("page.mplstyle"))
    figure = pyplot.figure(figsize=(7.2, 6.0))
    rows = figure.add_gridspec(
        4, 5, height_ratios=(4, 4, 0.8, 2.6), hspace=0.7, wspace=0.05
    )
    for column, view in enumerate(cameras):
        picture = render(scene, view).clamp(0, 1)
        outline = border(scene, row, view)
        middle = outline.mean(0)
        for number, half in ((0, _SIZE / 2), (1, _PART / 2)):
            axis: Any = figure.add_subplot(rows[number, column])
            axis.imshow(
                picture.numpy(), interpolation="nearest", extent=(0, _SIZE, _SIZE, 0)
            )
            axis.plot(
                outline[:, 0],
                outline[:, 1],
                color="white",
                linewidth=2.6 - number * 0.4,
            )
            axis.plot(outline[:, 0], outline[:, 1], color="magenta", linewidth=1.2)
            x, y = (_SIZE / 2, _SIZE / 2) if number == 0 else middle.tolist()
            axis.set(
                xlim=(x - half, x + half),
                ylim=(y + half, y - half),
                xticks=[],
                yticks=[],
            )
            if number == 0:
                axis.set_title(f"{ELEVATIONS[column]:.0f} degrees up")
    axis = figure.add_subplot(rows[2, :])
    axis.imshow(strip[None].numpy(), aspect="auto", extent=(0, 90, 0, 1))
    for elevation in ELEVATIONS:
        axis.axvline(elevation, color="magenta", linewidth=1.2)
    axis.set(yticks=[], xticks=range(0, 91, 15))
    axis.set_title("its colour, by elevation in degrees")
    axis = figure.add_subplot(rows[3, :])
    values = scene.sh[row]
    for channel, colour in enumerate(("tab:red", "tab:green", "tab:blue")):
        places = torch.arange(len(values)) + 0.26 * (channel - 1)
        axis.bar(places.numpy(), values[:, channel].numpy(), 0.26, color=colour)
    axis.axhline(0, color="black", linewidth=0.8)
    axis.set_xticks(range(len(values)), [f"{k}" for k in range(len(values))])
    for degree in (1, 2, 3):
        axis.axvline(degree**2 - 0.5, color="grey", linewidth=0.8, linestyle=":")
    axis.set_title(
        f"SH coefficients of Gaussian {row:,}, red, green and blue; dotted: next"
        " degree",
    )
    figure.savefig(path, bbox_inches="tight")


def main() -> None:
    """Choose and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("splat", type=Path)
    parser.add_argument("--gaussian", type=int)
    parser.add_argument("--out", type=Path, default=PICTURE)
    parser.add_argument("--target", type=float, nargs=3, default=(0.0, 0.0, 0.7))
    parser.add_argument("--distance", type=float, default=7.4)
    parser.add_argument("--azimuth", type=float, default=40.0)
    options = parser.parse_args()
    scene = load_splat(options.splat)
    render = Renderer(RenderSettings(background=_SKY))
    where = (options.azimuth, tuple(options.target), options.distance)
    cameras = [camera(elevation, *where) for elevation in ELEVATIONS]
    if options.gaussian is None:
        row = chosen(scene, cameras, render)
    else:
        row = options.gaussian
    strip = colours(
        scene, row, [camera(float(elevation), *where) for elevation in range(91)]
    )
    with torch.no_grad():
        draw(scene, row, cameras, render, strip, options.out)


if __name__ == "__main__":
    main()
