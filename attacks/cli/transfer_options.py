"""The options of the commands that ask how far DAGGER's results carry; light, so that --help is fast."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class DaggerTransferOptions:
    """Attack each detector, and all but one at once; let every detector judge each attacked splat.

    The paper's six pairs. A study that was interrupted goes on where it stopped when the same command is given again,
    and a further detector judges the splats that are there. Writes jobs/, attacked/, judged/, transfer.md,
    transfer.json and transfer.png (the matrix) into --out.
    """

    detectors: tuple[str, ...] = ()
    """Names of detectors (see `mi-splat detectors`) that are attacked and judge; none takes those of the project that
    can be loaded."""
    judges: tuple[str, ...] = ()
    """Names of detectors that judge and are not attacked."""
    seeds: int = 3
    """Number of seeds; each but 0 moves the camera and starts at a random point of the ball."""
    eps: float = 10.0
    """Radius of the l2 ball over the object's SH coefficients."""
    steps: int = 20
    """Number of steps."""
    ensembles: bool = True
    """Attack all detectors but one at once, too."""
    scenes: Path = Path("scenes")
    """Folder with the scene files."""
    out: Path = Path("out/studies/transfer")
    """Folder for the results: a new one, or that of the same study."""
    json: bool = False
    """Print the names of the files as one JSON document on stdout."""
