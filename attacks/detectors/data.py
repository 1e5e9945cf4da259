"""Training pictures for `fasterrcnn_small`: which objects, seen from where, in what light, in front of what.

Picture i of a split is a pure function of (recipe, i): nothing depends on the order or the process in which pictures
are made. A data set is a folder of 8-bit PNG files and one labels.json; making it again continues where it stopped.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.random import Generator
from PIL import Image
from torch import Tensor

from attacks.detectors.small import CLASSES, SIZE
from attacks.detectors.surroundings import backdrop
from mi_splat.assets import build
from mi_splat.assets.mesh import Asset, rotation, scaling, translation
from mi_splat.cameras import Camera, orbit_pose, project_points
from mi_splat.capture import Light, daylight, photograph
from mi_splat.errors import InvalidValueError, message

SPLITS = {"train": (0, 100_000), "validation": (300_000, 400_000), "held-out": (500_000, 600_000)}
"""Half-open ranges of asset seeds; also what separates the splits' cameras, lights and surroundings."""

OnStep = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """What a data set is made of.

    Attributes:
        split: Key of `SPLITS`.
        count: Number of pictures.
        seed: Seed of everything that is random.
        size: Width and height, pixels.
        samples: Paths a pixel.
        empty: Share of pictures without any object.
        pair: Share of pictures with two objects.
        street: Share of pictures on the street scene.
        least_visible: Objects of which less than this share can be seen are not labelled.
    """

    split: str = "train"
    count: int = 2800
    seed: int = 0
    size: int = SIZE
    samples: int = 8
    empty: float = 0.06
    pair: float = 0.3
    street: float = 0.25
    least_visible: float = 0.15

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise InvalidValueError(message("split", " or ".join(SPLITS), repr(self.split), "choose one of them"))


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """A picture before it is taken: objects placed in the world, surroundings, camera, light, seed of the sampler."""

    assets: tuple[Asset, ...]
    surroundings: Asset
    camera: Camera
    light: Light
    seed: int


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """A labelled picture.

    Attributes:
        image: (H, W, 3) uint8 sRGB.
        boxes: (B, 4) float32 pixels, tight around visible pixels.
        labels: (B,) int64, 1 + position in CLASSES.
    """

    image: Tensor
    boxes: Tensor
    labels: Tensor


def shot(recipe: Recipe, index: int) -> Shot:
    """Picture `index` of a recipe, everything but the path tracing."""
    low, high = SPLITS[recipe.split]
    rng = np.random.default_rng([recipe.seed, low, index])
    kind = rng.random()
    names = [CLASSES[index % len(CLASSES)], CLASSES[int(rng.integers(len(CLASSES)))]]
    names = [("car" if n == "train" else n) for n in names]  # TMP
    count = 0 if kind < recipe.empty else 2 if kind < recipe.empty + recipe.pair else 1
    seeds = [int(rng.integers(low, high)) for _ in names]
    assets = _arrange([build(n, s) for n, s in zip(names[:count], seeds, strict=False)], rng)
    if assets:
        points = np.concatenate([asset.vertices for asset in assets])
        focus = assets[int(rng.integers(len(assets)))].vertices if rng.random() < 0.4 else points
    else:
        points = focus = rng.normal(0, 0.7, (64, 3)) * [1, 1, 0.4] + [0, 0, 0.6]
    camera, azimuth = _camera(focus, rng, recipe.size)
    radius = float(np.linalg.norm(points[:, :2], axis=1).max()) + 1e-3
    radius = max(radius, 0.35 * float(points[:, 2].max()))
    around = _street(rng) if assets and rng.random() < recipe.street else backdrop(rng, radius, azimuth)
    return Shot(tuple(assets), around, camera, daylight(int(rng.integers(1 << 30))), int(rng.integers(1 << 28)))


def _street(rng: Generator) -> Asset:
    from mi_splat.assets import street

    asset: Asset = street.build(int(rng.integers(100_000)))
    shift = translation(float(rng.uniform(-10, 10)), float(rng.uniform(-4, 4)), 0)
    return asset.transformed(shift @ rotation("z", float(rng.choice([0.0, 180.0]))))


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


