"""The options of the commands about artifacts; light, so that --help is fast."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from attacks.cli.options import Detectors
from mi_splat.cli.flags import Positional
from mi_splat.fields import Called, Folder, Fraction, at_least


@dataclass(frozen=True, slots=True, kw_only=True)
class ArtifactOptions:
    """Copy a finished result into a folder that others can check: its record, raw rows, cameras, and manifest.

    Splats and pictures are left out unless --whole is given. Nothing is packed whose files were changed, or whose rows
    do not give its figures. The manifest is copied as it is, so that the copy has the same name: the SHA-256 of it.
    """

    result: Positional[Annotated[Path, Called("RESULT")]]
    """Folder of the finished result."""
    out: Folder = Path("out/artifact")
    """Folder for the copy: a new one, written whole."""
    whole: bool = False
    """Copy splats and pictures, too, so that others can score the splats again."""
    force: bool = False
    """Replace an older artifact in --out."""
    json: bool = False
    """Print what was packed as one JSON document on stdout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ArtifactCheckOptions:
    """Check results: the bytes of every file, and every figure, derived again from the raw rows alone.

    Each file and each figure is a line, green, red, or grey where it was left out. The exit status is 1 if one is red.
    With --rescore the splats are rendered and detectors look at them again.
    """

    folders: Positional[tuple[Folder, ...]] = ()
    """Folders of results or of their copies; at least one."""
    manifest: Annotated[tuple[str, ...], Called("SHA256")] = ()
    """SHA-256 that the manifest of each folder has to have; none asks for none."""
    rescore: bool = False
    """Render the splats from cameras.json, let detectors look, and say how the rates moved."""
    splats: Folder | None = None
    """Folder with the splats of --rescore, for instance the result's; None takes those in the folder."""
    detectors: Detectors = ()
    """Names of detectors for --rescore; none takes the result's."""
    weights: tuple[Path, ...] = ()
    """Files with their weights, as many as there are detectors; none takes the shipped or published ones."""
    every: Annotated[int, at_least(1, "cameras")] = 1
    """Use each so manieth camera (--rescore)."""
    rate_tolerance: Fraction = 0.02
    """How far a rate may move (--rescore); on another machine scores differ in their last digits."""
    json: bool = False
    """Print the lines as one JSON document on stdout."""
