"""Labelled images for the small detectors:
`python -m scenes.recipes.detector_pictures`.

They are path traced, or renderings of splats, or show no object at all, so that
whatever is reported there is a false positive. All images of scene n of a set are a
pure function of (set, n). What is missing in the folder is made.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import math
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor

from attacks.detectors.catalogue import SMALL_CLASSES, SMALL_SIDE
from mi_splat.cameras.camera import Camera, RenderFn, View, orbit_pose, project_points
from mi_splat.cameras.directions import direction_of
from mi_splat.cameras.lens import Lens
from mi_splat.capture.daylight import Light
from mi_splat.capture.mesh import Asset, Floats, rotation, scaling, translation
from mi_splat.capture.mitsuba_scene import scene_dict, shapes
from mi_splat.capture.path_tracer import FEW_PICTURES, in_front, tracing_variant
from mi_splat.capture.surface_points import nearness, surface_samples
from mi_splat.errors import InvalidValueError
from mi_splat.render.renderer import Renderer
from mi_splat.scene import GaussianScene, merge
from scenes.recipes.detector_surroundings import (
    backdrop,
    daylight,
    of_kind,
    random_surroundings,
    scatter,
)
from scenes.recipes.disc_splats import DiscConfig, RefineConfig, disc_splat, refine
from scenes.recipes.mesh_views import capture, depth_maps
from scenes.recipes.objects import Model, build
from scenes.recipes.objects.primitives import ellipsoid

SPLITS = {
    "train": (0, 100_000),
    "validation": (300_000, 400_000),
    "held-out": (500_000, 600_000),
}
"""Half-open ranges of asset seeds; also what separates the splits' cameras, lights and
surroundings.
"""
BACKGROUNDS = ("street", "park", "room", "ground", "random")
"""Kinds of surroundings without any object."""
PATH_TRACED = "path traced"
SPLAT_RENDERS = "splat renders"
EMPTY = "background: "
"""Names of the held-out sets; that of a set without objects ends with its kind."""

Mask = NDArray[np.bool_]
_TRIES = 4
_WELL_VISIBLE = 0.5
_LEAST_SOLID = 0.12
"""Fraction of a square around the object that its outline fills; below it, a flat thing
is seen from its edge.
"""
_LEAST_PIXELS = 12
_COARSE = 4
_DISTANCE = (4.0, 7.0)
"""Metres from a camera to what it looks at, about those of the shipped scenes."""
_OBJECT_RADIUS = 2.2
"""Metres; random surroundings are made to fit an object of this size, here that of a
car.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class SplatSettings:
    """How a splat is made of a scene: path-traced views, Gaussians, steps of
    refinement, and renderings of it.
    """

    views: int = 16
    samples: int = 12
    objects: int = 12_000
    surroundings: int = 30_000
    sky: int = 1_500
    steps: int = 100
    pictures: int = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureSet:
    """Scenes of one kind.

    Attributes:
        split: Key of `SPLITS`.
        scenes: Number of scenes.
        first: Number of the first one.
        seed: Seed of everything that is random.
        size: Width and height, pixels.
        shots: Images of each scene.
        samples: Samples per pixel.
        empty: Fraction of scenes without any object.
        pair: Fraction of scenes with two objects.
        street: Fraction of scenes in the surroundings of
            `detector_surroundings.backdrop`, which has no street.
        least_visible: Objects of which less than this fraction can be seen are not
            labelled.
        elevation: Lowest and highest elevation of the cameras, degrees.
        focus: Classes that take turns as a scene's first object.
        around: Kind in `BACKGROUNDS` of every scene's surroundings; None draws them as
            `street` says.
        farthest: Longest distance of a camera from what it looks at, metres; None is
            any distance.
        objects: Whether there are objects; without them, `around` is shown alone.
        splat: How the scenes are made into splats, which are rendered; None path traces
            them.
    """

    split: str = "train"
    scenes: int
    first: int = 0
    seed: int = 0
    size: int = SMALL_SIDE
    shots: int = 3
    samples: int = 6
    empty: float = 0.06
    pair: float = 0.3
    street: float = 0.5
    least_visible: float = 0.15
    elevation: tuple[float, float] = (0.0, 90.0)
    focus: tuple[str, ...] = SMALL_CLASSES
    around: str | None = None
    farthest: float | None = None
    objects: bool = True
    splat: SplatSettings | None = None


