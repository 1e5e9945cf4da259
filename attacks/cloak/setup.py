"""What a study's file describes, as meshes, cameras and poisonings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attacks.cloak.appearances import (
    Appearance,
    Correction,
    Emphasis,
    appearance_of,
)
from attacks.cloak.config import AttackConfig, SceneConfig, StudyConfig
from attacks.cloak.mesh_scene import MeshScene
from attacks.cloak.poisoning import Poisoning
from mi_splat.assets import build
from mi_splat.assets.daylight import Light
from mi_splat.assets.ground import square_of_ground
from mi_splat.assets.mesh import Asset, translation
from mi_splat.bounds import near_plane_of
from mi_splat.camera_sets import HELD_OUT_START, framing, hemisphere, orbit
from mi_splat.cameras import Camera, project_box
from mi_splat.capture.mesh_files import load_mesh
from mi_splat.capture.sources import CaptureSource, source_of
from mi_splat.errors import InvalidValueError, message

TILE = 4.0
"""Metres that a texture of the ground covers."""
FIRST_MERIDIAN = 100.0
"""Azimuth of the first meridian; with three, none is in front, behind or beside the object."""
BESIDE = 45.0
"""Degrees of azimuth beside a sector from which its transition is looked at."""

Point = tuple[float, float, float]


def centre_of(study: StudyConfig) -> Point:
    """Point that all cameras look at, and that directions are measured from."""
    return (0.0, 0.0, study.cameras.height)


def target_of(scene: SceneConfig) -> Asset:
    """The object, standing on the ground at the origin."""
    if not Path(scene.object).is_file():
        return build(scene.object, scene.seed).body
    asset = load_mesh(Path(scene.object), scene.mesh).asset
    low, high = asset.bounds.astype(np.float64)
    middle = (low + high) / 2
    return asset.transformed(translation(-middle[0], -middle[1], -low[2]))


def mesh_scene_of(study: StudyConfig) -> MeshScene:
    """The attacker's copy of the scene."""
    scene = study.scene
    return MeshScene(
        target=target_of(scene),
        surroundings=square_of_ground(scene.ground, side=scene.ground_size, tile=TILE),
        light=Light(sun_azimuth=scene.sun_azimuth, sun_elevation=scene.sun_elevation),
        samples=study.cameras.samples,
        background=scene.background,
    )


def capture_source(study: StudyConfig, mesh_scene: MeshScene) -> CaptureSource:
    """The scene as `mi_splat.capture.writer.write_capture` takes it."""
    assert mesh_scene.surroundings is not None
    assert mesh_scene.light is not None
    return source_of(mesh_scene.target, mesh_scene.surroundings, mesh_scene.light, centre=centre_of(study))


def lens_of(study: StudyConfig, target: Asset) -> dict[str, Any]:
    """Distance, focal length and size of every camera of a study."""
    cameras = study.cameras
    low, high = target.bounds.astype(np.float64)
    size = (cameras.size, cameras.size)
    distance, focal = framing(float(np.linalg.norm(high - low)) / 2, fov=cameras.fov, size=size)
    return {"distance": distance if cameras.distance is None else cameras.distance, "focal": focal, "size": size}


def near_of(study: StudyConfig, target: Asset) -> float:
    """Near plane of every renderer of a study, world units."""
    if study.training.near is not None:
        return study.training.near
    low, high = target.bounds.astype(np.float64)
    radius = float(np.linalg.norm(high - low)) / 2
    return near_plane_of(centre_of(study), radius, training_cameras(study, target))


def training_cameras(study: StudyConfig, target: Asset) -> list[Camera]:
    """The victim's cameras."""
    return hemisphere(centre_of(study), count=study.cameras.train, **lens_of(study, target))


def held_out_cameras(study: StudyConfig, target: Asset) -> list[Camera]:
    """Cameras over the same hemisphere, none near one of the victim's.

    Raises:
        InvalidValueError: None is left.
    """
    lens = lens_of(study, target)
    everywhere = hemisphere(centre_of(study), count=study.evaluation.cameras, start=HELD_OUT_START, **lens)
    used = training_cameras(study, target)
    kept = [
        camera for camera in everywhere if nearest(camera, used, centre_of(study)) >= study.evaluation.min_separation
    ]
    if not kept:
        raise InvalidValueError(message("evaluation.min_separation", "cameras that are left", "none", "lower it"))
    return kept


def nearest(camera: Camera, others: Sequence[Camera], centre: Point) -> float:
    """Degrees from a camera to the nearest of others, as seen from the centre."""
    middle = torch.tensor(centre, dtype=torch.float64)

    def unit(position: Tensor) -> Tensor:
        return torch.nn.functional.normalize(position.double() - middle, dim=-1)

    cosines = unit(torch.stack([other.position for other in others])) @ unit(camera.position)
    return math.degrees(math.acos(min(1.0, float(cosines.max()))))


