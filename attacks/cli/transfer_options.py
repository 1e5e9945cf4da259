"""The options of the commands that ask how far DAGGER's results carry; light, so that --help is fast."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from attacks.cli.options import ClassName, Confidence, Detectors, OneDetector, PositiveRadius, Seeds
from attacks.limits import NormName
from mi_splat.cli.camera_options import CameraOptions
from mi_splat.cli.flags import Positional, Unprefixed
from mi_splat.fields import Called, Folder, Steps, at_least
from mi_splat.selection.config import Selection


@dataclass(frozen=True, slots=True, kw_only=True)
class DaggerTransferOptions:
    """Attack each detector, and all but one at once; let every detector judge each attacked splat.

    The paper's six pairs. A study that was interrupted goes on where it stopped when the same command is given again,
    and a further detector judges the splats that are there. Writes jobs/, attacked/, judged/, transfer.md,
    transfer.json and transfer.png (the matrix) into --out.
    """

    detectors: Detectors = ()
    """Names of detectors (see `mi-splat detectors`) that are attacked and judge; none takes those of the project that
    can be loaded."""
    judges: Detectors = ()
    """Names of detectors that judge and are not attacked."""
    seeds: Seeds = 3
    """Number of seeds; each but 0 moves the camera and starts at a random point of the ball."""
    eps: PositiveRadius = 10.0
    """Radius of the l2 ball over the object's SH coefficients."""
    steps: Steps = 20
    """Number of steps."""
    ensembles: bool = True
    """Attack all detectors but one at once, too."""
    eot_study: Folder | None = None
    """Folder of `mi-splat dagger-eot-study`: attack nothing, let the detectors judge its splats on their held-out views
    (held_out.md, held_out.json, held_out.png)."""
    views: Annotated[int, at_least(1)] = 24
    """Held-out views of each of these splats."""
    scenes: Folder = Path("scenes")
    """Folder with the scene files."""
    out: Folder = Path("out/studies/transfer")
    """Folder for the results: a new one, or that of the same study."""
    json: bool = False
    """Print the names of the files as one JSON document on stdout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderingStudyOptions:
    """Attack in one renderer, judge under others: renderers, files, hours of a day in a street of meshes.

    The shipped studies are in scenes/studies. One that was interrupted goes on where it stopped when the same command
    is given again. Writes jobs/, attacked/, looks/, study.md, study.json and study.png into --out.
    """

    study: Positional[Path]
    """TOML file of the study."""
    detectors: Detectors = ()
    """Names of detectors in the place of those of the file."""
    seeds: Seeds | None = None
    """Number of seeds; none takes that of the file."""
    scenes: Folder = Path("scenes")
    """Folder with the scene files."""
    out: Folder = Path("out/studies/rendering")
    """Folder for the results: a new one, or that of the same study."""
    json: bool = False
    """Print the names of the files as one JSON document on stdout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DaggerSanityOptions:
    """Check whether DAGGER is a sane attack on an object and a detector, so that its failures can be believed.

    Success has to rise with the radius, many steps, white boxes and gradients have to do no worse than one step,
    another detector and random search, gradients have to equal finite differences, and so on. Each check is a line,
    green or red. Writes sanity.md and result.json into --out. The exit status is 1 if a line is red.
    """

    scene: Positional[Path] = Path("scenes/car_street.xml")
    """Scene XML made of splats, or a splat file."""
    selection: Unprefixed[Selection] = field(default_factory=Selection)
    """The object whose Gaussians are attacked. If nothing is said, the part called car."""
    view: Unprefixed[CameraOptions] = field(default_factory=CameraOptions)
    """The camera; of several, the first. Each seed but 0 moves it about the object."""
    target: ClassName = "person"
    """Class that the detector shall see there."""
    confidence: Confidence = 0.7
    """Confidence in it that counts as success."""
    detector: OneDetector = "fasterrcnn_small"
    """Name of the detector (see `mi-splat detectors`)."""
    weights: Path | None = None
    """File with the detector's weights; None takes the shipped ones."""
    surrogate: Annotated[str, Called("DETECTOR")] = "auto"
    """Name of another detector, from which attacks are transferred; auto takes one that can be loaded, none leaves it
    out."""
    seeds: Seeds = 3
    """Number of seeds; each but 0 moves the camera and starts at a random point of the ball."""
    eps: PositiveRadius = 5.0
    """Radius of the ball over the object's SH coefficients; the checks also take fractions and multiples of it."""
    norm: NormName = "l2"
    """How the change is measured: one ball over the whole object (linf, l2), or one for each Gaussian."""
    steps: Steps = 20
    """Number of steps of an attack."""
    out: Folder = Path("out/sanity")
    """Folder for the results: a new one, written whole when the last check has ended."""
    force: bool = False
    """Replace an older result in --out."""
    json: bool = False
    """Print the findings as one JSON document on stdout."""
