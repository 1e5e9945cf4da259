"""A study of CLOAK as an exhibit: both splats, the study's cameras, and the regions of its triggers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from attacks.cloak import setup
from attacks.cloak.config import AttackConfig, StudyConfig
from mi_splat.cameras import Camera
from mi_splat.directions import Point
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import decode
from mi_splat.rendering import RenderSettings
from mi_splat.scene_files import open_scene
from mi_splat.viewer.exhibit import Exhibit, ShownSplat
from mi_splat.viewer.lines import Lines, arc, frustums
from mi_splat.viewer.orbit import Orbit

REGION_RADIUS = 0.5
"""Radius of the sphere that regions of directions are drawn on, in distances of the cameras."""
_COLOURS = ("#ffa500", "#00d0ff", "#ff60d0", "#a0ff40")


def exhibit_of_study(folder: Path, summary: Mapping[str, Any]) -> Exhibit:
    """The clean and the cloaked splat of a study.

    Args:
        folder: Of its results.
        summary: Its summary.json.

    Raises:
        MiSplatError: The summary is not one of this version, or a splat is missing or broken.
    """
    if not isinstance(summary.get("study"), dict):
        expected, do = "a summary of a study of CLOAK", "make it again with mi-splat cloak"
        raise InvalidValueError(message(f"{folder}", expected, "one without its study", do))
    study = decode(StudyConfig, _stated(summary["study"]), f"the study of {folder}")
    background = RenderSettings(background=study.scene.background)
    splats = tuple(
        ShownSplat(name=name, scene=loaded.scene, path=folder / f"{name}.ply", own=loaded.settings)
        for name in ("clean", "cloaked")
        for loaded in [open_scene(folder / f"{name}.ply")]
    )
    centre, cameras = setup.centre_of(study), setup.training_cameras(study, setup.target_of(study.scene))
    distance = math.dist(cameras[0].position.tolist(), centre)
    start = Orbit(target=centre, azimuth=30.0, elevation=15.0, distance=distance, fov=study.cameras.fov)
    return Exhibit(
        title=f"{study.name} ({folder})",
        splats=splats,
        settings=background,
        start=start,
        size=(study.cameras.size, study.cameras.size),
        cameras={"start": start, **{f"inside {attack.name}": _inside(attack, start) for attack in study.attack}},
        lines={
            **{
                f"Trigger {attack.name}": Lines(
                    segments=region(attack, centre, REGION_RADIUS * distance), colour=_COLOURS[i % len(_COLOURS)]
                )
                for i, attack in enumerate(study.attack)
            },
            **_cameras(study, cameras, 0.04 * distance),
        },
        place=lambda camera: tuple(_said(attack, camera, centre) for attack in study.attack),
    )


def region(attack: AttackConfig, centre: Point, radius: float) -> torch.Tensor:
    """(S, 2, 3) edges of the directions from which an attack is to be seen, on a sphere.

    Args:
        attack: Whose.
        centre: (3,) of the sphere, world units.
        radius: Of the sphere, world units.
    """
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


def _cameras(study: StudyConfig, cameras: list[Camera], length: float) -> dict[str, Lines]:
    """The training cameras, those whose pictures were poisoned apart."""
    centre, seed = setup.centre_of(study), study.seeds[0]
    poisoned = torch.stack(
        [setup.poisoned_cameras(study, attack, seed).holds(cameras, centre=centre) for attack in study.attack]
    ).any(0)
    groups = {"Poisoned cameras": ("#ff4040", poisoned), "Other training cameras": ("#f0f0f0", ~poisoned)}
    return {
        name: Lines(
            segments=frustums([camera for camera, one in zip(cameras, chosen.tolist(), strict=True) if one], length),
            colour=colour,
        )
        for name, (colour, chosen) in groups.items()
    }


def _said(attack: AttackConfig, camera: Camera, centre: Point) -> str:
    """Where a camera stands to a trigger, in words."""
    if math.dist(camera.position.tolist(), centre) == 0:
        return f"Trigger {attack.name}: the camera stands at the centre"
    degrees = attack.cone.angle_to_edge(camera, centre=centre)
    return f"Trigger {attack.name}: {abs(degrees):.1f}° {'inside' if degrees >= 0 else 'outside'}"


def _stated(value: Any) -> Any:
    """A JSON value without the keys whose value is null, which stand for what is not stated in a study's file."""
    if isinstance(value, dict):
        return {key: _stated(entry) for key, entry in value.items() if entry is not None}
    return [_stated(entry) for entry in value] if isinstance(value, list) else value