class ViewingConditions(NamedTuple):
    """How an object is seen: camera elevation (degrees), distance and box diagonal
    (metres), and the sun, if known.
    """

    elevation: float
    distance: float
    extent: float
    sun_elevation: float | None = None
    sun_strength: float | None = None


def viewing_conditions(
    points: Floats, camera: Camera, light: Light | None = None
) -> ViewingConditions:
    """How an object is seen from a camera, rounded to six digits after the point."""
    low = points.min(0).astype(np.float64)
    high = points.max(0).astype(np.float64)
    centre: list[float] = ((low + high) / 2).tolist()
    return ViewingConditions(
        elevation=round(direction_of(camera, centre).elevation, 6),
        distance=round(math.dist(camera.position.tolist(), centre), 6),
        extent=round(float(np.linalg.norm(high - low)), 6),
        sun_elevation=None if light is None else round(light.sun_elevation, 6),
        sun_strength=None if light is None else round(light.sun_strength, 6),
    )


@dataclass(frozen=True, slots=True, eq=False)
class PictureScene:
    """What an image is taken of: objects in the world, what is around them, the
    light.
    """

    assets: tuple[Model, ...]
    surroundings: Asset
    light: Light


@dataclass(frozen=True, slots=True, eq=False)
class LabelledPicture:
    """A labelled image.

    Attributes:
        image: (H, W, 3) uint8 sRGB.
        boxes: (B, 4) float32 pixels, tight around visible pixels.
        labels: (B,) int64, 1 + position in SMALL_CLASSES.
        conditions: How each of the B objects is seen; empty where nobody asks.
    """

    image: Tensor
    boxes: Tensor
    labels: Tensor
    conditions: tuple[ViewingConditions, ...] = ()


def random_scene(config: PictureSet, number: int) -> PictureScene:
    """Scene `number` of a configuration."""
    low, high = SPLITS[config.split]
    rng = np.random.default_rng([config.seed, low, number])
    kind = rng.random()
    names = [
        config.focus[number % len(config.focus)],
        SMALL_CLASSES[int(rng.integers(len(SMALL_CLASSES)))],
    ]
    count = 0 if kind < config.empty else 2 if kind < config.empty + config.pair else 1
    seeds = [int(rng.integers(low, high)) for _ in names]
    assets = _arrange(
        [build(n, s) for n, s in zip(names[:count], seeds, strict=False)], rng
    )
    if assets:
        points = np.concatenate([asset.vertices for asset in assets])
    else:
        points = np.array([[1.0, 0, 0], [0, 1.0, 1.0]])
    radius = float(np.linalg.norm(points[:, :2], axis=1).max())
    radius = max(radius, 0.35 * float(points[:, 2].max()))
    light = daylight(int(rng.integers(1 << 30)))
    if config.around is not None:
        around = of_kind(config.around, int(rng.integers(low, high)), rng, radius)
    elif rng.random() < config.street:
        around = backdrop(int(rng.integers(low, high)))
        if rng.random() < 0.5:
            around = Asset(around.name, (*around.meshes, *scatter(rng, radius)))
        else:
            around = around
    else:
        around = random_surroundings(rng, radius)
    return PictureScene(tuple(assets), around, light)


def _arrange(assets: Sequence[Model], rng: Generator) -> list[Model]:
    """Turn each object about z; put a second one beside the first, scaled to a
    comparable size.
    """
    placed: list[Model] = []
    for asset in assets:
        turned = asset.transformed(rotation("z", float(rng.uniform(0, 360))))
        if placed:
            wanted = _reach(placed[0]) * math.exp(rng.uniform(-0.6, 0.3))
            factor = wanted / _reach(turned)
            turned = turned.transformed(scaling(factor, factor, factor))
            away = (_radius(placed[0]) + _radius(turned)) * rng.uniform(0.85, 1.3)
            angle = rng.uniform(0, 2 * math.pi)
            turned = turned.transformed(
                translation(away * math.cos(angle), away * math.sin(angle), 0)
            )
        placed.append(turned)
    return placed


