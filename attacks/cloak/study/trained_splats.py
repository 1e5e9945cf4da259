"""A trained splat and the stage that it is in: what its training starts from, and what a cleaning leaves of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from attacks.cloak.cleaning import cleaned, inliers
from attacks.cloak.config import CleaningConfig, TrainingConfig
from attacks.cloak.study import dependencies
from attacks.cloak.study.cache import Stage, StageCache
from mi_splat.cameras import View
from mi_splat.io import load_splat, save_splat
from mi_splat.io.points import PointCloud
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.training.initialization import with_outliers
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


def starting_cloud(training: TrainingConfig, surfaces: PointCloud, views: Sequence[View], *, seed: int) -> PointCloud:
    """The points that a training starts from, after the cleaning that the victim does before it.

    Args:
        training: How many outliers there are, and which points the victim removes.
        surfaces: The points of the set.
        views: Where the cameras are; pictures are not read.
        seed: Of the training.
    """
    cloud = with_outliers(surfaces, views, training.outliers, seed=seed)
    if training.point_deviations is None:
        return cloud
    kept = inliers(cloud.points, training.point_deviations)
    return PointCloud(cloud.points[kept], cloud.colours[kept])


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
