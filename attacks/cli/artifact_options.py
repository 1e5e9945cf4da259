"""The options of the commands about artifacts; light, so that --help is fast."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True, slots=True, kw_only=True)
class ArtifactOptions:
    """Pack a finished result into a folder that others can check: raw rows, cameras, configuration, expected figures.

    Takes the folder that `mi-splat cloak`, `dagger`, `dagger-eot`, `dagger-study`, `dagger-eot-study`, `dagger-pairs`
    or `dagger-transfer` has written. Writes artifact.json, the tables of raw rows, and what the result has of
    cameras.json, study.toml and splats/ into --out. Nothing is rendered, unless --detections asks for it.
    """

    result: Positional[Path]
    """Folder of the finished result."""
    out: Path = Path("out/artifact")
    """Folder for the artifact: a new one, written whole."""
    stages: Path | None = None
    """Folder of the study's stages, where its observations are; None is a folder in the result's (cloak)."""
    page: tuple[str, ...] = ()
    """Pages of the documentation that show the result's figures, relative to the checkout."""
    splats: bool = False
    """Pack the splats, too, so that others can score them again."""
    detections: bool = False
    """Let the study's detectors look at its splats again, and keep every detection as a row (cloak)."""
    weights: tuple[Path, ...] = ()
    """Files with the detectors' weights, in the study's order; none takes the shipped or published ones."""
    force: bool = False
    """Replace an older artifact in --out."""
    json: bool = False
    """Print artifact.json on stdout."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ArtifactCheckOptions:
    """Check artifacts: the bytes of every file, and every figure, derived again from the raw rows alone.

    Each file and each figure is a line, green or red. The exit status is 1 if a line is red.
    With --rescore the splats are rendered and detectors look at them again.
    """

    folders: Positional[tuple[Path, ...]] = ()
    """Folders of artifacts; at least one."""
    pages: Path | None = None
    """Checkout whose pages have to show these figures; None looks at none."""
    rescore: bool = False
    """Render the splats from cameras.json, let detectors look, and say how the rates moved."""
    splats: Path | None = None
    """Folder with the splats of --rescore, for instance the result's; None takes those in the artifact."""
    detectors: tuple[str, ...] = ()
    """Names of detectors for --rescore; none takes the artifact's."""
    weights: tuple[Path, ...] = ()
    """Files with their weights, as many as there are detectors; none takes the shipped or published ones."""
    every: int = 1
    """Use each so manieth camera (--rescore)."""
    rate_tolerance: float = 0.02
    """How far a rate may move (--rescore); on another machine scores differ in their last digits."""
    json: bool = False
    """Print the lines as one JSON document on stdout."""
