"""A splat that is trained on a set of pictures, as a victim does it who knows of no attack."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cloak.cleaning import inliers
from attacks.cloak.kinds.parts import SET
from mi_splat.cameras import View
from mi_splat.datasets import load_dataset
from mi_splat.io.points import PointCloud
from mi_splat.rendering import Renderer, RenderSettings, ScreenGradients
from mi_splat.training.config import FitConfig
from mi_splat.training.initialization import from_points, with_outliers
from mi_splat.training.resume import METRICS, SPLAT, train

if TYPE_CHECKING:
    from mi_splat.ledger import Out

VARIES = (METRICS,)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """How a splat is trained.

    Attributes:
        fit: The trainer's settings.
        background: sRGB colour behind the pictures.
        near: Near plane, world units.
        seed: Of the training.
        outliers: Points in the air that the cloud has besides those on surfaces.
        point_deviations: Outliers of so many standard deviations are removed from the cloud; None keeps all points.
    """

    fit: FitConfig
    background: tuple[float, float, float]
    near: float
    seed: int
    outliers: int = 0
    point_deviations: float | None = None


def run(config: TrainConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Train it, or go on with what an interrupted training left."""
    views = load_dataset(inputs["pictures"] / SET, split="train", background=config.background)
    assert views.points is not None  # a capture writes them
    cloud = starting_cloud(config, views.points, views)
    settings = RenderSettings(background=config.background, near=config.near)
    gradients = ScreenGradients() if config.fit.strategy.needs_screen_gradients else None
    train(
        views,
        from_points(cloud.points, cloud.colours),
        out.partial,
        render=Renderer(settings, screen_gradients=gradients),
        config=config.fit,
        seed=config.seed,
        on_step=lambda line: out.progress("training", line.iteration, config.fit.iterations),
    )
    for name in (SPLAT, METRICS):
        os.replace(out.partial / name, out / name)


def starting_cloud(config: TrainConfig, surfaces: PointCloud, views: Sequence[View]) -> PointCloud:
    """The points that a training starts from, after the cleaning that the victim does before it.

    Args:
        config: How many outliers there are, and which points the victim removes.
        surfaces: The points of the set.
        views: Where the cameras are; pictures are not read.
    """
    cloud = with_outliers(surfaces, views, config.outliers, seed=config.seed)
    if config.point_deviations is None:
        return cloud
    kept = inliers(cloud.points, config.point_deviations)
    return PointCloud(cloud.points[kept], cloud.colours[kept])
