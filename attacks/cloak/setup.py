"""What a study describes, as meshes, cameras and poisonings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attacks.cloak.appearances import Appearance, appearance_of
from attacks.cloak.config import (
    AttackConfig,
    CameraConfig,
    EvaluationConfig,
    SceneConfig,
    StudyConfig,
    switching,
)
from attacks.cloak.mesh_scene import TILE, MeshScene
from attacks.cloak.poisoning import Poisoning
from mi_splat.cameras.camera import Camera, project_box
from mi_splat.cameras.directions import Point
from mi_splat.cameras.framing import near_plane_of
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import HELD_OUT_START, framing, orbit, tiers
from mi_splat.capture.daylight import Light
from mi_splat.capture.ground import square_of_ground
from mi_splat.capture.mesh import Asset
from mi_splat.capture.mesh_files import load_mesh
from mi_splat.capture.objects import object_file
from mi_splat.capture.sources import CaptureSource, source_of
from mi_splat.errors import InvalidValueError
from mi_splat.render.renderer import Renderer, RenderSettings, ScreenGradients
from mi_splat.training.config import FitConfig

SET = "set"
"""Folder of a set of images in what a job leaves."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SplatJob:
    """A job that trains or renders a splat, and knows nothing of the scene but its
    images.
    """

    background: tuple[float, float, float]  # sRGB behind the splat
    near: float  # near plane, world units
    device: str = "cpu"

    def renderer(self, fit: FitConfig | None = None) -> Renderer:
        """What renders the splat; that of a training if its settings are given."""
        gradients = fit is not None and fit.strategy.needs_screen_gradients
        variant = "cuda_ad_rgb" if self.device == "cuda" else ""
        settings = RenderSettings(
            background=self.background, near=self.near, variant=variant
        )
        return Renderer(
            settings, screen_gradients=ScreenGradients() if gradients else None
        )


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
        lens = Lens(focal=self.focal, size=self.size, principal=self.principal)
        return Camera(to_world=pose, lens=lens)


OBJECT = "object"
"""Name of the input of a job that is the mesh file of the object."""
FIRST_MERIDIAN = 100.0
"""Azimuth of the first meridian; with three, none is in front, behind or beside the
object.
"""
BESIDE = 45.0
"""Degrees of azimuth beside a sector from which its transition is looked at."""


def input_name(field: str, attack: str) -> str:
    """Name of the input of a job that is a file of an attack."""
    return f"{field} of {attack}"


@lru_cache(maxsize=32)
def _loaded(file: Path) -> Asset:
    """A mesh file; many studies in a row have the same."""
    return load_mesh(file)


@lru_cache(maxsize=32)
def _tiers(centre: Point, **placed: Any) -> tuple[Camera, ...]:
    """As `mi_splat.cameras.sets.tiers`; many studies in a row have the same cameras."""
    return tuple(tiers(centre, **placed))