def _reach(asset: Asset) -> float:
    low, high = asset.bounds
    return float((high - low).max())


def _radius(asset: Asset) -> float:
    low, high = asset.bounds
    return float(np.linalg.norm((high - low)[:2])) / 2


def framing_camera(
    points: Floats, rng: Generator, config: PictureSet, *, smallest: float = 0.2
) -> Camera:
    """A camera in which the longer side of the box around some points is a fraction of
    the image's side.
    """
    size = config.size
    low = points.min(0)
    high = points.max(0)
    centre = (low + high) / 2
    half = float(np.linalg.norm(high - low)) / 2
    azimuth = float(rng.uniform(0, 360))
    elevation = float(rng.uniform(*config.elevation))
    focal = size / 2 / math.tan(math.radians(rng.uniform(22, 60)) / 2)
    extent = size * math.exp(rng.uniform(math.log(smallest), 0.0))
    cloud = torch.from_numpy(np.ascontiguousarray(points, np.float64))
    distance = 2 * half * focal / extent
    for _ in range(4):
        pose = orbit_pose(
            centre.tolist(), azimuth=azimuth, elevation=elevation, distance=distance
        )
        pixels, _ = project_points(
            cloud, Camera(to_world=pose, lens=Lens(focal=focal, size=(size, size)))
        )
        spread = float((pixels.amax(0) - pixels.amin(0)).max())
        distance = max(
            min(distance * spread / extent, config.farthest or math.inf), 1.1 * half
        )
    pose = orbit_pose(
        centre.tolist(), azimuth=azimuth, elevation=elevation, distance=distance
    )
    roll = math.radians(rng.normal(0, 4))
    turn = torch.eye(4, dtype=torch.float64)
    turn[0, 0] = turn[1, 1] = math.cos(roll)
    turn[1, 0], turn[0, 1] = math.sin(roll), -math.sin(roll)
    room = (size - extent) / 2 + (0.3 * extent if rng.random() < 0.25 else 0.0)
    shift = rng.uniform(-1, 1, 2) * room
    principal = (size / 2 + float(shift[0]), size / 2 + float(shift[1]))
    return Camera(
        to_world=pose @ turn,
        lens=Lens(focal=focal, size=(size, size), principal=principal),
    )


