"""The options of `mi-splat cloak-experiment`; light, so that --help is fast."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from attacks.cli.options import Detectors
from mi_splat.cli.flags import Positional
from mi_splat.fields import Called, Folder, at_least

ExperimentName = Literal[
    "surroundings",
    "distance",
    "formats",
    "renderers",
    "street",
    "transition-limit",
    "paint-direction",
    "perfect-splat",
    "detection-curve",
]


@dataclass(frozen=True, slots=True, kw_only=True)
class CloakExperimentOptions:
    """Explain a figure of a CLOAK study.

    surroundings: how far the cloaked splat is from the clean one beside the object. distance: from how many cameras the
    object is found when they stand nearer or farther away. formats and renderers: whether the cloaked splat hides its
    object after other file formats, and in other renderers. street: whether it does so on a path-traced street of
    meshes, by the hour of the day. transition-limit: how sharply colour alone can switch. paint-direction: from where a
    painted sign is seen best. perfect-splat: the rates of a splat that shows its attacks perfectly, from path-traced
    pictures of them. detection-curve: from where detectors find the object in path-traced pictures, on the clean and on
    the cloaked splats; writes a table, plots and pictures into --out.
    """

    experiment: Positional[ExperimentName]
    """Which experiment."""
    study: Positional[Path]
    """TOML file of the study."""
    results: Folder | None = None
    """Folder that `mi-splat cloak` has written for this study; of transition-limit, what is drawn beside the limit."""
    every: Annotated[int, at_least(1, "cameras")] = 4
    """Use each so manieth of the held-out cameras, where an experiment looks from them."""
    detectors: Detectors = ()
    """Names of detectors in the place of those of the study, where an experiment has some."""
    weights: tuple[Path, ...] = ()
    """Files with their weights, as many as there are detectors; none takes the shipped or published ones."""
    stages: Folder | None = None
    """Folder of the study's stages; None is a folder in --results (detection-curve, perfect-splat)."""
    out: Annotated[Path, Called("PATH")] | None = None
    """What is written: a folder (detection-curve), a PNG file with the limit (transition-limit), or a JSON file."""
