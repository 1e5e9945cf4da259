"""The options of the command that compares renderers; light, so that --help is fast."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from mi_splat.cli.camera_options import CameraOptions
from mi_splat.cli.flags import Positional, Unprefixed
from mi_splat.fields import Called, Folder, Seed, between


@dataclass(frozen=True, slots=True, kw_only=True)
class CompareOptions:
    """Compare renderers on one splat: pictures, gradients, time and memory.

    Writes result.json, a sheet for each camera (the pictures side by side, and where each two differ), the pictures
    of each method, and compare.html, a page that needs no network (it needs the extra `report`).

    Methods: tile is the picture of the reference 3DGS rasteriser, tile-antialiased the same with the filter of
    Mip-Splatting; ray meets each Gaussian at its peak along the ray, ray-to-mean is the same with the colours of tile;
    volprim is Mitsuba's volprim_rf_basic; gsplat is the package of that name, on an NVIDIA GPU; folder:PATH is a folder
    of pictures of any other program, called as the cameras.
    """

    scene: Positional[Path]
    """A splat file, or a scene XML made of splats."""
    methods: Annotated[tuple[str, ...], Called("METHOD")] = ("tile", "ray")
    """Two or more of these methods, with commas or spaces between them."""
    view: Unprefixed[CameraOptions] = field(default_factory=CameraOptions)
    """Where from."""
    out: Folder = Path("out/compare")
    """Folder for the results."""
    gradients: bool = True
    """Compare the gradients of methods that have them."""
    rounds: Annotated[int, between(0, 1000, "rounds", "5 is usual")] = 5
    """How often each method is timed, in turn; 0 measures neither time nor memory."""
    lpips: bool = False
    """Measure LPIPS, too; its network is downloaded when it is first used."""
    amplify: Annotated[float, between(1, 1000, "times", "8 is usual"), Called("FACTOR")] = 8.0
    """By how much differences are multiplied in the pictures."""
    seed: Seed = 0
    """Of the random weights of the pixels whose weighted sum is differentiated."""
    force: bool = False
    """Replace a comparison that is in the folder."""
    json: bool = False
    """Print result.json on stdout."""
