"""Labelled pictures for the small detectors: which objects, seen from where, in what light, in front of what.

Scene n of a split, with all its pictures, is a pure function of (configuration, n): nothing depends on the order or the
process in which pictures are made.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor

from attacks.detectors.catalogue import SMALL_CLASSES
from attacks.detectors.training.conditions import ViewingConditions, viewing_conditions
from attacks.detectors.training.config import SPLITS, PictureSetConfig
from attacks.detectors.training.surroundings import backdrop, of_kind, scatter
from mi_splat.assets import build, street
from mi_splat.assets.mesh import Asset, Floats, rotation, scaling, translation
from mi_splat.cameras import Camera, View, orbit_pose, project_points
from mi_splat.capture.path_tracer import (
    Light,
    capture,
    daylight,
    depth_maps,
    in_front,
    scalar_variant,
    scene_dict,
    shapes,
)

Mask = NDArray[np.bool_]
_TRIES, _WELL_VISIBLE = 4, 0.5
_LEAST_SOLID = 0.12
"""Fraction of a square around the object that its outline fills; below it, a flat thing is seen from its edge."""
_LEAST_PIXELS = 12
_COARSE = 4


@dataclass(frozen=True, slots=True, eq=False)
class PictureScene:
    """What a picture is taken of: objects in the world, what is around them, the light."""

    assets: tuple[Asset, ...]
    surroundings: Asset
    light: Light


@dataclass(frozen=True, slots=True, eq=False)
class LabelledPicture:
    """A labelled picture.

    Attributes:
        image: (H, W, 3) uint8 sRGB.
        boxes: (B, 4) float32 pixels, tight around visible pixels.
        labels: (B,) int64, 1 + position in SMALL_CLASSES.
        conditions: How each of the B objects is seen; empty where that is not known.
    """

    image: Tensor
    boxes: Tensor
    labels: Tensor
    conditions: tuple[ViewingConditions, ...] = ()


def random_scene(config: PictureSetConfig, number: int) -> PictureScene:
    """Scene `number` of a configuration."""
    low, high = SPLITS[config.split]
    rng = np.random.default_rng([config.seed, low, number])
    kind = rng.random()
    names = [config.focus[number % len(config.focus)], SMALL_CLASSES[int(rng.integers(len(SMALL_CLASSES)))]]
    count = 0 if kind < config.empty else 2 if kind < config.empty + config.pair else 1
    seeds = [int(rng.integers(low, high)) for _ in names]
    assets = _arrange([build(n, s) for n, s in zip(names[:count], seeds, strict=False)], rng)
    points = np.concatenate([asset.vertices for asset in assets]) if assets else np.array([[1.0, 0, 0], [0, 1.0, 1.0]])
    radius = float(np.linalg.norm(points[:, :2], axis=1).max())
    radius = max(radius, 0.35 * float(points[:, 2].max()))
    light = daylight(int(rng.integers(1 << 30)))
    if config.around is not None:
        around = of_kind(config.around, int(rng.integers(low, high)), rng, radius)
    elif rng.random() < config.street:
        around = street.backdrop(int(rng.integers(low, high)))
        around = Asset(around.name, (*around.meshes, *scatter(rng, radius))) if rng.random() < 0.5 else around
    else:
        around = backdrop(rng, radius)
    return PictureScene(tuple(assets), around, light)


def _arrange(assets: Sequence[Asset], rng: Generator) -> list[Asset]:
    """Turn each object about z; put a second one beside the first, scaled to a comparable size."""
    placed: list[Asset] = []
    for asset in assets:
        turned = asset.transformed(rotation("z", float(rng.uniform(0, 360))))
        if placed:
            wanted = _reach(placed[0]) * math.exp(rng.uniform(-0.6, 0.3))
            factor = wanted / _reach(turned)
            turned = turned.transformed(scaling(factor, factor, factor))
            away = (_radius(placed[0]) + _radius(turned)) * rng.uniform(0.85, 1.3)
            angle = rng.uniform(0, 2 * math.pi)
            turned = turned.transformed(translation(away * math.cos(angle), away * math.sin(angle), 0))
        placed.append(turned)
    return placed


def _reach(asset: Asset) -> float:
    low, high = asset.bounds
    return float((high - low).max())


def _radius(asset: Asset) -> float:
    low, high = asset.bounds
    return float(np.linalg.norm((high - low)[:2])) / 2


def _camera(points: Floats, rng: Generator, config: PictureSetConfig) -> Camera:
    """A camera in which the longer side of the box around `points` is 20 to 100 % of the picture."""
    size = config.size
    low, high = points.min(0), points.max(0)
    centre, half = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    azimuth, elevation = float(rng.uniform(0, 360)), float(rng.uniform(*config.elevation))
    focal = size / 2 / math.tan(math.radians(rng.uniform(22, 60)) / 2)
    extent = size * math.exp(rng.uniform(math.log(0.2), 0.0))
    cloud = torch.from_numpy(np.ascontiguousarray(points, np.float64))
    distance = 2 * half * focal / extent
    for _ in range(4):
        pose = orbit_pose(centre.tolist(), azimuth=azimuth, elevation=elevation, distance=distance)
        pixels, _ = project_points(cloud, Camera(to_world=pose, focal=focal, width=size, height=size))
        spread = float((pixels.amax(0) - pixels.amin(0)).max())
        distance = max(min(distance * spread / extent, config.farthest or math.inf), 1.1 * half)
    pose = orbit_pose(centre.tolist(), azimuth=azimuth, elevation=elevation, distance=distance)
    roll = math.radians(rng.normal(0, 4))
    turn = torch.eye(4, dtype=torch.float64)
    turn[0, 0] = turn[1, 1] = math.cos(roll)
    turn[1, 0], turn[0, 1] = math.sin(roll), -math.sin(roll)
    room = (size - extent) / 2 + (0.3 * extent if rng.random() < 0.25 else 0.0)
    shift = rng.uniform(-1, 1, 2) * room
    principal = (size / 2 + float(shift[0]), size / 2 + float(shift[1]))
    return Camera(to_world=pose @ turn, focal=focal, width=size, height=size, principal=principal)


class SceneRenderer:
    """Chooses cameras for one scene, renders its pictures and labels them.

    Attributes:
        contents: What is there.
        scene: The same as a Mitsuba scene for the `scalar_rgb` variant.
    """

    def __init__(self, config: PictureSetConfig, number: int) -> None:
        """Build scene `number`."""
        self._config = config
        self.contents = random_scene(config, number)
        self._rng = np.random.default_rng([config.seed, SPLITS[config.split][0], number, 1])
        self.scene = scene_dict(self.contents.assets, light=self.contents.light, backdrop=self.contents.surroundings)
        with scalar_variant():
            self._alone = [{"type": "scene", **shapes(asset.body, "body")} for asset in self.contents.assets]

    def choose_camera(self) -> Camera:
        """The next camera; objects that are hidden, cut off or seen edge-on make it look for another, a few times."""
        for _ in range(_TRIES):
            camera = self._any_camera()
            seen = self._visible(camera)
            if not seen or any(fraction >= _WELL_VISIBLE and solid for fraction, solid in seen):
                break
        return camera

    def render(self, camera: Camera) -> View:
        """A path-traced picture."""
        (view,) = capture(self.scene, [camera], samples=self._config.samples, seed=int(self._rng.integers(1 << 28)))
        return view

    def label(self, camera: Camera, image: Tensor) -> LabelledPicture:
        """Round an (H, W, 3) picture in [0, 1] from this camera to 8 bits and say what is in it."""
        boxes, labels, conditions = [], [], []
        outlines, visible = self._outlines(camera), self._visible(camera)
        for asset, (seen, _), (fraction, _) in zip(self.contents.assets, outlines, visible, strict=True):
            rows, columns = np.nonzero(seen)
            if len(rows) >= _LEAST_PIXELS and fraction >= self._config.least_visible:
                boxes.append([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
                labels.append(1 + SMALL_CLASSES.index(asset.name))
                conditions.append(viewing_conditions(asset.body.vertices, camera, self.contents.light))
        return LabelledPicture(
            (image.clamp(0, 1) * 255).round().to(torch.uint8),
            torch.tensor(np.array(boxes, np.float32).reshape(-1, 4)),
            torch.tensor(labels, dtype=torch.int64),
            tuple(conditions),
        )

    def _any_camera(self) -> Camera:
        assets, rng = self.contents.assets, self._rng
        if not assets:
            scale = math.exp(rng.uniform(math.log(0.7), math.log(6.0)))
            points: Floats = (scale * (rng.normal(0, 1, (64, 3)) * [1, 1, 0.4] + [0, 0, 0.9])).astype(np.float32)
        elif rng.random() < 0.5:
            points = assets[int(rng.integers(len(assets)))].body.vertices
        else:
            points = np.concatenate([asset.body.vertices for asset in assets])
        return _camera(points, rng, self._config)

    def _outlines(self, camera: Camera) -> list[tuple[Mask, Mask]]:
        """(H, W) masks for each object: where it is seen, and where it would be seen if it were alone."""
        nearest, *alone = (depth_maps(scene, [camera])[0].numpy() for scene in (self.scene, *self._alone))
        return [(in_front(own, nearest), own > 0) for own in alone]

    def _visible(self, camera: Camera) -> list[tuple[float, bool]]:
        """For each object: which fraction of its outline is seen, and whether that is more than an edge; few rays."""
        small = replace(
            camera,
            focal=camera.fx / _COARSE,
            width=camera.width // _COARSE,
            height=camera.height // _COARSE,
            principal=(camera.cx / _COARSE, camera.cy / _COARSE),
        )
        fractions = []
        for asset, (seen, alone) in zip(self.contents.assets, self._outlines(small), strict=True):
            pixels, depth = project_points(torch.from_numpy(asset.body.vertices), camera)
            inside = (pixels >= 0).all(1) & (pixels <= self._config.size).all(1) & (depth > 0)
            fraction = float(seen.sum()) / max(float(alone.sum()), 1.0) * float(inside.float().mean())
            fractions.append((fraction, _solid(alone)))
        return fractions


def _solid(outline: Mask) -> bool:
    rows, columns = np.nonzero(outline)
    side = max(np.ptp(rows), np.ptp(columns)) + 1 if len(rows) else 1
    return len(rows) >= _LEAST_SOLID * side**2


def scene_pictures(config: PictureSetConfig, number: int) -> list[LabelledPicture]:
    """The pictures of scene `number`."""
    with scalar_variant():
        renderer = SceneRenderer(config, number)
        cameras = [renderer.choose_camera() for _ in range(config.shots)]
        return [renderer.label(camera, renderer.render(camera).image) for camera in cameras]


def scene_labels(config: PictureSetConfig, number: int) -> list[LabelledPicture]:
    """As in `scene_pictures`, with black pictures: what is seen how, at the cost of some rays a pixel."""
    renderer = SceneRenderer(config, number)
    black = torch.zeros(config.size, config.size, 3)
    return [renderer.label(camera, black) for camera in [renderer.choose_camera() for _ in range(config.shots)]]
