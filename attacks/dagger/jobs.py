"""Where the attacks of a study are done: scenes are read once, and every attack is one self-contained job."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Generator

from attacks.budgets import NormName
from attacks.dagger.attack import Attribute, DaggerConfig, attack
from attacks.dagger.report import summary
from attacks.detectors.base import Detector
from attacks.objectives import Objective, hide, relabel
from mi_splat.cameras import Camera, RenderFn
from mi_splat.errors import InvalidValueError, message
from mi_splat.scene import GaussianScene, scene_hash


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One attack of a study.

    Attributes:
        group: Table that it belongs to.
        scene: Name of the scene file without its suffix.
        object: Id of the object.
        target: Class wanted; None hides the object.
        attribute: What may change.
        eps: Radius.
        norm: Norm of the budget.
        camera: Position of the first camera that is attacked, in the order of the scene file.
        views: Number of the scene's cameras that are attacked together, from that one on; 0 is all of them.
        seed: See `attacks.dagger.study`.
    """

    group: str
    scene: str
    object: str
    target: str | None
    attribute: Attribute = "sh"
    eps: float = 5.0
    norm: NormName = "l2"
    camera: int = 0
    views: int = 1
    seed: int = 0

    @property
    def name(self) -> str:
        """File name, unique within a study."""
        words = (
            self.group,
            self.object,
            self.target or "hide",
            self.attribute,
            self.norm,
            f"{self.eps:g}",
            *([f"camera{self.camera}"] if self.camera else []),
            str(self.seed),
        )
        return "-".join(word.replace(" ", "_") for word in words)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AttackScene:
    """A scene ready for attacks.

    Attributes:
        scene: All Gaussians.
        objects: Rows of each object.
        cameras: The scene's views, in the order of its file.
        render: Renderer with the scene's settings.
    """

    scene: GaussianScene
    objects: Mapping[str, slice]
    cameras: tuple[Camera, ...]
    render: RenderFn


class JobRunner:
    """Executes jobs: scenes are read once, the detector is one for all."""

    def __init__(self, read: Callable[[str], AttackScene], detector: Detector) -> None:
        self._read, self._detector = read, detector
        self._settings: dict[str, AttackScene] = {}
        self._marks: dict[str, str] = {}

    def fingerprint(self, job: Job) -> str:
        """Hash of the scene, the cameras and the detector's answers to a fixed picture."""
        if job.scene not in self._marks:
            setting = self._setting(job)
            with torch.no_grad():
                picture = setting.render(setting.scene, setting.cameras[0]).clamp(0, 1)
                answer = self._detector.candidates(picture[None])[0].scores
            words = (
                scene_hash(setting.scene),
                str(setting.cameras),
                self._detector.name,
                hashlib.sha256((answer * 1e3).round().to("cpu", torch.int32).numpy().tobytes()).hexdigest(),
            )
            self._marks[job.scene] = hashlib.sha256("\n".join(words).encode()).hexdigest()
        return self._marks[job.scene]

    def execute(self, job: Job) -> dict[str, Any]:
        """Attack, and return the summary."""
        setting = self._setting(job)
        rows = setting.objects[job.object]
        config = DaggerConfig(
            attributes=(job.attribute,), eps=(job.eps,), norm=job.norm, seed=job.seed, random_start=job.seed > 0
        )
        centre = setting.scene.means[rows].mean(0)
        chosen = setting.cameras[job.camera :][: job.views or None]
        cameras = [jittered(camera, centre, seed=job.seed) for camera in chosen]
        objective: Objective = hide() if job.target is None else relabel(job.target)
        found = attack(setting.scene, rows, cameras, self._detector, objective, render=setting.render, config=config)
        return summary(found)

    def _setting(self, job: Job) -> AttackScene:
        if job.scene not in self._settings:
            self._settings[job.scene] = self._read(job.scene)
        setting = self._settings[job.scene]
        if job.object not in setting.objects:
            raise InvalidValueError(
                message(
                    f"object of {job.scene}", f"one of {', '.join(setting.objects)}", job.object, "fix the scene file"
                )
            )
        return setting


def jittered(
    camera: Camera, centre: torch.Tensor, *, seed: int, degrees: float = 6.0, fraction: float = 0.05
) -> Camera:
    """The camera turned about the vertical axis through `centre` and moved along the line to it.

    Seed 0 changes nothing.

    Args:
        camera: The camera.
        centre: (3,) world units, what it looks at.
        seed: Seed of the draw.
        degrees: Largest angle.
        fraction: Largest change of the distance.
    """
    if seed == 0:
        return camera
    turn, move = (2 * torch.rand(2, generator=Generator().manual_seed(seed), dtype=torch.float64) - 1).tolist()
    angle, pivot = math.radians(degrees * turn), centre.detach().to("cpu", torch.float64)
    spin = torch.eye(3, dtype=torch.float64)
    spin[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    pose = camera.to_world.clone()
    pose[:3, :3] = spin @ pose[:3, :3]
    pose[:3, 3] = pivot + (1 + fraction * move) * (spin @ (camera.position - pivot))
    return dataclasses.replace(camera, to_world=pose)
