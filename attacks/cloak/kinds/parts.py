"""What jobs hold of a study: the parts that a step depends on, and nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from attacks.cloak.config import AttackConfig, CameraConfig, SceneConfig, StudyConfig
from mi_splat.assets import ASSETS
from mi_splat.cameras import Camera

SET, MESH = "set", "mesh"
"""Folder of a set of pictures in what a job leaves, and name of the input that is a mesh file."""

_PLAIN = SceneConfig()
_NONE = AttackConfig(name="none", elevation=(1.0, 90.0))
_MESH_FIELDS = ("up", "scale", "rotate", "front")


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneParts:
    """What is photographed, from where, and how attacks change it.

    Attributes:
        scene: What is photographed; a mesh file is an input, and stands here as if it were an asset.
        cameras: Where from.
        content: Digest of meshes and light (`CaptureSource.digest`).
        attack: Those that have a part in the step, with what it depends on.
    """

    scene: SceneConfig
    cameras: CameraConfig
    content: str
    attack: tuple[AttackConfig, ...] = ()

    @classmethod
    def of(
        cls,
        study: StudyConfig,
        content: str,
        attack: Sequence[AttackConfig] = (),
        *,
        background: bool = True,
        label: bool = False,
    ) -> SceneParts:
        """The parts of a study.

        Args:
            study: The study.
            content: Digest of its meshes and light.
            attack: Attacks, with what counts of them.
            background: Whether the colour behind the scene counts.
            label: Whether it counts what detectors call the object.
        """
        scene, is_mesh = study.scene, is_mesh_file(study)
        kept = replace(
            scene,
            object=next(iter(ASSETS)) if is_mesh else scene.object,
            label=scene.class_name if label else "object",
            background=scene.background if background else _PLAIN.background,
            **({} if is_mesh else {name: getattr(_PLAIN, name) for name in _MESH_FIELDS}),
        )
        return cls(scene=kept, cameras=study.cameras, content=content, attack=tuple(attack))

    def study(self, inputs: Mapping[str, Path], **others: Any) -> StudyConfig:
        """The parts as a study, for functions that take a whole one.

        Args:
            inputs: Of the job; its mesh file is there if it has one.
            others: Further parts.
        """
        scene = replace(self.scene, object=str(inputs[MESH])) if MESH in inputs else self.scene
        return StudyConfig(name="job", scene=scene, cameras=self.cameras, attack=self.attack or (_NONE,), **others)


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


def is_mesh_file(study: StudyConfig) -> bool:
    """Whether the object of a study comes from a mesh file."""
    return Path(study.scene.object).is_file()
