"""The scenes that a study attacks, and where it looks at them from."""

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Generator

from attacks.detectors.base import Detector
from attacks.detectors.registry import load_detector
from attacks.observe.conditions import SunTable, check_condition, renderer_of
from mi_splat.cameras import Camera, RenderFn
from mi_splat.comparison.methods import method_names
from mi_splat.directions import Point
from mi_splat.errors import InvalidValueError
from mi_splat.fields import check_choice
from mi_splat.io.scene_parts import SceneParts, scene_parts
from mi_splat.scene_files import SplatScene, read_scene


class AttackScene(SplatScene):
    """A scene ready for attacks."""

    def centre(self, name: str) -> Point:
        """(3,) mean of an object's Gaussians, world units."""
        x, y, z = self.scene.means[self.objects[name]].mean(0).tolist()
        return x, y, z

    def views(self, name: str, *, camera: int, count: int, seed: int) -> list[Camera]:
        """Cameras of the scene, moved about an object as `jittered` does."""
        centre = self.scene.means[self.objects[name]].mean(0)
        return [jittered(view, centre, seed=seed) for view in [*self.cameras.values()][camera:][: count or None]]

    def renderer(self, name: str) -> RenderFn:
        """A renderer by its name, as in `mi-splat compare`, with the scene's settings; "" is the scene's own."""
        return renderer_of(name, self.settings)


def attack_scene(path: Path) -> AttackScene:
    """A scene XML ready for attacks; read once as long as its files are the same."""
    return _read(path, tuple(_state(file) for file in scene_files(path).values()))


@functools.lru_cache(maxsize=4)
def _read(path: Path, state: object) -> AttackScene:
    scene = read_scene(path)
    return AttackScene(scene=scene.scene, objects=scene.objects, cameras=scene.cameras, settings=scene.settings)


def detectors_of(names: tuple[str, ...], inputs: Mapping[str, Path]) -> list[Detector]:
    """The detectors of a job, each loaded once as long as its weights are the same."""
    return [
        _detector(name, _state(inputs[f"weights {name}"]) if f"weights {name}" in inputs else None) for name in names
    ]


@functools.lru_cache(maxsize=8)
def _detector(name: str, state: object) -> Detector:
    return load_detector(name)


def _state(file: Path) -> tuple[str, int, int]:
    """What changes when a file does."""
    status = file.stat()
    return str(file), status.st_mtime_ns, status.st_size


def scene_files(path: Path) -> dict[str, Path]:
    """A scene file and all that it names, as inputs of a job; read once as long as the file is the same."""
    files = dict.fromkeys(_parts(path, _state(path) if path.is_file() else None).files)
    return {f"scene {number}" if number else "scene": file for number, file in enumerate(files)}


def street_of(condition: str, sun: SunTable | None) -> tuple[SunTable | None, dict[str, Path]]:
    """The street of a condition that is an hour, and its files as inputs of a job; none of another condition."""
    check_condition(condition, sun)
    if sun is None or ":" not in condition:
        return None, {}
    return sun, {f"street {name}": path for name, path in scene_files(Path(sun.scene)).items()}


@functools.lru_cache(maxsize=64)
def _parts(path: Path, state: object) -> SceneParts:
    return scene_parts(path)


def check_scene(path: Path, name: str, *, camera: int = 0, renderers: Sequence[str] = ()) -> None:
    """Raise unless a scene file has an object and a camera, and there are renderers; nothing is loaded."""
    elements = _parts(path, _state(path) if path.is_file() else None).elements
    objects = [str(part.get("id")) for part in elements if part.tag == "shape" and part.get("type") == "gaussians"]
    check_choice(f"object of {path}", name, objects)
    cameras = sum(part.tag == "sensor" for part in elements)
    if camera >= cameras:
        raise InvalidValueError.of(f"camera of {path}", f"0 to {cameras - 1}", camera, "choose another")
    for renderer in filter(None, renderers):
        check_choice("renderer", renderer, method_names())


def jittered(camera: Camera, centre: torch.Tensor, *, seed: int) -> Camera:
    """The camera turned about the vertical axis through `centre` and moved along the line to it.

    It turns by at most 6 degrees, and its distance changes by at most 5 %. Seed 0 changes nothing.
    """
    if seed == 0:
        return camera
    turn, move = (2 * torch.rand(2, generator=Generator().manual_seed(seed), dtype=torch.float64) - 1).tolist()
    angle, pivot = math.radians(6 * turn), centre.detach().to("cpu", torch.float64)
    spin = torch.eye(3, dtype=torch.float64)
    spin[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    pose = camera.to_world.clone()
    pose[:3, :3] = spin @ pose[:3, :3]
    pose[:3, 3] = pivot + (1 + 0.05 * move) * (spin @ (camera.position - pivot))
    return dataclasses.replace(camera, to_world=pose)
