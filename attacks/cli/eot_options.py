"""The options of DAGGER on distributions of views; light, so that --help is fast."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from attacks.cli.options import ClassName, Confidence, Detectors
from attacks.dagger.config import EotConfig
from attacks.transformations.config import CameraRegion, PictureChanges
from mi_splat.cli.camera_options import CameraOptions
from mi_splat.cli.flags import Positional, Unprefixed
from mi_splat.fields import Folder
from mi_splat.selection.config import Selection


@dataclass(frozen=True, slots=True, kw_only=True)
class DaggerEotOptions:
    """Attack one object so that detectors misread it from all cameras of a region, not from one (DAGGER with EOT).

    Views are drawn at random, new ones at each step or from a pool; others judge the result. Writes held_out.png,
    attacked.ply, mask.npy (the object) and result.json into --out; of a scene XML also attacked.xml with its parts.
    An attack that was interrupted goes on where it stopped when the same command is given again. The exit status is 0
    also when the attack fails: that is a result.
    """

    scene: Positional[Path] = Path("scenes/car_street.xml")
    """Scene XML made of splats, or a splat file."""
    selection: Unprefixed[Selection] = field(default_factory=Selection)
    """The object whose Gaussians are attacked; all others stay as they are. If nothing is said, the part called car."""
    view: Unprefixed[CameraOptions] = field(default_factory=CameraOptions)
    """The reference camera, the first if there are several: size of the pictures, field of view, unit of distances."""
    region: Unprefixed[CameraRegion] = field(default_factory=CameraRegion)
    """Where the object is looked at from."""
    pictures: Unprefixed[PictureChanges] = field(default_factory=PictureChanges)
    """What happens to the pictures between renderer and detector; by default nothing."""
    objective: Literal["relabel", "hide", "untargeted"] = "relabel"
    """The aim: another class (--target), no detection at all, or any but the right class."""
    target: ClassName | None = None
    """Class that the detectors shall see there (relabel); None is person."""
    confidence: Confidence | None = None
    """Confidence that counts as success: at least so much of the target class (0.7 if None), or less than it (0.3)."""
    detectors: Detectors = ("fasterrcnn_small",)
    """Names of the detectors that are attacked at once (see `mi-splat detectors`)."""
    weights: tuple[Path, ...] = ()
    """Files with their weights, as many as there are detectors; none takes the shipped or published ones."""
    config: Unprefixed[EotConfig] = field(default_factory=EotConfig)
    """How to attack."""
    checkpoint: Path | None = None
    """File that keeps the search while it runs; None is one beside --out."""
    out: Folder = Path("out/dagger-eot")
    """Folder for the results: a new one, written whole when the attack has ended."""
    force: bool = False
    """Replace an older result in --out."""
    json: bool = False
    """Print the result as one JSON document on stdout."""
