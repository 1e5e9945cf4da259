"""The options of each command, from which `mi_splat.cli.flags` makes flags; light, so that --help is fast."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from attacks.dagger.config import DaggerConfig
from mi_splat.cli.camera_options import CameraOptions
from mi_splat.cli.flags import Flag, Positional, Unprefixed
from mi_splat.cli.values import Colour, Size
from mi_splat.fields import Called, Count, Folder, Fraction, Length, Seed, above, at_least, between
from mi_splat.selection.config import Selection

Detectors = Annotated[tuple[str, ...], Called("DETECTOR")]
OneDetector = Annotated[str, Flag(name="detectors"), Called("DETECTOR")]
"""A detector of a command that takes one; the flag is called as where there may be several."""
ClassName = Annotated[str, Called("CLASS")]
Confidence = Annotated[Fraction, Called("CONFIDENCE")]
PositiveRadius = Annotated[float, above(0, "units of the splat file", "5 is the paper's"), Called("RADIUS")]
Seeds = Annotated[int, at_least(1), Called("COUNT")]
Groups = Annotated[tuple[str, ...], Called("TABLE")]
Processes = Annotated[int, between(0, 1024)]
Threads = Annotated[int, between(1, 1024)]


@dataclass(frozen=True, slots=True, kw_only=True)
class DaggerOptions:
    """Change the Gaussians of one object within a budget, until a detector takes it for something else (DAGGER).

    Writes before.png, after.png, difference.png, detections.png, attacked.ply, mask.npy (the object) and result.json
    into --out; of a scene XML also attacked.xml with its parts, which can be rendered and attacked again. The exit
    status is 0 also when the attack fails: that is a result.
    """

    scene: Positional[Path] = Path("scenes/car_street.xml")
    """Scene XML made of splats, or a splat file."""
    selection: Unprefixed[Selection] = field(default_factory=Selection)
    """The object whose Gaussians are attacked; all others stay as they are. If nothing is said, the part called car."""
    view: Unprefixed[CameraOptions] = field(default_factory=CameraOptions)
    """The cameras attacked at once."""
    objective: Literal["relabel", "hide", "untargeted"] = "relabel"
    """The aim: another class (--target), no detection at all, or any but the right class."""
    target: ClassName | None = None
    """Class that the detector shall see there (relabel); None is person."""
    confidence: Confidence | None = None
    """Confidence that counts as success: at least so much of the target class (0.7 if None), or less than it (0.3)."""
    detectors: Detectors = ("fasterrcnn_small",)
    """Name of the detector, or names of several to deceive at once (see `mi-splat detectors`)."""
    weights: tuple[Path, ...] = ()
    """Files with their weights, as many as there are detectors; none takes the shipped or published ones."""
    config: Unprefixed[DaggerConfig] = field(default_factory=DaggerConfig)
    """How to attack."""
    out: Folder = Path("out/dagger")
    """Folder for the results: a new one, written whole when the attack has ended."""
    force: bool = False
    """Replace an older result in --out."""
    json: bool = False
    """Print the result as one JSON document on stdout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectOptions:
    """Let detectors look at pictures, or at splats and scenes from cameras; draw the boxes and list them.

    Writes a picture with boxes for each picture and detector, and result.json, into --out.
    """

    inputs: Positional[tuple[Path, ...]] = ()
    """Pictures, splat files and scene XMLs; at least one."""
    detectors: Detectors = ("fasterrcnn_small",)
    """Names of detectors (see `mi-splat detectors`)."""
    weights: tuple[Path, ...] = ()
    """Files with their weights, as many as there are detectors; none takes the shipped or published ones."""
    view: Unprefixed[CameraOptions] = field(default_factory=CameraOptions)
    """Where splats and scenes are looked at from."""
    min_confidence: Confidence = 0.3
    """Confidence from which a detection is drawn and listed."""
    out: Folder = Path("out/detect")
    """Folder for the results; a new one."""
    force: bool = False
    """Replace a folder that an earlier call has written."""
    json: bool = False
    """Print the detections as one JSON document on stdout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateOptions:
    """Look at a clean and an attacked splat from many cameras, and compare what detectors make of them.

    Says how often the object is found, missed, or taken for the target, with 95 % intervals. The cameras should be
    others than those that were attacked. Writes a picture of both splats side by side for each detector, and
    result.json, into --out.
    """

    clean: Positional[Path]
    """The splat or scene XML before the attack."""
    attacked: Positional[Path]
    """The splat or scene XML after it."""
    selection: Unprefixed[Selection] = field(default_factory=Selection)
    """The object in the clean splat; if nothing is said, the Gaussians that differ."""
    view: Unprefixed[CameraOptions] = field(default_factory=CameraOptions)
    """Where both are looked at from."""
    detectors: Detectors = ("fasterrcnn_small",)
    """Names of detectors (see `mi-splat detectors`)."""
    weights: tuple[Path, ...] = ()
    """Files with their weights, as many as there are detectors; none takes the shipped or published ones."""
    original: ClassName | None = None
    """Class that the object is; None is what each detector calls it in most views of the clean splat."""
    target: ClassName | None = None
    """Class that the attacker wants."""
    min_confidence: Confidence = 0.5
    """Confidence from which a detection counts."""
    pictures: Count = 8
    """Views shown side by side; 0 writes no pictures."""
    out: Folder = Path("out/evaluate")
    """Folder for the results; a new one."""
    force: bool = False
    """Replace a folder that an earlier call has written."""
    json: bool = False
    """Print the figures as one JSON document on stdout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CloakOptions:
    """Do a study of CLOAK: capture, poison, train a clean and a cloaked splat, look at both, report.

    Says what it will take before it starts. A study that was interrupted goes on where it stopped when the same command
    is given again. Writes result.json, the rows, contact.png, plots and both splats into --out.
    """

    study: Positional[Path]
    """TOML file of the study, for instance scenes/cloak_car_occluder.toml."""
    out: Folder = Path("out/cloak")
    """Folder for the results: a new one, or that of the same study."""
    stages: Folder | None = None
    """Folder of the stages, which several studies may share; None is a folder in --out."""
    seeds: tuple[Seed, ...] = ()
    """Seeds in the place of those of the study."""
    detectors: Detectors = ()
    """Names of detectors in the place of those of the study."""
    weights: tuple[Path, ...] = ()
    """Files with their weights, as many as there are detectors; none takes the shipped or published ones."""
    forecast: bool = False
    """Check everything, say what the study would take, and do nothing."""
    json: bool = False
    """Print the summary as one JSON document on stdout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewOptions:
    """Look at a splat or at the result of an attack on a page in the browser, or write such a page to a file.

    Pictures are those of the renderer, spherical harmonics and all. Of a folder that `mi-splat dagger` or `mi-splat
    cloak` has written, the clean and the attacked splat are shown from one camera. The page is served to this machine
    alone until Ctrl-C; open it by the address that is printed.
    """

    path: Positional[Annotated[Path, Called("RESULT")]]
    """Splat file of any format that is read, scene XML made of splats, or folder of results."""
    clean: Path | None = None
    """Splat or scene to compare with; of a folder of results it is found."""
    detector: Annotated[str, Flag(name="detectors"), Called("DETECTOR")] | None = None
    """Name of a detector (see `mi-splat detectors`) that looks at the pictures of a resting camera."""
    weights: Path | None = None
    """File with the detector's weights; None takes the shipped ones."""
    size: Size | None = None
    """Pixels of the picture that the detector sees, as 256 or 256x192; None is that of the scene's cameras."""
    background: Colour | None = None
    """Colour behind the Gaussians, as white, #80b0e0 or three sRGB numbers in [0, 1]; None is the scene's own,
    black for a bare splat file."""
    near: Length | None = None
    """Gaussians nearer than this (depth, world units) are left out; None is the scene's own, 0.2 for a bare splat."""
    host: Annotated[str, Called("HOST")] = "127.0.0.1"
    """Name or address to serve on; one that other machines can reach needs --allow-remote."""
    port: Annotated[int, between(0, 65535, do="0 takes a free one"), Called("PORT")] = 8080
    """Port to serve on; 0 is any free one."""
    allow_remote: bool = False
    """Let other machines in that know the token in the address; nothing is encrypted. An SSH tunnel is better."""
    no_open: bool = False
    """Do not open a browser."""
    export: Path | None = None
    """Write one HTML file with pictures from all around instead, which needs no server and no network."""
    views: Annotated[tuple[int, int], at_least(1, "pictures"), Called("AZIMUTHS ELEVATIONS")] = (24, 4)
    """Azimuths and elevations of the pictures of --export."""
    force: bool = False
    """Replace the file of --export if it is there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DoctorOptions:
    """Render one Gaussian, take one gradient, load one detector; say what works and what to do about what does not.

    The exit status is 1 if something that `mi-splat dagger` needs does not work.
    """

    json: bool = False
    """Print the findings as one JSON document on stdout."""
