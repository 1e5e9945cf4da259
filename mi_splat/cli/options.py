"""The options of each command, as frozen dataclasses that tyro turns into flags; light, so that --help is fast."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro import MISSING
from tyro.conf import OmitArgPrefixes, Positional, arg

from mi_splat.capture.settings import CaptureSettings, MeshSettings, SurroundingsSettings
from mi_splat.cli.camera_options import CameraOptions
from mi_splat.cli.values import Colour, Size
from mi_splat.errors import InvalidValueError, message
from mi_splat.selection.config import Selection
from mi_splat.training.config import FitConfig
from mi_splat.training.strategies import strategy_config, strategy_name, strategy_names


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderOptions:
    """Render a scene XML or a splat file: a picture, a picture from each of several cameras, or an animation.

    A scene XML with meshes beside splats is path traced by its integrator splat_ray.

    A scene XML is seen from its first camera, a bare splat file from an orbit around the middle of its Gaussians, at a
    distance that shows all of them, unless the flags below say something else.
    """

    scene: Positional[Path]
    """Scene XML of splats, alone or among meshes, or a splat file of any format that is read."""
    out: Path = Path("picture.png")
    """What to write: NAME.png or NAME.jpg; NAME.gif or NAME.mp4 (needs the extra `video`) of several cameras one after
    the other; a folder, or a name with {} for the camera's, for a picture from each."""
    view: OmitArgPrefixes[CameraOptions] = field(default_factory=CameraOptions)
    """Where from."""
    fps: float = 24.0
    """Pictures a second of an animation."""
    method: Literal["tile", "ray"] | None = None
    """How splats alone are rendered: tile is the picture of the reference 3DGS rasteriser, ray traces rays; without the
    flag it is what the scene XML says, or tile."""
    samples: int = 64
    """Samples a pixel, for a scene with meshes; the other pictures need one."""
    force: bool = False
    """Replace a folder of pictures that an earlier call has written."""
    json: bool = False
    """Print what was rendered as one JSON document on stdout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectOptions:
    """Select one object of a splat, and see whether it is the right one.

    Prints how many Gaussians it has, where they are, how much of the picture it makes up, and what is doubtful about
    it. The same flags choose the object of `mi-splat dagger` and `mi-splat evaluate`.
    """

    scene: Positional[Path]
    """A splat file, or a scene XML made of splats."""
    selection: OmitArgPrefixes[Selection] = field(default_factory=Selection)
    """Which object."""
    view: OmitArgPrefixes[CameraOptions] = field(default_factory=CameraOptions)
    """Where it is looked at from; the first camera's picture is the one that is clicked on and written."""
    out: tuple[Path, ...] = ()
    """Any of: a .png or .jpg of the scene with the object tinted, the mask as .npy, the object's Gaussians as .ply."""
    json: bool = False
    """Print what was selected as one JSON document on stdout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConvertOptions:
    """Convert a splat file to another format, which the ending of its name says.

    Says what the new file does not hold, and how far its values are off.
    """

    source: Positional[Path]
    """Splat to read: .ply, .compressed.ply, .spz, .sog, .glb, .splat or .ksplat."""
    out: Positional[Path]
    """Splat to write: .ply, .compressed.ply, .spz, .sog, .glb or .splat."""
    force: bool = False
    """Replace a file that is there."""
    sh_degree: Literal[0, 1, 2, 3] | None = None
    """Cut spherical harmonics above this degree; None keeps what the format holds."""
    spz_version: Literal[2, 3, 4] | None = None
    """Version of an SPZ file; None is 3."""
    drop_invalid: bool = False
    """Leave out Gaussians that are not valid, instead of an error."""
    json: bool = False
    """Print what was written and lost as one JSON document on stdout."""


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
    size: Size | None = None
    """Pixels, as 256 or 256x192; 1 to 32768. None is 256, or what a transforms .json says."""
    test: int = 0
    """Pictures held out, from other cameras over the same range; 0 or more."""
    format: Literal["transforms", "colmap", "both"] = "transforms"
    """How pictures are listed: Blender/NeRF transforms_*.json, a COLMAP text model in sparse/0, or both."""
    fov: float | None = None
    """Field of view in degrees over the shorter side of the picture; between 0 and 180. None is 45."""
    centre: tuple[float, float, float] | None = None
    """Point that cameras look at, in the coordinates of the mesh file as it is turned and scaled; None is the middle of
    the scene or of its object."""
    distance: float | None = None
    """World units between cameras and centre, more than 0; None is as near as shows the whole scene or its object."""
    settings: OmitArgPrefixes[CaptureSettings] = field(default_factory=CaptureSettings)
    """How pictures are taken."""
    mesh: OmitArgPrefixes[MeshSettings] = field(default_factory=MeshSettings)
    """How a mesh file is read and turned."""
    surroundings: OmitArgPrefixes[SurroundingsSettings] = field(default_factory=SurroundingsSettings)
    """What is around a mesh file, or around an object of the project."""
    json: bool = False
    """Print what was written as one JSON document on stdout."""


_STRATEGY = strategy_name(FitConfig().strategy)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainOptions:
    """Train a splat on a set of pictures with cameras (transforms.json or COLMAP), as `mi-splat capture` writes it.

    Writes splat.ply, metrics.json, config.json and checkpoint.safetensors into --out. A run that was stopped goes on
    when the same command is given again, and makes the bits that it would have made. A run also goes on with more
    --iterations than it had.

    Options of 3DGS are taken under its names, too: --position_lr_init, --feature_lr, --opacity_lr, --scaling_lr,
    --rotation_lr, --densify_from_iter, --densification_interval, ...
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
    background: Colour = (0.0, 0.0, 0.0)
    """Colour behind the splat and transparent pixels, as white, #80b0e0 or three sRGB numbers in [0, 1]. See also
    --random-background."""
    near: float | None = None
    """Gaussians nearer to a camera than this are not drawn, world units; none takes the 0.2 of 3DGS, or less where the
    scene or the distance of its cameras is small."""
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
    """Splat file of any format that is read, or scene XML made of splats."""
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
