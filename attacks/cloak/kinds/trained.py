"""A splat that is trained on a set of pictures, as a victim does it who knows of no attack."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cloak.cleaning import inliers
from attacks.cloak.config import StudyConfig, fit_config
from attacks.cloak.kinds.parts import SET, StepConfig
from attacks.cloak.kinds.rendering import renderer_of
from mi_splat.cameras import RenderFn, View
from mi_splat.datasets import load_dataset
from mi_splat.io.points import PointCloud
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig
from mi_splat.training.initialization import from_points, with_outliers
from mi_splat.training.resume import METRICS, SPLAT, train

if TYPE_CHECKING:
    from mi_splat.ledger import Out

VARIES = (METRICS,)


def run(config: StepConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Train the splat of a job, or go on with what an interrupted training left."""
    study = config.asked
    views = load_dataset(inputs["pictures"] / SET, split="train", background=study.scene.background)
    assert views.points is not None  # a capture writes them
    cloud = starting_cloud(study, views.points, views)
    fit = fit_config(study.training)
    train_into(out, views, from_points(cloud.points, cloud.colours), renderer_of(study, fit), fit, seed=study.seeds[0])


def train_into(
    out: Out, views: Sequence[View], start: GaussianScene, render: RenderFn, fit: FitConfig, *, seed: int
) -> None:
    """Train a splat, or go on, and leave its file and its metrics."""
    train(
        views,
        start,
        out.partial,
        render=render,
        config=fit,
        seed=seed,
        on_step=lambda line: out.progress("training", line.iteration, fit.iterations),
    )
    for name in (SPLAT, METRICS):
        os.replace(out.partial / name, out / name)


def starting_cloud(study: StudyConfig, surfaces: PointCloud, views: Sequence[View]) -> PointCloud:
    """The points that a training starts from, after the cleaning that the victim does before it."""
    training = study.training
    cloud = with_outliers(surfaces, views, training.outliers, seed=study.seeds[0])
    if training.point_deviations is None:
        return cloud
    kept = inliers(cloud.points, training.point_deviations)
    return PointCloud(cloud.points[kept], cloud.colours[kept])