class SceneRenderer:
    """Chooses cameras for one scene, renders its images and labels them.

    Attributes:
        contents: What is there.
        scene: The same as a Mitsuba scene for the variant of few images.
    """

    def __init__(self, config: PictureSet, number: int) -> None:
        """Build scene `number`."""
        self._config = config
        self.contents = random_scene(config, number)
        self._rng = np.random.default_rng(
            [config.seed, SPLITS[config.split][0], number, 1]
        )
        contents = self.contents
        with tracing_variant(FEW_PICTURES):
            self.scene = scene_dict(
                contents.assets, light=contents.light, backdrop=contents.surroundings
            )
            self._alone = [
                {"type": "scene", **shapes(asset.body, "body")}
                for asset in contents.assets
            ]

    @tracing_variant(FEW_PICTURES)
    def choose_camera(self) -> Camera:
        """The next camera; objects that are hidden, cut off or seen edge-on make it
        look for another, a few times.
        """
        for _ in range(_TRIES):
            camera = self._any_camera()
            seen = self._visible(camera)
            if not seen or any(
                fraction >= _WELL_VISIBLE and solid for fraction, solid in seen
            ):
                break
        return camera

    @tracing_variant(FEW_PICTURES)
    def render(self, camera: Camera) -> View:
        """A path-traced image."""
        (view,) = capture(
            self.scene,
            [camera],
            samples=self._config.samples,
            seed=int(self._rng.integers(1 << 28)),
        )
        return view

    @tracing_variant(FEW_PICTURES)
    def label(self, camera: Camera, image: Tensor) -> LabelledPicture:
        """Round an (H, W, 3) image in [0, 1] from this camera to 8 bits and say what
        is in it.
        """
        boxes = []
        labels = []
        conditions = []
        outlines = self._outlines(camera)
        visible = self._visible(camera)
        for asset, (seen, _), (fraction, _) in zip(
            self.contents.assets, outlines, visible, strict=True
        ):
            rows, columns = np.nonzero(seen)
            if len(rows) >= _LEAST_PIXELS and fraction >= self._config.least_visible:
                boxes.append(
                    [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
                )
                labels.append(1 + SMALL_CLASSES.index(asset.name))
                conditions.append(
                    viewing_conditions(asset.body.vertices, camera, self.contents.light)
                )
        return LabelledPicture(
            _in_bytes(image),
            torch.tensor(np.array(boxes, np.float32).reshape(-1, 4)),
            torch.tensor(labels, dtype=torch.int64),
            tuple(conditions),
        )

    def _any_camera(self) -> Camera:
        assets = self.contents.assets
        rng = self._rng
        if not assets:
            scale = math.exp(rng.uniform(math.log(0.7), math.log(6.0)))
            points: Floats = (
                scale * (rng.normal(0, 1, (64, 3)) * [1, 1, 0.4] + [0, 0, 0.9])
            ).astype(np.float32)
        elif rng.random() < 0.5:
            points = assets[int(rng.integers(len(assets)))].body.vertices
        else:
            points = np.concatenate([asset.body.vertices for asset in assets])
        return framing_camera(points, rng, self._config)

    def _outlines(self, camera: Camera) -> list[tuple[Mask, Mask]]:
        """(H, W) masks for each object: where it is seen, and where it would be seen if
        it were alone.
        """
        nearest, *alone = (
            depth_maps(scene, [camera])[0].numpy()
            for scene in (self.scene, *self._alone)
        )
        return [(in_front(depths, nearest), depths > 0) for depths in alone]

    def _visible(self, camera: Camera) -> list[tuple[float, bool]]:
        """For each object: which fraction of its outline is seen, and whether that is
        more than an edge; few rays.
        """
        lens = Lens(
            focal=camera.fx / _COARSE,
            size=(camera.width // _COARSE, camera.height // _COARSE),
            principal=(camera.cx / _COARSE, camera.cy / _COARSE),
        )
        small = replace(camera, lens=lens)
        fractions = []
        for asset, (seen, alone) in zip(
            self.contents.assets, self._outlines(small), strict=True
        ):
            pixels, depth = project_points(
                torch.from_numpy(asset.body.vertices), camera
            )
            inside = (
                (pixels >= 0).all(1)
                & (pixels <= self._config.size).all(1)
                & (depth > 0)
            )
            fraction = (
                float(seen.sum())
                / max(float(alone.sum()), 1.0)
                * float(inside.float().mean())
            )
            fractions.append((fraction, _solid(alone)))
        return fractions


def _in_bytes(image: Tensor) -> Tensor:
    return (image.clamp(0, 1) * 255).round().to(torch.uint8)


def _solid(outline: Mask) -> bool:
    rows, columns = np.nonzero(outline)
    side = max(np.ptp(rows), np.ptp(columns)) + 1 if len(rows) else 1
    return len(rows) >= _LEAST_SOLID * side**2


def scene_pictures(config: PictureSet, number: int) -> list[LabelledPicture]:
    """The images of scene `number`."""
    if not config.objects:
        return background_pictures(config, number)
    if config.splat is not None:
        return splat_pictures(config, number, config.splat, render=Renderer())
    with tracing_variant(FEW_PICTURES):
        renderer = SceneRenderer(config, number)
        cameras = [renderer.choose_camera() for _ in range(config.shots)]
        return [
            renderer.label(camera, renderer.render(camera).image) for camera in cameras
        ]


def background_pictures(config: PictureSet, number: int) -> list[LabelledPicture]:
    """Surroundings seen from where cameras stand in the images with objects, without
    any label.
    """
    kind, (low, high) = str(config.around), SPLITS[config.split]
    rng = np.random.default_rng([config.seed, low, number, 2 + BACKGROUNDS.index(kind)])
    around = of_kind(kind, int(rng.integers(low, high)), rng, _OBJECT_RADIUS)
    with tracing_variant(FEW_PICTURES):
        scene = scene_dict(
            [], light=daylight(int(rng.integers(1 << 30))), backdrop=around
        )
        cameras = [background_camera(rng, config.size) for _ in range(config.shots)]
        views = capture(
            scene, cameras, samples=config.samples, seed=int(rng.integers(1 << 28))
        )
    nothing = torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64)
    return [LabelledPicture(_in_bytes(view.image), *nothing) for view in views]


def background_camera(rng: Generator, size: int) -> Camera:
    """A camera that looks at a point near the origin, where objects stand in other
    images.
    """
    target = (
        float(rng.normal(0, 0.5)),
        float(rng.normal(0, 0.5)),
        float(rng.uniform(0.5, 1.2)),
    )
    focal = size / 2 / math.tan(math.radians(rng.uniform(22, 60)) / 2)
    pose = orbit_pose(
        target,
        azimuth=float(rng.uniform(0, 360)),
        elevation=float(rng.uniform(0, 90)),
        distance=float(rng.uniform(*_DISTANCE)),
    )
    return Camera(to_world=pose, lens=Lens(focal=focal, size=(size, size)))


def splat_pictures(
    scenes: PictureSet, number: int, config: SplatSettings, *, render: RenderFn
) -> list[LabelledPicture]:
    """Labelled renders of a splat of one scene; the labels are those of the meshes it
    was made from.
    """
    renderer = SceneRenderer(replace(scenes, samples=config.samples), number)
    with tracing_variant(FEW_PICTURES):
        tests = [renderer.choose_camera() for _ in range(config.pictures)]
        views = [renderer.render(renderer.choose_camera()) for _ in range(config.views)]
    splat = splat_of(renderer.scene, renderer.contents, views, config, render)
    with torch.no_grad():
        pictures = [render(splat, camera) for camera in tests]
    with tracing_variant(FEW_PICTURES):
        return [
            renderer.label(camera, picture)
            for camera, picture in zip(tests, pictures, strict=True)
        ]


def splat_of(
    scene: dict[str, Any],
    contents: PictureScene,
    views: Sequence[View],
    config: SplatSettings,
    render: RenderFn,
) -> GaussianScene:
    """A splat of a path-traced scene: objects, surroundings and sky."""
    cameras = [view.camera for view in views]
    depths = depth_maps(scene, cameras)
    dome = Asset(
        "sky", (ellipsoid((440.0, 440.0, 440.0), (0.6, 0.7, 0.8), segments=48),)
    )
    wanted: list[tuple[Asset, int, float]] = [
        (asset, config.objects, 0.62) for asset in contents.assets
    ]
    wanted += (
        [(contents.surroundings, config.surroundings, 0.62)]
        if contents.surroundings.meshes
        else []
    )
    wanted += [(dome, config.sky, 0.9)]
    parts = []
    for asset, count, overlap in wanted:
        if asset is contents.surroundings:
            density = nearness(cameras, closest=0.3)
        else:
            density = None
        samples = surface_samples(asset, count, density=density)
        # a part that no image shows is left out
        with contextlib.suppress(InvalidValueError):
            parts.append(
                disc_splat(samples, views, depths, config=DiscConfig(overlap=overlap))
            )
    whole = merge(*parts)
    if config.steps == 0:
        return whole
    return refine(whole, views, render=render, config=RefineConfig(steps=config.steps))


def training_sets(scale: float = 1.0) -> tuple[list[PictureSet], list[PictureSet]]:
    """What a detector is trained on, and by which the best epoch is chosen; `scale`
    makes all of it smaller.
    """

    def of(scenes: int, **settings: Any) -> PictureSet:
        return PictureSet(scenes=math.ceil(scale * scenes), **settings)

    def empty(scenes: int, **settings: Any) -> list[PictureSet]:
        return [
            of(scenes, objects=False, around=kind, **settings) for kind in BACKGROUNDS
        ]

    splat = SplatSettings(
        views=12, samples=6, objects=8000, surroundings=20_000, steps=80, pictures=8
    )
    streets: dict[str, Any] = {"around": "street", "farthest": 9.0}
    training = [
        of(1200),
        of(240, seed=1, empty=0.4, street=1.0),
        of(
            240,
            seed=3,
            elevation=(50, 90),
            focus=("car", "train", *SMALL_CLASSES),
            street=0.7,
        ),
        of(200, seed=4, **streets),
        of(40, seed=2, splat=splat),
        of(16, seed=5, splat=splat, **streets),
        *empty(24, shots=6),
        of(48, seed=1, objects=False, around="street", shots=6),
        of(24, seed=2, objects=False, around="street", samples=16),
    ]
    validation = [of(40, split="validation"), *empty(12, split="validation", shots=2)]
    return training, validation


def held_out_sets(
    *, pictures: int = 80, splats: int = 32, backgrounds: int = 12, samples: int = 24
) -> dict[str, PictureSet]:
    """What detectors are scored on: numbers of scenes."""
    scored = PictureSet(split="held-out", scenes=pictures, samples=samples)
    sets = {
        PATH_TRACED: scored,
        # none of the others
        SPLAT_RENDERS: replace(
            scored, scenes=splats, first=10_000, splat=SplatSettings()
        ),
        **{
            f"{EMPTY}{kind}": replace(
                scored, scenes=backgrounds, shots=2, objects=False, around=kind
            )
            for kind in BACKGROUNDS
        },
    }
    return {name: members for name, members in sets.items() if members.scenes}


def made(
    folder: Path, sets: Sequence[PictureSet], *, processes: int = 2
) -> list[list[LabelledPicture]]:
    """The images of some sets; those that are missing in the folder are made first."""
    folder.mkdir(parents=True, exist_ok=True)
    files = [
        [
            (folder / f"{_digest(members)}-{number}.pt", members, number)
            for number in _numbers(members)
        ]
        for members in sets
    ]
    missing = [file for part in files for file in part if not file[0].is_file()]
    if processes and missing:
        with ProcessPoolExecutor(
            processes, mp_context=multiprocessing.get_context("spawn")
        ) as pool:
            list(pool.map(_make, *zip(*missing, strict=True)))
    else:
        for file in missing:
            _make(*file)
    return [
        [picture for path, _, _ in part for picture in _read(path)] for part in files
    ]


def _numbers(members: PictureSet) -> range:
    return range(members.first, members.first + members.scenes)


def _digest(members: PictureSet) -> str:
    return hashlib.sha256(
        repr(replace(members, scenes=0, first=0)).encode()
    ).hexdigest()[:16]


def _make(path: Path, members: PictureSet, number: int) -> None:
    pictures = [
        (
            picture.image,
            picture.boxes,
            picture.labels,
            [tuple(seen) for seen in picture.conditions],
        )
        for picture in scene_pictures(members, number)
    ]
    torch.save(pictures, path.with_suffix(".part"))
    path.with_suffix(".part").replace(path)


def _read(path: Path) -> list[LabelledPicture]:
    return [
        LabelledPicture(
            image, boxes, labels, tuple(ViewingConditions(*seen) for seen in conditions)
        )
        for image, boxes, labels, conditions in torch.load(path, weights_only=True)
    ]


def main() -> None:
    """Make the training and validation images."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("out/detector-data"))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument(
        "--scale", type=float, default=1.0, help="fraction of the scenes"
    )
    options = parser.parse_args()
    training, validation = training_sets(options.scale)
    made(options.data, [*training, *validation], processes=options.processes)


if __name__ == "__main__":
    main()