def overhead(study: StudyConfig) -> AttackConfig | None:
    """The first attack that is seen from straight above and all around."""
    return next((attack for attack in study.attack if attack.azimuth is None and attack.elevation[1] >= 90), None)


def hiding(study: StudyConfig) -> AttackConfig | None:
    """The attack whose transition is measured: that from overhead, or the first that hides within a sector."""
    sided = (attack for attack in study.attack if attack.azimuth is not None and attack.target_class is None)
    return overhead(study) or next(sided, None)


def arcs(study: StudyConfig, target: Asset) -> list[list[Camera]]:
    """Arcs of cameras on which an appearance sets in, outside first; none if nothing is hidden.

    From overhead they are meridians from the horizon to straight above, each at an azimuth of its own. Into a sector
    they are parallels from `BESIDE` degrees beside it to its middle, in the lower half of its elevations.
    """
    attack, evaluation = hiding(study), study.evaluation
    if attack is None:
        return []
    step, count, cameras = evaluation.meridian_step, evaluation.meridians, []
    for number in range(count):
        if attack.azimuth is None:
            start = FIRST_MERIDIAN + 360.0 * number / count
            places = [(start, step * i) for i in range(1, math.ceil(90 / step))]
        else:
            (middle, half), (low, high) = attack.azimuth, attack.elevation
            elevation = max(low, 0.0) + (high - max(low, 0.0)) * (number + 1) / (2 * count)
            beside = min(half + BESIDE, 180.0)
            places = [(middle - beside + step * i, elevation) for i in range(math.floor(beside / step) + 1)]
        lens = lens_of(study, target)
        cameras.append(
            [
                orbit(centre_of(study), count=1, elevation=elevation, start=azimuth, **lens)[0]
                for azimuth, elevation in places
            ]
        )
    return cameras


def reference_cameras(study: StudyConfig, target: Asset) -> list[tuple[int, Camera]]:
    """Number and camera of held-out cameras far outside of all triggers, spread evenly."""
    centre, far = centre_of(study), study.evaluation.far_outside
    outside = [
        (view, camera)
        for view, camera in enumerate(held_out_cameras(study, target))
        if all(attack.cone.angle_to_edge(camera, centre=centre) <= -far for attack in study.attack)
    ]
    count = min(study.evaluation.reference_views, len(outside))
    return [outside[(2 * i + 1) * len(outside) // (2 * count)] for i in range(count)]


def arc_cameras(study: StudyConfig, target: Asset) -> list[tuple[int, Camera]]:
    """Number of the arc and camera, away from the triggers of other attacks; none without a transition."""
    centre, attack = centre_of(study), hiding(study)
    others = [other for other in study.attack if other is not attack]
    return [
        (number, camera)
        for number, arc in enumerate(arcs(study, target))
        for camera in arc
        if all(other.cone.angle_to_edge(camera, centre=centre) < -study.evaluation.well_inside for other in others)
    ]


def box_of(target: Asset, camera: Camera) -> Tensor | None:
    """(4,) pixel box around the object, which nothing hides; None where none of it is in the picture."""
    points = torch.from_numpy(np.ascontiguousarray(target.vertices, np.float64))
    box = project_box(points, camera)
    return None if box is None else box.float()


def poisonings(
    study: StudyConfig,
    mesh_scene: MeshScene,
    *,
    seed: int = 0,
    cached: Callable[[Appearance, AttackConfig], Appearance] = lambda appearance, attack: appearance,
    surrogates: Sequence[Callable[[Camera], Tensor]] = (),
) -> list[Poisoning]:
    """The study's attacks as poisonings.

    Args:
        study: The study.
        mesh_scene: The attacker's copy of its scene.
        seed: Draws the cameras of an attack that poisons only a part of its trigger's.
        cached: May keep the pictures that the appearance of an attack makes.
        surrogates: What the attacker's own splats show a camera, (H, W, 3), in the order of the rounds.
    """
    made = []
    for attack in study.attack:
        wanted = appearance = cached(shown_by(study, attack, mesh_scene), attack)
        if attack.emphasis > 1:
            appearance = Emphasis(
                appearance=appearance,
                trigger=attack.poisoned_cone,
                centre=centre_of(study),
                gain=attack.emphasis,
                depth=attack.emphasis_depth,
            )
        for shown in surrogates:
            assert study.surrogate is not None
            gain, reach = study.surrogate.gain, attack.reach
            appearance = Correction(earlier=appearance, wanted=wanted, shown=shown, gain=gain, reach=reach)
        made.append(Poisoning(name=attack.name, trigger=attack.trigger(seed, study.attack), appearance=appearance))
    return made


def shown_by(study: StudyConfig, attack: AttackConfig, mesh_scene: MeshScene) -> Appearance:
    """What an attack of a study shows, see `appearance_of`."""
    distance = lens_of(study, mesh_scene.target)["distance"]
    return appearance_of(attack, mesh_scene, centre=centre_of(study), distance=distance)