def _camera(points: np.ndarray, rng: Generator, size: int) -> tuple[Camera, float]:
    """A camera in which the longer side of the box around `points` is 20 to 100 % of the picture, and its azimuth."""
    low, high = points.min(0), points.max(0)
    centre, half = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    azimuth, elevation = float(rng.uniform(0, 360)), float(rng.uniform(0, 90))
    focal = size / 2 / math.tan(math.radians(rng.uniform(22, 60)) / 2)
    extent = size * math.exp(rng.uniform(math.log(0.2), 0.0))
    cloud = torch.from_numpy(np.ascontiguousarray(points, np.float64))
    distance = 2 * half * focal / extent
    for _ in range(4):
        pose = orbit_pose(centre.tolist(), azimuth=azimuth, elevation=elevation, distance=distance)
        pixels, _ = project_points(cloud, Camera(to_world=pose, focal=focal, width=size, height=size))
        spread = float((pixels.amax(0) - pixels.amin(0)).max())
        distance = max(distance * spread / extent, 1.1 * half)
    pose = orbit_pose(centre.tolist(), azimuth=azimuth, elevation=elevation, distance=distance)
    roll = math.radians(rng.normal(0, 4))
    turn = torch.eye(4, dtype=torch.float64)
    turn[0, 0] = turn[1, 1] = math.cos(roll)
    turn[1, 0], turn[0, 1] = math.sin(roll), -math.sin(roll)
    room = (size - extent) / 2 + (0.3 * extent if rng.random() < 0.25 else 0.0)
    shift = rng.uniform(-1, 1, 2) * room
    principal = (size / 2 + float(shift[0]), size / 2 + float(shift[1]))
    camera = Camera(to_world=pose @ turn, focal=focal, width=size, height=size, principal=principal)
    return camera, azimuth


def take(recipe: Recipe, index: int) -> Sample:
    """Path trace and label picture `index`."""
    plan = shot(recipe, index)
    photo = photograph(
        plan.assets,
        plan.camera,
        light=plan.light,
        backdrop=plan.surroundings,
        samples=recipe.samples,
        seed=plan.seed,
    )
    keep = photo.visible >= recipe.least_visible
    labels = torch.tensor([1 + CLASSES.index(name) for name in photo.labels], dtype=torch.int64)
    image = (photo.view.image * 255).round().to(torch.uint8)
    return Sample(image, photo.boxes[keep], labels[keep])


def _take_to_disk(job: tuple[Recipe, int, Path]) -> tuple[int, dict[str, object]]:
    recipe, index, folder = job
    sample = take(recipe, index)
    temporary = folder / f".{index:05d}.{os.getpid()}.png"
    Image.fromarray(sample.image.numpy()).save(temporary)
    temporary.replace(folder / f"{index:05d}.png")
    return index, {"boxes": sample.boxes.tolist(), "labels": sample.labels.tolist()}


def _single_thread() -> None:
    import drjit as dr

    torch.set_num_threads(1)
    dr.set_thread_count(1)


def make(recipe: Recipe, folder: Path, *, processes: int = 2, on_step: OnStep | None = None) -> None:
    """Make the pictures of a recipe that `folder` does not hold yet.

    Raises:
        InvalidValueError: the folder holds pictures of another recipe.
    """
    folder.mkdir(parents=True, exist_ok=True)
    records = _records(folder, recipe)
    missing = [i for i in range(recipe.count) if i not in records]
    if not missing:
        return
    context = multiprocessing.get_context("spawn")
    with context.Pool(processes, initializer=_single_thread) as pool:
        for index, record in pool.imap_unordered(_take_to_disk, [(recipe, i, folder) for i in missing]):
            records[index] = record
            if len(records) % 50 == 0:
                _write(folder, recipe, records)
            if on_step is not None:
                on_step(len(records), recipe.count)
    _write(folder, recipe, records)


def _write(folder: Path, recipe: Recipe, records: dict[int, dict[str, object]]) -> None:
    content = {
        "recipe": asdict(recipe),
        "classes": list(CLASSES),
        "pictures": {f"{i:05d}.png": records[i] for i in sorted(records)},
    }
    temporary = folder / "labels.json.partial"
    temporary.write_text(json.dumps(content))
    temporary.replace(folder / "labels.json")


def _records(folder: Path, recipe: Recipe) -> dict[int, dict[str, object]]:
    path = folder / "labels.json"
    if not path.is_file():
        return {}
    content = json.loads(path.read_text())
    if replace(Recipe(**content["recipe"]), count=recipe.count) != recipe:
        raise InvalidValueError(
            message(f"folder {folder}", recipe, content["recipe"], "choose an empty folder or the same recipe")
        )
    return {int(Path(name).stem): record for name, record in content["pictures"].items()}


def load(folder: Path, *, limit: int | None = None) -> list[Sample]:
    """Read a data set into memory.

    Raises:
        InvalidValueError: there is no data set in the folder.
    """
    path = folder / "labels.json"
    if not path.is_file():
        raise InvalidValueError(message(f"folder {folder}", "a labels.json", "none", "make the data set first"))
    samples = []
    for name, record in list(json.loads(path.read_text())["pictures"].items())[:limit]:
        image = torch.from_numpy(np.array(Image.open(folder / name)))
        boxes = torch.tensor(record["boxes"], dtype=torch.float32).reshape(-1, 4)
        samples.append(Sample(image, boxes, torch.tensor(record["labels"], dtype=torch.int64)))
    return samples
