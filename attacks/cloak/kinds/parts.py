"""What the jobs of a study hold: a scene and its cameras where they know it, or how a splat is rendered."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from attacks.cloak.config import AttackConfig, CameraConfig, EvaluationConfig, SceneConfig
from attacks.cloak.setup import Setup
from mi_splat.cameras import Camera
from mi_splat.rendering import Renderer, RenderSettings, ScreenGradients
from mi_splat.training.config import FitConfig

SET, MESH = "set", "mesh"
"""Folder of a set of pictures in what a job leaves, and name of the input that is a mesh file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneJob:
    """A job that knows the scene."""

    scene: SceneConfig
    cameras: CameraConfig
    content: str  # digest of meshes and light (`CaptureSource.digest`)
    attacks: tuple[AttackConfig, ...] = ()
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    near: float | None = None  # near plane of pictures of splats; None where there are none
    seed: int = 0

    def setup(self, inputs: Mapping[str, Path]) -> Setup:
        """Meshes and cameras, of the mesh file if the job has one as an input."""
        scene = replace(self.scene, object=str(inputs[MESH])) if MESH in inputs else self.scene
        return Setup(
            scene=scene,
            cameras=self.cameras,
            attacks=self.attacks,
            evaluation=self.evaluation,
            near_plane=self.near,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SplatJob:
    """A job that trains or renders a splat, and knows nothing of the scene but its pictures."""

    background: tuple[float, float, float]  # sRGB behind the splat
    near: float  # near plane, world units
    device: str = "cpu"

    def renderer(self, fit: FitConfig | None = None) -> Renderer:
        """What renders the splat; that of a training if its settings are given."""
        return renderer_of(self.background, self.near, fit=fit, device=self.device)


def renderer_of(
    background: tuple[float, float, float], near: float | None, *, fit: FitConfig | None = None, device: str = "cpu"
) -> Renderer:
    """What renders the splats of a study; that of a training if its settings are given."""
    gradients = fit is not None and fit.strategy.needs_screen_gradients
    variant = "cuda_ad_rgb" if device == "cuda" else ""
    assert near is not None
    settings = RenderSettings(background=background, near=near, variant=variant)
    return Renderer(settings, screen_gradients=ScreenGradients() if gradients else None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """A camera, to the bit."""

    to_world: tuple[float, ...]
    focal: tuple[float, float]  # of x and of y, pixels
    principal: tuple[float, float]  # of x and of y, pixels
    size: tuple[int, int]  # width and height, pixels

    @classmethod
    def of(cls, camera: Camera) -> Pose:
        """The numbers of a camera."""
        return cls(
            to_world=tuple(camera.to_world.flatten().tolist()),
            focal=(camera.fx, camera.fy),
            principal=(camera.cx, camera.cy),
            size=(camera.width, camera.height),
        )

    @property
    def camera(self) -> Camera:
        """The camera."""
        pose = torch.tensor(self.to_world, dtype=torch.float64).reshape(4, 4)
        width, height = self.size
        return Camera(to_world=pose, focal=self.focal, width=width, height=height, principal=self.principal)
