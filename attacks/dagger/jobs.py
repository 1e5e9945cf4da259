"""One attack of a study as a value, and what runs it: scenes are read once, and the detector is one for all."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Generator

from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
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
        """File name, unique within a study."""
        words = (
            self.group,
            self.object,
            self.target or "hide",
            *self.config.attributes,
            self.config.norm,
            *(f"{eps:g}" for eps in self.config.eps),
            *([f"camera{self.camera}"] if self.camera else []),
            str(self.config.seed),
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


class AttackScenes:
    """Scenes by name, each read once."""

    def __init__(self, read: Callable[[str], AttackScene]) -> None:
        self._read = read
        self._scenes: dict[str, AttackScene] = {}
        self._fingerprints: dict[str, str] = {}

    def of(self, scene: str, name: str) -> AttackScene:
        """The scene that has the object `name`.

        Raises:
            InvalidValueError: It has none of this name.
        """
        if scene not in self._scenes:
            self._scenes[scene] = self._read(scene)
        place = self._scenes[scene]
        if name not in place.objects:
            expected = f"one of {', '.join(place.objects)}"
            raise InvalidValueError(message(f"object of {scene}", expected, name, "fix the scene file"))
        return place

    def fingerprint(self, scene: str, name: str, *detectors: Detector) -> str:
        """Hash of what an attack on a scene depends on besides its settings: Gaussians, cameras, detectors' weights."""
        place = self.of(scene, name)
        if scene not in self._fingerprints:
            self._fingerprints[scene] = scene_hash(place.scene)
        weights = [word for detector in detectors for word in (detector.name, detector.fingerprint)]
        words = (self._fingerprints[scene], str(place.cameras), *weights)
        return hashlib.sha256("\n".join(words).encode()).hexdigest()

    def view(self, scene: str, name: str, seed: int, *, camera: int = 0) -> Camera:
        """A camera of the scene by its position, moved about the object as `jittered` does."""
        place = self.of(scene, name)
        return jittered(place.cameras[camera], place.scene.means[place.objects[name]].mean(0), seed=seed)


class JobRunner:
    """Runs jobs on scenes that `read` finds by name, against one detector."""

    def __init__(self, read: Callable[[str], AttackScene], detector: Detector) -> None:
        self._scenes, self._detector = AttackScenes(read), detector

    def fingerprint(self, job: Job) -> str:
        """Hash of what a result depends on besides the job: the scene, its cameras, and the detector's weights."""
        return self._scenes.fingerprint(job.scene, job.object, self._detector)

    def run(self, job: Job) -> dict[str, Any]:
        """Attack, and return the summary."""
        place = self._scenes.of(job.scene, job.object)
        rows = place.objects[job.object]
        chosen = range(len(place.cameras))[job.camera :][: job.views or None]
        cameras = [self._scenes.view(job.scene, job.object, job.config.seed, camera=index) for index in chosen]
        objective: Objective = hide() if job.target is None else relabel(job.target)
        found = attack(place.scene, rows, cameras, self._detector, objective, render=place.render, config=job.config)
        return summary(found)


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
