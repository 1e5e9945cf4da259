"""Draws the images of docs/conventions.md into docs/images:
`python docs/figures/conventions.py [FOLDER]`.

What is drawn is computed by the library's own functions, so an image cannot say
something else than the code does.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
import torch

from mi_splat import Camera, GaussianScene, Renderer, RenderSettings, look_at
from mi_splat.cameras.camera import orbit_pose, project_points
from mi_splat.cameras.framing import bounds, near_plane
from mi_splat.cameras.lens import Lens
from mi_splat.maths.sh import colour_to_dc, sh_basis, sh_to_colour

mpl.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.patches import Circle, Rectangle

if TYPE_CHECKING:
    from matplotlib.figure import Figure

IMAGES = Path(__file__).resolve().parents[1] / "images"
RED = "#c0392b"
GREEN = "#27863b"
BLUE = "#2060b0"
GREY = "#777777"
AZIMUTH = 40.0
ELEVATION = 30.0
DISTANCE = 3.0
STYLE = Path(__file__).with_name("page.mplstyle")


def axes_and_angles() -> Figure:
    """World axes, azimuth and elevation, and the axes of a camera on an orbit."""
    figure = plt.figure(figsize=(6.2, 4.0))
    axes: Any = figure.add_subplot(projection="3d", computed_zorder=False)
    pose = orbit_pose(
        (0, 0, 0), azimuth=AZIMUTH, elevation=ELEVATION, distance=DISTANCE
    ).numpy()
    eye = pose[:3, 3]
    for end, colour, name in (
        ((3, 0, 0), RED, "+x"),
        ((0, 2.2, 0), GREEN, "+y"),
        ((0, 0, 1.8), BLUE, "+z, up"),
    ):
        axes.quiver(0, 0, 0, *end, color=colour, arrow_length_ratio=0.06)
        axes.text(*(1.07 * np.array(end)), name, color=colour)
    for column, colour, name in (
        (0, RED, "x, right"),
        (1, GREEN, "y, down"),
        (2, BLUE, "z, forward"),
    ):
        tip = eye + 0.88 * pose[:3, column]
        axes.quiver(
            *eye, *(0.8 * pose[:3, column]), color=colour, arrow_length_ratio=0.15
        )
        axes.text(*tip, name, color=colour)
    axes.plot(*zip((0, 0, 0), eye, strict=True), color=GREY, linestyle=":")
    foot = eye * (1, 1, 0)
    axes.plot(*zip((0, 0, 0), foot, strict=True), color=GREY, linewidth=0.8)
    axes.plot(*zip(foot, eye, strict=True), color=GREY, linewidth=0.8)
    turn = np.radians(np.linspace(0, AZIMUTH, 30))
    axes.plot(1.2 * np.cos(turn), 1.2 * np.sin(turn), 0 * turn, color="black")
    axes.text(1.35 * math.cos(0.35), 1.35 * math.sin(0.35), 0, "azimuth 40°")
    rise = np.stack(
        [
            orbit_pose((0, 0, 0), azimuth=AZIMUTH, elevation=float(e), distance=1.7)[
                :3, 3
            ].numpy()
            for e in np.linspace(0, ELEVATION, 30)
        ]
    )
    axes.plot(*rise.T, color="black")
    axes.text(*(rise[15] * 1.12 + (0, 0, 0.05)), "elevation 30°")
    axes.scatter(0, 0, 0, color="black", s=30)
    axes.text(0.15, 0, -0.2, "centre")
    axes.set(xlim=(0, 3), ylim=(-0.4, 2.6), zlim=(-0.2, 2))
    axes.set_box_aspect((3, 3, 2.2), zoom=1.25)
    axes.view_init(elev=18, azim=-52)
    axes.set_axis_off()
    figure.subplots_adjust(0, -0.12, 1, 1.06)
    return figure


def pixels() -> Figure:
    """An image of 4 x 3 pixels, where its pixel centres are, and where the optical
    axis meets it.
    """
    figure, axes = plt.subplots(figsize=(4.6, 3.3))
    camera = Camera(
        to_world=look_at((0, -3, 0), (0, 0, 0)), lens=Lens(focal=4.0, size=(4, 3))
    )
    for x in range(camera.width + 1):
        axes.plot((x, x), (0, camera.height), color=GREY, linewidth=0.8)
    for y in range(camera.height + 1):
        axes.plot((0, camera.width), (y, y), color=GREY, linewidth=0.8)
    xs, ys = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    axes.scatter(xs, ys, s=14, color=BLUE)
    axes.text(0.08, 0.3, "(0.5, 0.5)", color=BLUE)
    (centre,), _ = project_points(torch.zeros(1, 3, dtype=torch.float64), camera)
    axes.scatter(float(centre[0]), float(centre[1]), marker="+", s=120, color=RED)
    axes.text(
        float(centre[0]) + 0.08,
        float(centre[1]) - 0.12,
        f"({camera.cx:g}, {camera.cy:g})",
        color=RED,
    )
    axes.set(
        xlim=(-0.4, 4.4),
        ylim=(3.4, -0.4),
        xlabel="x, to the right",
        ylabel="y, downwards",
        aspect="equal",
    )
    axes.set_xticks(range(5))
    axes.set_yticks(range(4))
    for side in axes.spines.values():
        side.set_visible(False)
    figure.tight_layout()
    return figure


def rotations() -> Figure:
    """One long Gaussian under three quaternions, rendered from above with +x to the
    right and +y up.
    """
    half = math.sqrt(0.5)
    turns = {
        "(1, 0, 0, 0)\nas it is: long in x": (1.0, 0.0, 0.0, 0.0),
        "(0.924, 0, 0, 0.383)\n45° about z": (
            math.cos(math.pi / 8),
            0.0,
            0.0,
            math.sin(math.pi / 8),
        ),
        "(0.707, 0, 0, 0.707)\n90° about z: long in y": (half, 0.0, 0.0, half),
    }
    camera = Camera(
        to_world=look_at((0, 0, 4), (0, 0, 0)), lens=Lens(focal=150.0, size=(150, 150))
    )
    render = Renderer(RenderSettings(background=(1.0, 1.0, 1.0)))
    figure, every = plt.subplots(1, len(turns), figsize=(6.4, 2.5))
    for axes, (title, quaternion) in zip(every, turns.items(), strict=True):
        scene = GaussianScene(
            means=torch.zeros(1, 3),
            scales=torch.tensor([[0.5, 0.15, 0.15]]),
            rotations=torch.tensor([quaternion]),
            opacities=torch.tensor([0.95]),
            sh=colour_to_dc(torch.tensor([[[0.1, 0.35, 0.7]]])),
        )
        axes.imshow(
            render(scene, camera).detach().clamp(0, 1).numpy(), extent=(-2, 2, -2, 2)
        )
        axes.set_title(title)
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set(xlabel="x", ylabel="y")
    figure.tight_layout()
    return figure


def spherical_harmonics() -> Figure:
    """Colour over the azimuth from which a Gaussian is seen: what the sum says, and
    what is shown of it.
    """
    angle = torch.linspace(0, 360, 361, dtype=torch.float64)
    turn = angle.deg2rad()
    seen_from = torch.stack([turn.cos(), turn.sin(), torch.zeros_like(turn)], dim=1)
    directions = -seen_from  # from the camera to the Gaussian
    figure, axes = plt.subplots(figsize=(6.4, 3.0))
    for coefficient, colour, name in ((0.6, RED, "0.6"), (1.6, BLUE, "1.6")):
        sh = torch.zeros(1, 4, 3, dtype=torch.float64)
        sh[:, 3] = coefficient
        shown = sh_to_colour(sh.expand(len(angle), 4, 3), directions)[:, 0]
        axes.plot(angle, shown, color=colour, label=f"fourth coefficient {name}")
        raw = 0.5 + coefficient * sh_basis(directions, 1)[:, 3]
        axes.plot(angle, raw, color=colour, linestyle=":", linewidth=1)
    axes.axhline(0, color=GREY, linewidth=0.8)
    axes.axhline(0.5, color=GREY, linewidth=0.8, linestyle="--")
    axes.set(
        xlabel="azimuth of the camera, degrees",
        ylabel="sRGB value",
        xlim=(0, 360),
        ylim=(-0.4, 1.4),
    )
    axes.set_xticks(range(0, 361, 90))
    axes.legend(loc="upper center")
    figure.tight_layout()
    return figure


def near_and_bounds() -> Figure:
    """A scene with floaters from above: the box of the middle 98 %, the ball, cameras,
    and the near plane.
    """
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(600, 3, generator=generator) * torch.tensor([0.45, 0.3, 0.2])
    points[:5] = torch.tensor(
        [[3.2, 2.4, 0], [-3.1, 1.9, 0], [2.7, -2.2, 0], [-2.5, -2.3, 0], [3.4, -0.6, 0]]
    )
    scene = GaussianScene(
        means=points,
        scales=torch.full((600, 3), 0.01),
        rotations=torch.tensor([[1.0, 0, 0, 0]]).expand(600, 4).contiguous(),
        opacities=torch.full((600,), 0.5),
        sh=torch.zeros(600, 1, 3),
    )
    middle, radius = bounds(scene)
    figure, axes = plt.subplots(figsize=(6.4, 4.2))
    axes.scatter(points[:, 0], points[:, 1], s=4, color=GREY)
    ordered = points.sort(dim=0).values
    low = ordered[round(0.01 * 599)].tolist()
    high = ordered[round(0.99 * 599)].tolist()
    axes.add_patch(
        Rectangle(
            (low[0], low[1]), high[0] - low[0], high[1] - low[1], fill=False, color=BLUE
        )
    )
    axes.text(
        low[0] - 0.4,
        middle[1] - radius - 0.25,
        "box of the middle 98 % along each axis",
        color=BLUE,
    )
    axes.add_patch(Circle(middle[:2], radius, fill=False, color=BLUE, linestyle=":"))
    axes.text(
        middle[0] + 0.75 * radius,
        middle[1] + 0.8 * radius,
        f"radius {radius:.2f}",
        color=BLUE,
    )
    pose = orbit_pose(middle, azimuth=180, elevation=0, distance=2.6)
    camera = Camera(to_world=pose, lens=Lens(focal=100.0, size=(100, 100)))
    near = near_plane(scene, [camera])
    eye = pose[:3, 3]
    axes.scatter(float(eye[0]), float(eye[1]), color=RED, marker=">", s=60)
    axes.plot((eye[0] + near,) * 2, (eye[1] - 0.5, eye[1] + 0.5), color=RED)
    axes.text(
        float(eye[0]) - 0.3,
        float(eye[1]) + 0.6,
        f"near = {near:.2f}",
        color=RED,
    )
    axes.text(2.0, 2.6, "floaters do not count", color=GREY)
    axes.set(
        aspect="equal",
        xlim=(-3.7, 4),
        ylim=(-2.8, 3),
        xlabel="x, world units",
        ylabel="y",
    )
    figure.tight_layout()
    return figure


def colour_space() -> Figure:
    """The colour of a pixel that two Gaussians share: blended in sRGB, as here, and in
    linear light.
    """
    share = np.linspace(0, 1, 200)
    black = 0.0
    white = 1.0
    blended = share * white + (1 - share) * black
    linear = np.where(
        blended <= 0.0031308, blended * 12.92, 1.055 * blended ** (1 / 2.4) - 0.055
    )
    figure, every = plt.subplots(2, 1, figsize=(6.4, 2.3), sharex=True)
    for axes, values, name in zip(
        every, (blended, linear), ("in sRGB (here)", "in linear light"), strict=True
    ):
        axes.imshow(
            np.repeat(values[None, :, None], 3, axis=2),
            extent=(0, 1, 0, 0.09),
            vmin=0,
            vmax=1,
        )
        axes.set_yticks([])
        axes.set_title(name, loc="left")
    every[1].set_xlabel("weight of a white Gaussian before a black one")
    figure.tight_layout()
    return figure


FIGURES = {
    "conventions_axes": axes_and_angles,
    "conventions_pixels": pixels,
    "conventions_rotations": rotations,
    "conventions_sh": spherical_harmonics,
    "conventions_near": near_and_bounds,
    "conventions_srgb": colour_space,
}


def main(folder: Path = IMAGES) -> None:
    """Draw all images into a folder."""
    mpl.style.use(STYLE)
    for name, draw in FIGURES.items():
        figure = draw()
        figure.savefig(
            folder / f"{name}.png",
            bbox_inches="tight",
            pad_inches=0.06,
            metadata={"Software": None},
        )
        plt.close(figure)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
