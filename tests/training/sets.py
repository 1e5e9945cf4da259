"""A small splat, images of it, and settings that train it in a second."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from mi_splat.cameras.camera import Camera, View, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import orbit
from mi_splat.io.points import PointCloud
from mi_splat.render.renderer import Renderer, RenderSettings, ScreenGradients
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig
from mi_splat.training.strategies import ClassicConfig, Step
from tests.datasets.sets import write_transforms
from tests.gaussians import varied_scene

SHORT = FitConfig(
    iterations=60,
    sh_degree=1,
    sh_degree_interval=20,
    eval_interval=30,
    strategy=ClassicConfig(
        densify_from=10,
        densify_until=15_000,
        densify_interval=20,
        densify_grad_threshold=1e-5,
        opacity_reset_interval=50,
        max_gaussians=90,
    ),
)


def scene_and_views(count: int = 60) -> tuple[GaussianScene, list[View], GaussianScene]:
    """A small splat, images of it, and a start that is not far from it."""
    truth = varied_scene(count, degree=1, seed=9)
    render = Renderer()
    cameras = [
        Camera(
            to_world=look_at((4 * x, 4 * y, 1.0), (0, 0, 0)),
            lens=Lens(focal=40.0, size=(36, 32)),
        )
        for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1), (0.7, 0.7))
    ]
    with torch.no_grad():
        views = [View(camera, render(truth, camera).clamp(0, 1)) for camera in cameras]
    generator = torch.Generator().manual_seed(1)
    start = truth.replace(
        means=truth.means + 0.05 * torch.randn(truth.means.shape, generator=generator),
        sh=torch.zeros_like(truth.sh),
    )
    return truth, views, start


def watching() -> Renderer:
    return Renderer(RenderSettings(), screen_gradients=ScreenGradients())


def views_of(count: int = 6) -> tuple[GaussianScene, list[View]]:
    truth = varied_scene(50, degree=1, seed=9)
    cameras: list[Camera] = orbit(
        (0.0, 0.0, 0.0),
        count=count,
        elevation=20.0,
        distance=4.0,
        lens=Lens(focal=36.0, size=(32, 32)),
    )
    with torch.no_grad():
        return truth, [
            View(camera, Renderer()(truth, camera).clamp(0, 1)) for camera in cameras
        ]


def write_set(folder: Path, factor: float = 1.0) -> Path:
    """Images of `views_of` on the disk, the first one as a test image too, with a
    grey cloud, and scaled.
    """
    truth, views = views_of()
    cameras = orbit(
        (0.0, 0.0, 0.0),
        count=6,
        elevation=20.0,
        distance=4.0 * factor,
        lens=Lens(focal=36.0, size=(32, 32)),
    )
    views = [
        View(camera, view.image) for camera, view in zip(cameras, views, strict=True)
    ]
    cloud = PointCloud(factor * truth.means, torch.full((50, 3), 0.5))
    write_transforms(folder, views, test=views[:1], points=cloud)
    return folder


@dataclass
class Seen:
    lengths: Tensor
    visible: Tensor


def small(count: int = 3) -> dict[str, Tensor]:
    """Opaque Gaussians a thousandth of the scene in size."""
    return {
        "means": torch.zeros(count, 3),
        "scales": torch.full((count, 3), 1e-3).log(),
        "rotations": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        "opacities": torch.full((count,), 3.0),
        "sh0": torch.zeros(count, 1, 3),
        "shN": torch.zeros(count, 3, 3),
    }


def step_of(
    values: dict[str, Tensor], iteration: int, iterations: int, seen: Seen
) -> Step:
    generator = torch.Generator().manual_seed(0)
    return Step(
        parameters=values,
        iteration=iteration,
        iterations=iterations,
        scene_extent=1.0,
        lr_means=1e-4,
        generator=generator,
        screen_gradients=seen,
    )
