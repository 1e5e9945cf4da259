"""What every job of a study holds: the study, in which settings that do not matter for the job have their defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from attacks.cloak.config import StudyConfig
from mi_splat.cameras import Camera

SET, MESH = "set", "mesh"
"""Folder of a set of pictures in what a job leaves, and name of the input that is a mesh file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StepConfig:
    """What a job of a study depends on.

    Attributes:
        asked: The study, as far as it counts; a mesh file is an input, and stands here as if it were an asset.
        content: Digest of meshes and light (`CaptureSource.digest`); empty where the scene has no part.
    """

    asked: StudyConfig
    content: str = ""

    def study(self, inputs: Mapping[str, Path]) -> StudyConfig:
        """The study, with its mesh file if the job has one as an input."""
        scene = self.asked.scene
        return replace(self.asked, scene=replace(scene, object=str(inputs[MESH]))) if MESH in inputs else self.asked


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """A camera, to the bit.

    Attributes:
        to_world: 16 numbers, row by row.
        focal: Of x and of y, pixels.
        principal: Of x and of y, pixels.
        size: Width and height, pixels.
    """

    to_world: tuple[float, ...]
    focal: tuple[float, float]
    principal: tuple[float, float]
    size: tuple[int, int]

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
