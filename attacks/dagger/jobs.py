"""One attack of a study as a value, and what runs it: scenes are read once, and the detector is one for all."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import torch
from torch import Generator

from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.report import summary
from attacks.dagger.result import Result
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
        config: How to attack. Its seed also moves the cameras, see `jittered`.
        camera: Position of the first camera that is attacked, in the order of the scene file.
        views: Number of the scene's cameras that are attacked together, from that one on; 0 is all of them.
    """

    group: str
    scene: str
    object: str
    target: str | None
    config: DaggerConfig = field(default_factory=DaggerConfig)
    camera: int = 0
    views: int = 1

    @property
    def name(self) -> str:
        """File name, unique within a study: what is said of the attack, and a hash of all of it."""
        words = (
            self.group,
            self.object,
            self.target or "hide",
            *self.config.attributes,
            self.config.norm,
            *(f"{eps:g}" for eps in self.config.eps),
            *([f"camera{self.camera}"] if self.camera else []),
            str(self.config.seed),
            hashlib.sha256(repr(self).encode()).hexdigest()[:8],
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

    def digest(self) -> str:
        """SHA-256 of all that an attack sees: Gaussians, rows, cameras to the last bit, settings of the renderer."""
        words = [scene_hash(self.scene), repr(sorted((name, str(rows)) for name, rows in self.objects.items()))]
        for one in self.cameras:
            words.append(repr((one.to_world.tolist(), one.focal, one.principal, one.width, one.height)))
        words.append(repr(getattr(self.render, "settings", None)))
        return hashlib.sha256("\n".join(words).encode()).hexdigest()


class JobRunner:
    """Runs jobs on scenes that `read` finds by name, against one detector.

    Settings of the objective are its own unless some are given, by the names of its fields.
    """

    def __init__(
        self,
        read: Callable[[str], AttackScene],
        detector: Detector,
        *,
        objective: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self._read, self._detector = read, detector
        self._settings = dict(objective)
        self._scenes: dict[str, AttackScene] = {}
        self._fingerprints: dict[str, str] = {}

    def fingerprint(self, job: Job) -> str:
        """Hash of what a result depends on besides the job: the scene, see `AttackScene.digest`, and the detector."""
        if job.scene not in self._fingerprints:
            words = [self._scene(job).digest(), self._detector.name, self._detector.fingerprint]
            words += [f"{name} {value:g}" for name, value in self._settings.items()]
            self._fingerprints[job.scene] = hashlib.sha256("\n".join(words).encode()).hexdigest()
        return self._fingerprints[job.scene]

    def run(self, job: Job) -> dict[str, Any]:
        """Attack, and return the summary."""
        return summary(self.attack(job))

    def attack(self, job: Job) -> Result:
        """Attack."""
        place = self._scene(job)
        rows = place.objects[job.object]
        centre = place.scene.means[rows].mean(0)
        chosen = place.cameras[job.camera :][: job.views or None]
        cameras = [jittered(camera, centre, seed=job.config.seed) for camera in chosen]
        usual = hide() if job.target is None else relabel(job.target)
        objective: Objective = dataclasses.replace(usual, **self._settings)
        return attack(place.scene, rows, cameras, self._detector, objective, render=place.render, config=job.config)

    def _scene(self, job: Job) -> AttackScene:
        if job.scene not in self._scenes:
            self._scenes[job.scene] = self._read(job.scene)
        place = self._scenes[job.scene]
        if job.object not in place.objects:
            expected = f"one of {', '.join(place.objects)}"
            raise InvalidValueError(message(f"object of {job.scene}", expected, job.object, "fix the scene file"))
        return place


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
        fraction: Largest change of the distance, as a fraction of it.
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