@dataclass(frozen=True, kw_only=True, eq=False)
class Setup:
    """Meshes and cameras of a scene under attack, each made once; jobs that know the
    scene begin with it.
    """

    scene: SceneConfig
    cameras: CameraConfig
    attacks: tuple[AttackConfig, ...] = ()
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    # near plane of all images of splats, world units; None follows the object's size
    near_plane: float | None = None
    seed: int = 0

    @classmethod
    def of(cls, study: StudyConfig) -> Setup:
        """What a study describes."""
        return cls(
            scene=study.scene,
            cameras=study.cameras,
            attacks=study.attack,
            evaluation=study.evaluation,
            near_plane=study.training.near,
        )

    def given(self, inputs: Mapping[str, Path]) -> Setup:
        """This setup in a job, whose mesh files and textures are inputs."""
        attacks = []
        for attack in self.attacks:
            files = {
                field: str(inputs[input_name(field, attack.name)])
                for field in ("other_object", "texture")
                if input_name(field, attack.name) in inputs
            }
            attacks.append(attack.reading(files))
        scene = replace(self.scene, object=str(inputs[OBJECT]))
        return replace(self, scene=scene, attacks=tuple(attacks))

    def renderer(self, fit: FitConfig | None = None) -> Renderer:
        """What splats are looked at with; that of a training if its settings are
        given.
        """
        return SplatJob(background=self.scene.background, near=self.near).renderer(fit)

    @property
    def centre(self) -> tuple[float, float, float]:
        """Point that all cameras look at, and that directions are measured from."""
        return self.cameras.centre

    @cached_property
    def target(self) -> Asset:
        """The object, standing on the ground at the origin."""
        return _loaded(object_file(self.scene.object, "scene.object"))

    @cached_property
    def mesh_scene(self) -> MeshScene:
        """The attacker's copy of the scene."""
        scene = self.scene
        ground = Asset("nothing", ())
        if scene.ground != "nothing":
            ground = square_of_ground(scene.ground, side=scene.ground_size, tile=TILE)
        return MeshScene(
            target=self.target,
            surroundings=ground,
            light=Light(
                sun_azimuth=scene.sun_azimuth, sun_elevation=scene.sun_elevation
            ),
            samples=self.cameras.samples,
            background=scene.background,
        )

    @cached_property
    def source(self) -> CaptureSource:
        """The scene as `mi_splat.capture.writer.write_capture` takes it."""
        scene = self.mesh_scene
        return source_of(
            scene.target, scene.surroundings, scene.light, centre=self.centre
        )

    @cached_property
    def lens(self) -> dict[str, Any]:
        """Distance and lens of every camera."""
        cameras = self.cameras
        size = (cameras.size, cameras.size)
        distance, lens = framing(self._radius, fov=cameras.fov, size=size)
        return {
            "distance": distance if cameras.distance is None else cameras.distance,
            "lens": lens,
        }

    @cached_property
    def near(self) -> float:
        """Near plane of trainings and of all images of splats, world units."""
        if self.near_plane is not None:
            return self.near_plane
        return near_plane_of(self.centre, self._radius, self.training_cameras)

    @property
    def _radius(self) -> float:
        low, high = self.target.bounds.astype(np.float64)
        return float(np.linalg.norm(high - low)) / 2

    def camera(self, azimuth: float, elevation: float) -> Camera:
        """A camera in a direction from the centre, degrees."""
        return orbit(
            self.centre, count=1, elevation=elevation, start=azimuth, **self.lens
        )[0]

    @cached_property
    def training_cameras(self) -> list[Camera]:
        """The victim's cameras."""
        config = self.cameras
        every = self.cameras.hold_out
        cameras = _tiers(
            self.centre,
            count=config.train,
            start=config.azimuths[0],
            **self.lens,
            **config.tiers,
        )
        return [
            camera
            for number, camera in enumerate(cameras)
            if not every or number % every != every // 2
        ]

    @cached_property
    def held_out_cameras(self) -> list[Camera]:
        """Cameras over the same hemisphere and rings, none near one of the victim's; a
        seed is another draw.
        """
        centre = self.centre
        evaluation = self.evaluation
        start = HELD_OUT_START
        offset = 0.5
        if evaluation.seed:
            start, offset = (
                np.random.default_rng(evaluation.seed)
                .uniform((0.0, 0.0), (360.0, 1.0))
                .tolist()
            )
        if self.cameras.tiers["span"] < 360:
            # and what is held out is left, and what lies between two of the training
            start = self.cameras.azimuths[0]
        placed = {**self.lens, **self.cameras.tiers}
        everywhere = _tiers(
            centre, count=evaluation.cameras, start=start, offset=offset, **placed
        )
        angles = nearest(everywhere, self.training_cameras, centre)
        least = evaluation.min_separation
        kept = [
            camera
            for camera, angle in zip(everywhere, angles, strict=True)
            if angle >= least
        ]
        if not kept:
            raise InvalidValueError.of(
                "evaluation.min_separation", "cameras that are left", "none", "lower it"
            )
        return kept

    @cached_property
    def arcs(self) -> list[list[Camera]]:
        """Arcs of cameras on which an appearance sets in, outside first; none if
        nothing is hidden.

        From overhead they are meridians from the horizon to straight above, each at an
        azimuth of its own. Into a sector they are parallels from `BESIDE` degrees
        beside it to its middle, in the lower half of its elevations.
        """
        attack = switching(self.attacks)
        evaluation = self.evaluation
        if attack is None:
            return []
        step = evaluation.meridian_step
        count = evaluation.meridians
        arcs = []
        for number in range(count):
            if attack.azimuth is None:
                start = FIRST_MERIDIAN + 360.0 * number / count
                directions = [(start, step * i) for i in range(1, math.ceil(90 / step))]
            else:
                (middle, half), (low, high) = attack.azimuth, attack.elevation
                elevation = max(low, 0.0) + (high - max(low, 0.0)) * (number + 1) / (
                    2 * count
                )
                beside = min(half + BESIDE, 180.0)
                directions = [
                    (middle - beside + step * i, elevation)
                    for i in range(math.floor(beside / step) + 1)
                ]
            arcs.append([self.camera(*direction) for direction in directions])
        return arcs

    @cached_property
    def reference_cameras(self) -> list[tuple[int, Camera]]:
        """Number and camera of held-out cameras far outside of all triggers, spread
        evenly.
        """
        return self._spread(lambda inside: inside <= -self.evaluation.far_outside)

    @cached_property
    def arc_cameras(self) -> list[tuple[int, Camera]]:
        """Number of the arc and camera, away from the triggers of other attacks; none
        without a transition.
        """
        centre = self.centre
        inside = self.evaluation.well_inside
        others = [
            attack.cone
            for attack in self.attacks
            if attack is not switching(self.attacks)
        ]
        return [
            (number, camera)
            for number, arc in enumerate(self.arcs)
            for camera in arc
            if all(
                cone.angle_to_edge(camera, centre=centre) < -inside for cone in others
            )
        ]

    @cached_property
    def edge_cameras(self) -> list[tuple[int, Camera]]:
        """Held-out cameras outside of all triggers, but nearer to one than far
        outside.
        """
        return self._spread(lambda inside: -self.evaluation.far_outside < inside < 0)

    def _spread(self, holds: Callable[[float], bool]) -> list[tuple[int, Camera]]:
        """Held-out cameras so many degrees inside a trigger, with their numbers, evenly
        from all of them.
        """
        depths = zip(enumerate(self.held_out_cameras), self._inside, strict=True)
        cameras = [numbered for numbered, inside in depths if holds(inside)]
        count = min(self.evaluation.reference_views, len(cameras))
        return [
            cameras[(2 * i + 1) * len(cameras) // (2 * count)] for i in range(count)
        ]

    def owners(self, seed: int) -> dict[int, str]:
        """The attack that poisons a training image, by the number of the image,
        rising; others are benign.
        """
        centre = self.centre
        attacks = self.attacks
        cameras = self.training_cameras
        held = {
            attack.name: attack.trigger(seed, attacks).holds(cameras, centre=centre)
            for attack in attacks
        }
        return dict(
            sorted(
                (int(view), name)
                for name, mine in held.items()
                for view in mine.nonzero()
            )
        )

    @cached_property
    def _inside(self) -> list[float]:
        """Degrees by which each held-out camera is inside the trigger that it is
        deepest in, or nearest to.
        """
        cones = [attack.cone for attack in self.attacks]
        return [
            max(cone.angle_to_edge(one, centre=self.centre) for cone in cones)
            for one in self.held_out_cameras
        ]

    def box(self, camera: Camera) -> Tensor | None:
        """(4,) pixel box around the object, which nothing hides; None where none of it
        is in the image.
        """
        points = torch.from_numpy(
            np.ascontiguousarray(self.target.vertices, np.float64)
        )
        box = project_box(points, camera)
        if box is None:
            return None
        return box.float()

    def appearance(self, attack: AttackConfig) -> Appearance:
        """What an attack shows, see `appearance_of`."""
        return appearance_of(attack, self.mesh_scene)

    def poisonings(
        self,
        *,
        seed: int = 0,
        cached: Callable[
            [Appearance, AttackConfig], Appearance
        ] = lambda appearance, attack: appearance,
    ) -> list[Poisoning]:
        """The attacks as poisonings."""
        poisonings = []
        for attack in self.attacks:
            appearance = cached(self.appearance(attack), attack)
            trigger = attack.trigger(seed, self.attacks)
            poisonings.append(
                Poisoning(name=attack.name, trigger=trigger, appearance=appearance)
            )
        return poisonings


def nearest(
    cameras: Sequence[Camera], others: Sequence[Camera], centre: Point
) -> list[float]:
    """Degrees from each camera to the nearest of others, as seen from the centre."""
    middle = torch.as_tensor(centre, dtype=torch.float64)

    def unit(positions: Tensor) -> Tensor:
        return torch.nn.functional.normalize(positions.double() - middle, dim=-1)

    directions = unit(torch.stack([other.position for other in others]))
    cosines = [float((directions @ unit(camera.position)).max()) for camera in cameras]
    return [math.degrees(math.acos(min(1.0, cosine))) for cosine in cosines]
