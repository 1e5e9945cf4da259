"""The options of each command, as frozen dataclasses that tyro turns into flags; light, so that --help is fast."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro import MISSING
from tyro.conf import OmitArgPrefixes, Positional, arg

from mi_splat.errors import InvalidValueError, message
from mi_splat.training.config import FitConfig
from mi_splat.training.strategies import strategy_config, strategy_name, strategy_names


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderOptions:
    """Render a scene XML or a splat file to a PNG.

    A scene XML is seen from one of its cameras. A bare splat file, or a scene with any of --azimuth, --elevation,
    --distance and --target given, is seen from an orbit around the middle of its Gaussians (z is up), by default at a
    distance that shows all of them.
    """

    scene: Positional[Path]
    """Scene XML made of splats, or a 3DGS PLY."""
    out: Path = Path("picture.png")
    """The PNG to write."""
    camera: str | None = None
    """Id of the scene's camera; None is the first."""
    azimuth: float | None = None
    """Degrees from +x towards +y; 30 if an orbit is used without it."""
    elevation: float | None = None
    """Degrees above the ground, 90 is straight down; 20 if an orbit is used without it."""
    distance: float | None = None
    """World units from the middle of the Gaussians."""
    target: tuple[float, float, float] | None = None
    """Point that an orbit camera looks at, world units; None is the middle of the Gaussians."""
    fov: float = 45.0
    """Field of view of an orbit camera in degrees, over the shorter side of the picture."""
    near: float | None = None
    """Gaussians nearer than this (depth, world units) are left out; None is the scene's own, 0.2 for a bare splat."""
    size: tuple[int, int] | None = None
    """Width and height in pixels; None is the camera's own, 640 x 480 for an orbit."""
    method: Literal["tile"] = "tile"
    """How it is rendered: tile is the picture of the reference 3DGS rasteriser."""
    background: tuple[float, float, float] | None = None
    """sRGB colour behind the Gaussians; None is the scene's own, black for a bare splat file."""
    json: bool = False
    """Print what was rendered as one JSON document on stdout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureOptions:
    """Take path-traced pictures of a mesh scene from a set of cameras, for training a splat.

    Writes images/, a list of them with their cameras, a point cloud and a record of the settings into --out. A capture
    that was interrupted goes on where it stopped when the same command is given again.
    """

    scene: Positional[str]
    """Mitsuba mesh XML; an OBJ, PLY, GLB or glTF mesh (needs the extra `meshes`); car_street or stop_sign; or one of
    the project's objects by name and seed, for instance car:900004."""
    cameras: str = "hemisphere:210"
    """hemisphere:N, orbit:N@ELEVATION, cap:N@MIN_ELEVATION, grid:AxE (azimuths x elevations), or a transforms .json."""
    out: Path = Path("out/capture")
    """Folder to write: a new one, or that of the same capture, which then goes on."""
    samples: int = 32
    """Samples per pixel; more is less noise."""
    size: tuple[int, ...] = (256,)
    """Width and height in pixels, or one number for both."""
    test: int = 0
    """Pictures held out, from other cameras over the same range."""
    seed: int = 0
    """Seed of the noise; picture i uses seed + i."""
    format: Literal["transforms", "colmap", "both"] = "transforms"
    """How pictures are listed: Blender/NeRF transforms_*.json, a COLMAP text model in sparse/0, or both."""
    rgba: bool = False
    """Write RGBA with nothing behind the surfaces, in place of the sky."""
    fov: float = 45.0
    """Field of view in degrees over the shorter side of the picture."""
    centre: tuple[float, float, float] | None = None
    """Point that cameras look at; None is the middle of the scene or of its object."""
    distance: float | None = None
    """World units between cameras and centre; None is as near as shows the whole scene or its object."""
    up: Literal["y", "z"] | None = None
    """Axis that points up in a mesh file; None is y for OBJ and glTF and z for PLY."""
    scale: float = 1.0
    """What one unit of a mesh file is in metres."""
    points: int = 20_000
    """Points wanted in the point cloud."""
    json: bool = False
    """Print what was written as one JSON document on stdout."""


_STRATEGY = strategy_name(FitConfig().strategy)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainOptions:
    """Train a splat on a set of pictures with cameras (transforms.json or COLMAP), as `mi-splat capture` writes it.

    Writes splat.ply, metrics.json, config.json and checkpoint.safetensors into --out. A run that was stopped goes on
    when the same command is given again, and makes the bits that it would have made.
    """

    dataset: Positional[Path]
    """Folder of the set."""
    out: Path
    """Folder for the results; made if it is not there."""
    strategy: Annotated[str, arg(metavar="|".join(strategy_names()))] = _STRATEGY
    """How Gaussians are added and removed: clone, split and prune (3DGS), MCMC relocation, or not at all. For the flags
    of one add --help."""
    fit: OmitArgPrefixes[FitConfig] = field(default_factory=FitConfig)
    """How the splat is trained."""
    start: Path | None = None
    """Splat to begin with; None takes the points of the set."""
    random: int | None = None
    """Begin with so many Gaussians anywhere instead."""
    outliers: int = 0
    """Add so many in the air to those on the points of the set, as false matches do in a cloud from photographs."""
    downscale: int = 1
    """Integer factor by which the pictures shrink."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """sRGB colour behind the splat, and behind transparent pixels."""
    lpips: bool = False
    """Score the held-out pictures by LPIPS, too; its network is downloaded when it is first used."""
    checkpoint_every: int = 1000
    """Steps between two checkpoints."""
    seed: int = 0
    """Seed of everything random."""
    json: bool = False
    """Print the figures as one JSON document on stdout."""

    def __post_init__(self) -> None:
        name = strategy_name(self.fit.strategy)
        if self.strategy != name:
            do = "pass both alike"
            raise InvalidValueError(message("strategy", f"{name}, as in fit", self.strategy, do))


def train_defaults(words: Sequence[str], *, program: str) -> TrainOptions:
    """The options before flags are read, but for the strategy, which says what flags there are.

    Args:
        words: What the user typed after the command.
        program: How the command is called, for errors.

    Raises:
        SystemExit: There is no such strategy.
    """
    parser = argparse.ArgumentParser(prog=program, add_help=False, allow_abbrev=False)
    parser.add_argument("--strategy", choices=strategy_names(), default=_STRATEGY)
    name = parser.parse_known_args(words)[0].strategy
    fit = FitConfig(strategy=strategy_config(name))
    return TrainOptions(dataset=MISSING, out=MISSING, strategy=name, fit=fit)


@dataclass(frozen=True, slots=True, kw_only=True)
class InfoOptions:
    """Say what a splat file or a scene XML holds."""

    file: Positional[Path]
    """3DGS PLY, or scene XML made of splats."""
    json: bool = False
    """Print it as one JSON document on stdout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExampleScenesOptions:
    """Make one of the splat scenes that the project ships, from its own meshes: pictures, start on surfaces, training.

    Writes NAME.xml, its two splats and NAME.json, a record with counts, settings, seed and PSNR, into --out. With the
    recipe's own numbers it takes about a quarter of an hour.
    """

    name: Positional[str]
    """car_street or stop_sign."""
    out: Path = Path("scenes")
    """Folder for the files; made if it is not there. What is there under these names is replaced."""
    views: int | None = None
    """Pictures to fit to; None takes the recipe's number."""
    samples: int = 16
    """Samples per pixel in them; the pictures to compare with have twice as many."""
    steps: int | None = None
    """Steps of the training; None takes the recipe's number."""
    seed: int = 0
    """Seed of everything but the meshes."""
    json: bool = False
    """Print the record as one JSON document on stdout."""
