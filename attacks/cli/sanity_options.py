"""The options of `mi-splat dagger-sanity`; light, so that --help is fast."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from attacks.cli.options import ClassName, Confidence, OneDetector, PositiveRadius, Seeds
from attacks.limits import NormName
from mi_splat.cli.camera_options import CameraOptions
from mi_splat.cli.flags import Positional, Unprefixed
from mi_splat.fields import Called, Folder, Steps
from mi_splat.selection.config import Selection


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
