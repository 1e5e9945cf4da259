"""Pictures of the project's own objects and places, each with all that is true of it, for `ImageText`.

All pictures of scene n of a split are a pure function of (split, n). Objects, places, lights and cameras of the splits
come from seeds that are apart (`attacks.detectors.training.config.SPLITS`); those of studies, from 900000 on, are in
none of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attacks.classifiers.image_text_captions import NOTHING, OBJECTS, PAINTS, SURROUNDINGS, VIEWS, Facts
from attacks.detectors.training.config import SPLITS, PictureSetConfig, SplatConfig
from attacks.detectors.training.pictures import PictureScene, background_camera, framing_camera, splat_of
from attacks.detectors.training.surroundings import backdrop
from mi_splat.assets import PAINTED, build, street
from mi_splat.assets.daylight import Light
from mi_splat.assets.mesh import Asset, Mesh, rotation
from mi_splat.assets.primitives import box, ellipsoid, lathe
from mi_splat.cameras import Camera, View
from mi_splat.capture.mitsuba_meshes import FEW_PICTURES, tracing_variant
from mi_splat.capture.path_tracer import capture, daylight, depth_maps, in_front, scene_dict, shapes
from mi_splat.directions import direction_of
from mi_splat.rendering import Renderer

SIZE = 96
"""Width and height of the pictures, which the network sees after random changes, and smaller."""
SAMPLES = 5
_FROM_ABOVE, _FROM_THE_SIDE, _LOW_SUN, _HIGH_SUN, _CLOUDY = 50.0, 25.0, 28.0, 50.0, 0.5
_LARGE = 2.6
"""Objects that reach farther than this many metres from their middle stand where nothing hides them."""
_EMPTY_EVERY = 8
"""One scene in this many shows a place without an object."""
_TRIES, _WELL_VISIBLE, _SMALLEST = 4, 0.6, 0.45
_SPLAT = SplatConfig(views=12, samples=8, objects=8000, surroundings=12_000, sky=800, steps=80)

_SOLIDS: Mapping[str, Callable[[Any, Any], Mesh]] = {
    "box": lambda size, paint: box(tuple(size), paint, centre=(0, 0, size[2] / 2)),
    "ball": lambda size, paint: ellipsoid((size[0],) * 3, paint, centre=(0, 0, size[0] / 2), segments=32),
    "cone": lambda size, paint: lathe([[0, 0], [size[0] / 2, 0], [0.01, 1.3 * size[2]]], paint, segments=32),
    "cylinder": lambda size, paint: lathe(
        [[0, 0], [size[0] / 2, 0], [size[0] / 2, size[2]], [0, size[2]]], paint, segments=32
    ),
}
_IN_STREETS: Mapping[str, Callable[[np.random.Generator], list[Mesh]]] = {
    "tree": street.tree,
    "street lamp": street.lamp,
    "house": lambda rng: street.house(rng, width=8.0),
}


@dataclass(frozen=True, slots=True, eq=False)
class ToldPicture:
    """A picture and what is true of it.

    Attributes:
        image: (SIZE, SIZE, 3) uint8 sRGB.
        facts: What is true of it.
        scene: Number of its scene; pictures of one scene show the same object.
    """

    image: Tensor
    facts: Facts
    scene: int


def object_of(name: str, seed: int) -> tuple[Asset, tuple[str, ...]]:
    """An object of `OBJECTS` at the origin, and the word for its paint if it has one by name."""
    rng = np.random.default_rng([seed, 0x1A7])
    word = str(rng.choice([*PAINTS]))
    paint = np.clip(np.array(PAINTS[word]) * rng.uniform(0.85, 1.15) + rng.uniform(-0.03, 0.03, 3), 0.02, 0.95)
    if name in PAINTED:
        return build(name, seed, colour=paint.tolist()), (word,)
    if name in _SOLIDS:
        return Asset(name, (_SOLIDS[name](rng.uniform(0.5, 1.2, 3), paint),)), (word,)
    if name in _IN_STREETS:
        return Asset(name, tuple(_IN_STREETS[name](rng))), ()
    return build(name, seed), ()


def surroundings_of(kind: str, seed: int, clearance: float) -> Asset:
    """The surroundings of a kind of `SURROUNDINGS` with nothing within some metres of the origin."""
    if kind == "street":
        return street.build(seed, clearance=clearance)
    if kind == "park":
        return street.park(seed, clearance=clearance)
    return street.room(seed, size=clearance + 2) if kind == "room" else street.plain(seed, kind)


def told_scene(split: str, number: int) -> tuple[PictureScene, Facts]:
    """Scene `number` of a split, and what is true of all its pictures. Objects take turns."""
    low, high = SPLITS[split]
    rng = np.random.default_rng([low, number, 0x7E87])
    seed, light = int(rng.integers(low, high)), daylight(int(rng.integers(1 << 30)))
    kinds = [*SURROUNDINGS]
    if number % _EMPTY_EVERY == _EMPTY_EVERY - 1:
        kind = kinds[number // _EMPTY_EVERY % len(kinds)]
        return PictureScene((), surroundings_of(kind, seed, 7.5), light), replace(
            NOTHING, surroundings=SURROUNDINGS[kind], lights=_sky(light)
        )
    name = [*OBJECTS][(number - number // _EMPTY_EVERY) % len(OBJECTS)]
    built, paints = object_of(name, seed)
    asset = built.transformed(rotation("z", float(rng.uniform(0, 360))))
    reach = float(np.linalg.norm(np.ptp(asset.vertices, 0))) / 2
    open_kinds = [word for word in kinds if word not in ("street", "room")]
    kind = str(rng.choice(open_kinds if reach > _LARGE else kinds))
    chance = rng.random()
    if chance < 0.75:
        around, words = surroundings_of(kind, seed, max(7.5, 4 * reach)), SURROUNDINGS[kind]
    else:
        around, words = backdrop(rng, reach) if chance < 0.9 else Asset("nothing", ()), ()
    facts = Facts(objects=OBJECTS[name], paints=paints, surroundings=words, lights=_sky(light))
    return PictureScene((asset,), around, light), facts


def _sky(light: Light) -> tuple[str, ...]:
    if light.sun_strength < _CLOUDY:
        return ("under a cloudy sky",)
    if light.sun_elevation < _LOW_SUN:
        return ("under a low sun",)
    return ("under a high sun",) if light.sun_elevation > _HIGH_SUN else ()


def _view(camera: Camera, contents: PictureScene) -> tuple[str, ...]:
    middle = contents.assets[0].body.vertices.mean(0).tolist() if contents.assets else [0.0, 0.0, 0.5]
    elevation = direction_of(camera, middle).elevation
    return (VIEWS[0],) if elevation > _FROM_ABOVE else (VIEWS[1],) if elevation < _FROM_THE_SIDE else ()


class _Photographer:
    """Chooses cameras of a scene and takes its pictures."""

    def __init__(self, split: str, number: int) -> None:
        self.contents, self.facts = told_scene(split, number)
        self._rng = np.random.default_rng([SPLITS[split][0], number, 0xCA3])
        contents = self.contents
        bare = not contents.surroundings.meshes
        around = None if bare else contents.surroundings
        self.scene = scene_dict(contents.assets, light=contents.light, backdrop=around)
        self._alone = [{"type": "scene", **shapes(asset.body, "body")} for asset in contents.assets]
        self._background = self._rng.uniform(0, 1, 3) if bare and self._rng.random() < 0.6 else None

    def cameras(self, count: int) -> list[Camera]:
        """Cameras from which the object is well visible, if a few tries find such."""
        return [self._camera() for _ in range(count)]

    def pictures(self, cameras: Sequence[Camera], *, samples: int) -> list[View]:
        """Path-traced pictures; where nothing is around an object, often in front of a plain colour."""
        views = capture(self.scene, cameras, samples=samples, seed=int(self._rng.integers(1 << 28)))
        if self._background is None:
            return views
        colour = torch.from_numpy(self._background).float()
        depths = depth_maps(self.scene, cameras)
        return [
            View(view.camera, torch.where(depth[..., None] > 0, view.image, colour))
            for view, depth in zip(views, depths, strict=True)
        ]

    def _camera(self) -> Camera:
        if not self.contents.assets:
            return background_camera(self._rng, SIZE)
        elevation = (0.0, 30.0) if self._rng.random() < 0.5 else (30.0, 85.0)
        config = PictureSetConfig(size=SIZE, elevation=elevation)
        for _ in range(_TRIES):
            camera = framing_camera(self.contents.assets[0].body.vertices, self._rng, config, smallest=_SMALLEST)
            small = replace(
                camera, focal=camera.fx / 4, width=SIZE // 4, height=SIZE // 4, principal=(camera.cx / 4, camera.cy / 4)
            )
            nearest, alone = (depth_maps(scene, [small])[0] for scene in (self.scene, *self._alone))
            if float(in_front(alone, nearest).sum()) >= _WELL_VISIBLE * max(float((alone > 0).sum()), 1.0):
                break
        return camera


def _told(photographer: _Photographer, views: Sequence[View], number: int) -> list[ToldPicture]:
    return [
        ToldPicture(
            (view.image.clamp(0, 1) * 255).round().to(torch.uint8),
            replace(photographer.facts, views=_view(view.camera, photographer.contents)),
            number,
        )
        for view in views
    ]


def told_pictures(split: str, number: int, shots: int) -> list[ToldPicture]:
    """Path-traced pictures of one scene."""
    with tracing_variant(FEW_PICTURES):
        photographer = _Photographer(split, number)
        views = photographer.pictures(photographer.cameras(shots), samples=SAMPLES)
    return _told(photographer, views, number)


def told_splats(split: str, number: int, shots: int) -> list[ToldPicture]:
    """Renders of a splat of one scene: Gaussians laid on its meshes, coloured from pictures and refined."""
    with tracing_variant(FEW_PICTURES):
        photographer = _Photographer(split, number)
        cameras = photographer.cameras(shots)
        views = capture(photographer.scene, photographer.cameras(_SPLAT.views), samples=_SPLAT.samples, seed=number)
    contents, render = photographer.contents, Renderer()
    splat = splat_of(photographer.scene, contents, views, _SPLAT, render)
    with torch.no_grad():
        return _told(photographer, [View(camera, render(splat, camera)) for camera in cameras], number)


def many(
    make: Callable[[str, int, int], list[ToldPicture]], split: str, numbers: Sequence[int], *, shots: int, workers: int
) -> Iterator[list[ToldPicture]]:
    """The pictures of many scenes, in their order."""
    if workers == 1:
        yield from (make(split, number, shots) for number in numbers)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        count = len(numbers)
        yield from pool.map(make, [split] * count, numbers, [shots] * count, chunksize=4)
