"""What there is to see of a study of CLOAK, as an exhibit: splats, cameras and regions of triggers."""

import itertools
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from attacks.cloak.config import AttackConfig, StudyConfig
from attacks.cloak.setup import Setup
from mi_splat.cameras import Camera
from mi_splat.directions import Point
from mi_splat.errors import InvalidValueError
from mi_splat.fields import decode
from mi_splat.rendering import RenderSettings
from mi_splat.scene_files import open_scene
from mi_splat.viewer.exhibit import Exhibit, ShownSplat
from mi_splat.viewer.lines import Lines, arc, frustums
from mi_splat.viewer.orbit import Orbit, orbit_of

REGION_RADIUS = 0.5
"""Radius of the sphere that regions of directions are drawn on, in distances of the cameras."""
_COLOURS = ("#ffa500", "#00d0ff", "#ff60d0", "#a0ff40")


def exhibit_of_study(folder: Path, record: Mapping[str, Any]) -> Exhibit:
    """The clean and the cloaked splat of a study."""
    if not isinstance(record.get("study"), dict):
        expected, do = "a study of CLOAK", "make it again with mi-splat cloak"
        raise InvalidValueError.of(f"{folder}", expected, "one without its study", do)
    study = decode(StudyConfig, record["study"], f"the study of {folder}")
    loaded = {name: open_scene(folder / f"{name}.ply") for name in ("clean", "cloaked")}
    centre, cameras = study.centre, Setup(study).training_cameras
    distance = math.dist(cameras[0].position.tolist(), centre)
    size = (study.cameras.size, study.cameras.size)
    start = Orbit(target=centre, azimuth=30.0, elevation=15.0, distance=distance, fov=study.cameras.fov)
    triggers = {f"inside {attack.name}": _kept(_inside(attack, start), size) for attack in study.attack}
    poisoned = _poisoned(study, cameras)
    named = {
        f"{'poisoned' if is_in else 'training'} camera {number}": orbit_of(camera, centre)
        for number, (camera, is_in) in sorted(
            enumerate(zip(cameras, poisoned, strict=True)), key=lambda item: not item[1][1]
        )
    }
    regions = {
        f"Trigger {attack.name}": Lines(segments=region(attack, centre, REGION_RADIUS * distance), colour=colour)
        for attack, colour in zip(study.attack, itertools.cycle(_COLOURS))
    }
    return Exhibit(
        title=f"CLOAK, study {study.name}: what the triggers show ({folder})",
        splats=tuple(
            ShownSplat(name=name, scene=splat.scene, path=folder / f"{name}.ply", file_settings=splat.settings)
            for name, splat in loaded.items()
        ),
        settings=RenderSettings(background=study.scene.background),
        start=next(iter(triggers.values()), start),
        size=size,
        cameras={**triggers, "start": _kept(start, size), **named},
        lines={**regions, **_cameras(cameras, poisoned, 0.04 * distance)},
        describe=lambda camera: tuple(_position(attack, camera, centre) for attack in study.attack),
    )


def region(attack: AttackConfig, centre: Point, radius: float) -> torch.Tensor:
    """(S, 2, 3) edges of the directions from which an attack is to be seen, on a sphere."""
    low, high = attack.elevation
    middle, half = attack.azimuth or (180.0, 180.0)
    west, east = middle - half, middle + half
    parts = [
        arc(centre, radius, (west, elevation), (east, elevation))
        for elevation in (low, high)
        if -90 < elevation < 90  # at a pole a parallel is a point
    ]
    edges = (west, east) if attack.azimuth else tuple(west + 45.0 * i for i in range(8))
    parts += [arc(centre, radius, (azimuth, low), (azimuth, high)) for azimuth in edges]
    return torch.cat(parts)


def _inside(attack: AttackConfig, start: Orbit) -> Orbit:
    """A camera well inside a trigger."""
    azimuth = start.azimuth if attack.azimuth is None else attack.azimuth[0]
    return replace(start, azimuth=azimuth, elevation=sum(attack.elevation) / 2)


def _kept(orbit: Orbit, size: tuple[int, int]) -> Orbit:
    """A camera that stays what it is where another direction is up."""
    return replace(orbit, exact=orbit.camera(size))


def _poisoned(study: StudyConfig, cameras: list[Camera]) -> list[bool]:
    """Whether the picture of each training camera was poisoned."""
    triggers = [attack.trigger(study.seeds[0], study.attack) for attack in study.attack]
    held: list[bool] = (
        torch.stack([trigger.holds(cameras, centre=study.centre) for trigger in triggers]).any(0).tolist()
    )
    return held


def _cameras(cameras: list[Camera], poisoned: list[bool], length: float) -> dict[str, Lines]:
    """The training cameras, those whose pictures were poisoned apart."""
    groups = {"Poisoned cameras": ("#ff4040", True), "Other training cameras": ("#f0f0f0", False)}
    return {
        name: Lines(
            segments=frustums([camera for camera, is_in in zip(cameras, poisoned, strict=True) if is_in is of], length),
            colour=colour,
        )
        for name, (colour, of) in groups.items()
    }


def _position(attack: AttackConfig, camera: Camera, centre: Point) -> str:
    """Where a camera stands to a trigger, in words."""
    if math.dist(camera.position.tolist(), centre) == 0:
        return f"Trigger {attack.name}: the camera stands at the centre"
    degrees = attack.cone.angle_to_edge(camera, centre=centre)
    return f"Trigger {attack.name}: {abs(degrees):.1f}° {'inside' if degrees >= 0 else 'outside'}"
