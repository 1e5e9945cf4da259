"""The options of each command, from which `mi_splat.cli.flags` makes flags; light, so that --help is fast."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from mi_splat.capture.settings import CaptureSettings, MeshSettings, SurroundingsSettings
from mi_splat.cli.camera_options import CameraOptions, FieldOfView, Point
from mi_splat.cli.flags import Positional, Unprefixed
from mi_splat.cli.values import Colour, Size
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import Called, Folder, Length, Range, Seed, Steps, at_least, between, check, check_choice
from mi_splat.selection.config import Selection
from mi_splat.training.config import FitConfig
from mi_splat.training.strategies import strategy_config, strategy_name, strategy_names

Rate = Annotated[
    float,
    Range(low=0, high=1000, open_low=True, unit="pictures a second", do="24 is usual"),
    Called("RATE"),
]
Samples = Annotated[int, between(1, 1 << 16, "samples per pixel", "32 is usual")]


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderOptions:
    """Render a scene XML or a splat file: a picture, a picture from each of several cameras, or an animation.

    A scene XML with meshes beside splats is path traced by its integrator splat_ray.

    A scene XML is seen from its first camera, a bare splat file from an orbit around the middle of its Gaussians, at a
    distance that shows all of them, unless the flags below say something else.
    """

    scene: Positional[Path]
    """Scene XML of splats, alone or among meshes, or a splat file of any format that is read."""
    out: Annotated[Path, Called("PATH")] = Path("picture.png")
    """What to write: NAME.png or NAME.jpg; NAME.gif or NAME.mp4 (needs the extra `video`) of several cameras one after
    the other; a folder, or a name with {} for the camera's, for a picture from each."""
    view: Unprefixed[CameraOptions] = field(default_factory=CameraOptions)
    """Where from."""
    fps: Annotated[
        float, Range(low=0, high=1000, open_low=True, unit="pictures a second", do="24 is usual"), Called("RATE")
    ] = 24.0
    """Pictures a second of an animation."""
    method: Literal["tile", "ray"] | None = None
    """How splats alone are rendered: tile is the picture of the reference 3DGS rasteriser, ray traces rays; without the
    flag it is what the scene XML says, or tile."""
    samples: Samples = 64
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
    selection: Unprefixed[Selection] = field(default_factory=Selection)
    """Which object."""
    view: Unprefixed[CameraOptions] = field(default_factory=CameraOptions)
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

    scene: Positional[Annotated[str, Called("SCENE")]]
    """Mitsuba mesh XML; an OBJ, PLY, GLB or glTF mesh (needs the extra `meshes`); car_street or stop_sign; or one of
    the project's objects by name and seed, for instance car:900004."""
    cameras: Annotated[str, Called("CAMERAS")] = "hemisphere:210"
    """hemisphere:N, orbit:N@ELEVATION, cap:N@MIN_ELEVATION, grid:AxE (azimuths x elevations), or a transforms .json."""
    out: Folder = Path("out/capture")
    """Folder to write: a new one, or that of the same capture, which then goes on."""
    size: Size | None = None
    """Pixels, as 256 or 256x192; 1 to 32768. None is 256, or what a transforms .json says."""
    test: Annotated[int, between(0, 100_000, "pictures")] = 0
    """Pictures held out, from other cameras over the same range; 0 or more."""
    format: Literal["transforms", "colmap", "both"] = "transforms"
    """How pictures are listed: Blender/NeRF transforms_*.json, a COLMAP text model in sparse/0, or both."""
    fov: FieldOfView | None = None
    """Field of view in degrees over the shorter side of the picture; between 0 and 180. None is 45."""
    centre: Point | None = None
    """Point that cameras look at, in the coordinates of the mesh file as it is turned and scaled; None is the middle of
    the scene or of its object."""
    distance: Length | None = None
    """World units between cameras and centre, more than 0; None is as near as shows the whole scene or its object."""
    settings: Unprefixed[CaptureSettings] = field(default_factory=CaptureSettings)
    """How pictures are taken."""
    mesh: Unprefixed[MeshSettings] = field(default_factory=MeshSettings)
    """How a mesh file is read and turned."""
    surroundings: Unprefixed[SurroundingsSettings] = field(default_factory=SurroundingsSettings)
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

    dataset: Positional[Folder]
    """Folder of the set."""
    out: Folder
    """Folder for the results; made if it is not there."""
    strategy: Annotated[str, Called("|".join(strategy_names()))] = _STRATEGY
    """How Gaussians are added and removed: clone, split and prune (3DGS), MCMC relocation, or not at all. For the flags
    of one add --help."""
    fit: Unprefixed[FitConfig] = field(default_factory=FitConfig)
    """How the splat is trained."""
    start: Path | None = None
    """Splat to begin with; None takes the points of the set."""
    random: Annotated[int, between(1, 100_000_000, "Gaussians")] | None = None
    """Begin with so many Gaussians anywhere instead."""
    outliers: Annotated[int, between(0, 100_000_000, "Gaussians")] = 0
    """Add so many in the air to those on the points of the set, as false matches do in a cloud from photographs."""
    downscale: Annotated[int, between(1, 64, "times smaller"), Called("FACTOR")] = 1
    """Integer factor by which the pictures shrink."""
    background: Colour = (0.0, 0.0, 0.0)
    """Colour behind the splat and transparent pixels, as white, #80b0e0 or three sRGB numbers in [0, 1]. See also
    --random-background."""
    near: Length | None = None
    """Gaussians nearer to a camera than this are not drawn, world units; none takes the 0.2 of 3DGS, or less where the
    scene or the distance of its cameras is small."""
    lpips: bool = False
    """Score the held-out pictures by LPIPS, too; its network is downloaded when it is first used."""
    checkpoint_every: Annotated[int, at_least(1, "steps", "1000 is usual")] = 1000
    """Steps between two checkpoints."""
    seed: Seed = 0
    """Seed of everything random."""
    json: bool = False
    """Print the figures as one JSON document on stdout."""

    def __post_init__(self) -> None:
        check(self)
        name = strategy_name(self.fit.strategy)
        if self.strategy != name:
            do = "pass both alike"
            raise InvalidValueError(message("strategy", f"{name}, as in fit", self.strategy, do))


def train_defaults(words: Sequence[str]) -> dict[str, Any]:
    """The strategy and its options, which say what further flags there are.

    Args:
        words: What the user typed after the command.

    Raises:
        InvalidValueError: There is no such strategy.
    """
    name = _STRATEGY
    for word, following in zip(words, [*words[1:], ""], strict=False):
        if word.partition("=")[0] == "--strategy":
            name = word.partition("=")[2] or following
    check_choice("--strategy", name, strategy_names())
    return {"strategy": name, "fit": FitConfig(strategy=strategy_config(name))}


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
    out: Folder = Path("scenes")
    """Folder for the files; made if it is not there. What is there under these names is replaced."""
    views: Annotated[int, at_least(1, "pictures")] | None = None
    """Pictures to fit to; None takes the recipe's number."""
    samples: Samples = 16
    """Samples per pixel in them; the pictures to compare with have twice as many."""
    steps: Steps | None = None
    """Steps of the training; None takes the recipe's number."""
    seed: Seed = 0
    """Seed of everything but the meshes."""
    json: bool = False
    """Print the record as one JSON document on stdout."""
