"""A trained splat and the stage that it is in; the same after a cleaning, which is a stage of its own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from attacks.cloak.cleaning import CleaningConfig, cleaned
from attacks.cloak.study import dependencies
from attacks.cloak.study.cache import Stage, StageCache
from mi_splat.io import load_splat, save_splat
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.training.resume import SPLAT

SPLAT_STAGES = ("splat", "layers", "cleaned")
"""Stages that make a splat."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainedSplat:
    """A trained splat.

    Attributes:
        splat: "clean" or "cloaked".
        seed: Of the training.
        file: Where it is.
        content: SHA-256 of the file.
        gaussians: Their number.
        hash: See `mi_splat.scene.scene_hash`.
        commit: Of the checkout that trained it, which may be an earlier one than that of the summary; None if unknown.
    """

    splat: str
    seed: int
    file: Path
    content: str
    gaussians: int
    hash: str
    commit: str | None = None

    def load(self) -> GaussianScene:
        """The splat from its file."""
        return load_splat(self.file)


def trained_splat(which: str, seed: int, stage: Stage) -> TrainedSplat:
    """The splat of a finished stage."""
    scene = load_splat(stage.folder / SPLAT)
    return TrainedSplat(
        splat=which,
        seed=seed,
        file=stage.folder / SPLAT,
        content=stage.content,
        gaussians=len(scene),
        hash=scene_hash(scene),
        commit=stage.commit,
    )


def cleaned_splat(splat: TrainedSplat, cleaning: CleaningConfig, cache: StageCache) -> TrainedSplat:
    """A splat after a cleaning, or what is left of it from before.

    Raises:
        InvalidValueError: Nothing would be left of the splat.
    """

    def make(path: Path) -> None:
        save_splat(cleaned(splat.load(), cleaning), path / SPLAT)

    stage = cache.finished("cleaned", dependencies.of_cleaned(splat.content, cleaning), make, outputs=(SPLAT,))
    return trained_splat(splat.splat, splat.seed, stage)
