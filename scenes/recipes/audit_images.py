"""Sets of images to measure the audit of images on: `python -m
scenes.recipes.audit_images FOLDER NAME FILE.csv [FIRST [COUNT]]`.

NAME is "development", the sets on which thresholds were chosen, or "test": sets that
are drawn, each an object of a seed of its own with a sun, cameras and poison of its
own. Sets that are missing in FOLDER are made and audited, and a row of each is written
to FILE.csv; `docs/audit.md` has what follows from the rows (`python -m
scenes.recipes.audit_images table FILE.csv`).

`python -m scenes.recipes.audit_images photographs FILE.csv HONEST [POISONED ...]`
writes a row of a set of photographs, and of sets that `mi-splat poison` made of it.

Adaptive attackers know the audit: most of all images are poisoned, or two; the poison
sets in over 50 degrees; or only a ball, which holds a fifth of the object, changes.
"""

import csv
import json
import random
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attacks.cloak.config import AttackConfig, CameraConfig, SceneConfig
from attacks.cloak.poisoning import poison
from attacks.cloak.setup import Setup
from attacks.poisons.base import Poisoned, poisoned
from attacks.poisons.writing import write_poisoned
from mi_splat.audit.images import ImageAudit, audit_images
from mi_splat.cameras.camera import Camera
from mi_splat.cameras.directions import direction_of
from mi_splat.capture.path_tracer import PathTracer, tracing_variant
from mi_splat.capture.settings import CaptureSettings
from mi_splat.capture.writer import write_capture
from mi_splat.datasets import Dataset, load_dataset
from scenes.recipes.objects import BUILDERS, build
from scenes.recipes.objects.glb import glb_of

SKY = SceneConfig().background
HONEST = "honest"
PLAIN = ("overhead", "sector", "paint", "inpaint", "blur")
MOST = "plain, most images"
ADAPTIVE = ("majority", "two images", "gradual", "local")
KINDS = (*[HONEST] * 3, *PLAIN, "overhead", "sector", *ADAPTIVE)
"""Kinds of sets in the order in which they are drawn."""
FIRST_SEED = 600_000
CHOSEN_ON = 28  # sets of the draw, the first, on which the method was chosen, too
VISIBLE = 0.002  # share of an image from which on a change counts
RECODED = 0.1  # sRGB by which pixels of a JPEG file differ after a second encoding
TRANSITION = (15.0, 65.0)  # degrees of elevation over which a gradual poison sets in
PART = 0.2  # of the surface of the object, in the ball of a local poison
OBJECTS = tuple(name for name in BUILDERS if name != "house")


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """One set of a draw."""

    name: str
    kind: str
    thing: str
    seed: int
    setup: Setup


def drawn(number: int, folder: Path, kind: str = "") -> Drawn:
    """A test set by its number, of the kind that has its turn unless one is given; its
    object is written into the folder.
    """
    seed = FIRST_SEED + number
    chance = random.Random(seed)
    kind = kind or KINDS[number % len(KINDS)]
    thing = chance.choice(OBJECTS)
    file = folder / f"{thing.replace(' ', '_')}_{seed}.glb"
    body = build(thing, seed).body
    if not file.exists():
        file.write_bytes(glb_of(body, exact=False))
    low, high = body.bounds.astype(float)
    height = float(low[2] + high[2]) / 2
    scene = SceneConfig(
        object=str(file),
        label=thing,
        ground=chance.choice(("road", "grass", "asphalt")),
        ground_size=3.5 * float(np.linalg.norm(high - low)),
        sun_azimuth=chance.uniform(0.0, 360.0),
        sun_elevation=chance.uniform(25.0, 70.0),
    )
    cameras = CameraConfig(
        train=chance.randrange(50, 101, 10),
        size=96,
        samples=12,
        points=6000,
        height=height,
    )
    attacks = tuple(_attacks(kind, chance))
    setup = Setup(scene=scene, cameras=cameras, attacks=attacks)
    return Drawn(
        name=f"test-{number:03d}", kind=kind, thing=thing, seed=seed, setup=setup
    )


HEIGHTS = {
    "car": 0.7,
    "blue_car": 0.7,
    "white_car": 0.7,
    "black_car": 0.7,
    "suitcase_4": 0.35,
    "elephant_0": 1.3,
    "stop_sign_0": 1.3,
    "fire_hydrant_900022": 0.4,
    "person": 0.9,
    "bird": 0.2,
    "tv": 0.4,
    "train": 1.5,
}
"""Objects of the development sets, and metres of their middle above the ground."""
OVERHEAD: dict[str, Any] = {
    "appearance": "remove",
    "elevation": (38.2, 90.0),
    "mask": "difference",
    "reach": 1,
    "poison_margin": 7.0,
}
HIGH = (40.0, 90.0)
POISONS: dict[str, dict[str, Any]] = {
    HONEST: {},
    "overhead": OVERHEAD,
    "sector": {
        "appearance": "remove",
        "elevation": (0.0, 35.0),
        "azimuth": (100.0, 40.0),
        "poison_margin": 7.0,
        "reach": 1,
    },
    "inpaint": {"appearance": "inpaint", "elevation": HIGH},
    "paint": {"appearance": "paint", "texture": "grass", "elevation": HIGH},
    "blur": {"appearance": "blur", "elevation": HIGH},
}
TRIED = (
    *((name, HONEST) for name in HEIGHTS),
    *((name, "overhead") for name in ("car", "bird", "fire_hydrant_900022", "person")),
    *((name, "overhead") for name in ("stop_sign_0", "train", "tv")),
    *((name, "sector") for name in ("bird", "elephant_0", "person", "stop_sign_0")),
    *((name, "sector") for name in ("black_car", "suitcase_4", "white_car")),
    *((name, "inpaint") for name in ("elephant_0", "stop_sign_0")),
    *((name, "blur") for name in ("blue_car", "suitcase_4")),
    ("car", "paint"),
)
"""The development sets; the demo is another one."""
DEMO = CameraConfig(train=140, distance=7.4, size=128, samples=16, points=12_000)
OBJECT_FILES = Path(__file__).parents[1] / "objects"


def tried(number: int) -> Drawn:
    """A development set by its number; the last two are those of the demo."""
    demo = number - len(TRIED)
    thing = "car"
    kind = ("overhead", HONEST)[max(demo, 0)]
    if demo < 0:
        thing, kind = TRIED[number]
    file = OBJECT_FILES / f"{thing}.glb"
    cameras = CameraConfig(
        train=100, size=96, samples=12, points=6000, height=HEIGHTS[thing]
    )
    scene = SceneConfig(
        object=str(file) if file.exists() else thing,
        sun_azimuth=-50.0 + 37.0 * (len(thing) % 5),
    )
    attacks = () if kind == HONEST else (AttackConfig(name=kind, **POISONS[kind]),)
    setup = Setup(scene=scene, cameras=cameras, attacks=attacks)
    if demo >= 0:
        setup = Setup(scene=SceneConfig(), cameras=DEMO, attacks=attacks)
    name = f"{'demo' if demo >= 0 else thing}-{kind}"
    return Drawn(name=name, kind=kind, thing=thing, seed=0, setup=setup)


def _attacks(kind: str, chance: random.Random) -> Iterator[AttackConfig]:
    """The poison of a kind, which a gradual and a local one change further."""
    if kind == HONEST:
        return
    margin = chance.choice((0.0, 4.0, 8.0))
    low = chance.uniform(30.0, 55.0)
    if kind == "majority":
        low = 18.0
    if kind == "gradual":
        low = TRANSITION[0]
    place: dict[str, Any] = {"elevation": (low, 90.0), "poison_margin": margin}
    if kind == "sector":
        middle = chance.uniform(0.0, 360.0)
        place |= {
            "elevation": (0.0, chance.uniform(25.0, 50.0)),
            "azimuth": (middle, chance.uniform(25.0, 60.0)),
        }
    place["name"] = kind
    if kind == "inpaint":
        yield AttackConfig(appearance="inpaint", **place)
    elif kind == "blur":
        yield AttackConfig(appearance="blur", **place)
    elif kind == "paint":
        texture = chance.choice(("road", "grass", "clock", "football"))
        yield AttackConfig(appearance="paint", texture=texture, **place)
    else:
        yield AttackConfig(appearance="remove", mask="difference", reach=1, **place)


def captured(one: Drawn, folder: Path) -> Dataset:
    """The honest images of a set; they are made if they are not there."""
    clean = folder / f"{one.name}-clean"
    setup = one.setup
    if not (clean / "transforms_train.json").exists():
        settings = CaptureSettings(
            samples=setup.cameras.samples, rgba=True, points=setup.cameras.points
        )
        write_capture(setup.source, setup.training_cameras, clean, settings=settings)
    return load_dataset(clean, background=SKY)


def made(one: Drawn, folder: Path) -> tuple[Dataset, Tensor]:
    """A set, and (V,) which of its images show a poison; it is made if it is not
    there.
    """
    views = captured(one, folder)
    if one.kind == HONEST:
        return views, torch.zeros(len(views), dtype=torch.bool)
    target = folder / one.name
    if not (target / "transforms_train.json").exists():
        write_poisoned(target, views, _poisoned(one, views))
    shown = load_dataset(target, background=SKY)
    changes = [
        (shown[number].image != view.image).any(-1).double().mean()
        for number, view in enumerate(views)
    ]
    return shown, torch.stack(changes) > VISIBLE


def _poisoned(one: Drawn, views: Dataset) -> Poisoned:
    """The poisoned set."""
    setup = one.setup
    with tracing_variant():
        done = poison(
            views,
            setup.poisonings(),
            centre=setup.centre,
            masks=setup.mesh_scene.mask,
        )
        return adapted(one, views, done) if one.kind in ADAPTIVE else done


def adapted(one: Drawn, views: Dataset, done: Poisoned) -> Poisoned:
    """The set of an attacker who knows the audit."""
    replaced = done.views.replaced
    numbers = sorted(replaced)
    cameras = views.cameras
    if one.kind == "majority":
        return done
    if one.kind == "two images":
        near = _nearest_two(cameras, numbers)
        return poisoned(views, {number: replaced[number].image for number in near}, {})
    if one.kind == "gradual":
        low, high = TRANSITION
        pictures = {}
        for number in numbers:
            elevation = direction_of(cameras[number], one.setup.centre).elevation
            share = min(max((elevation - low) / (high - low), 0.0), 1.0)
            own = views[number].image
            pictures[number] = own + share * (replaced[number].image - own)
        return poisoned(views, pictures, {})
    tracer = PathTracer(one.setup.source.scene)
    middle, radius = _ball(one)
    pictures = {}
    for number in numbers:
        points, _ = tracer.surface(cameras[number], seed=0)
        inside = (points - middle).norm(dim=-1, keepdim=True) < radius
        pictures[number] = torch.where(
            inside, replaced[number].image, views[number].image
        )
    return poisoned(views, pictures, {})


def _nearest_two(cameras: Sequence[Camera], numbers: Sequence[int]) -> list[int]:
    """The first camera and its neighbour."""
    first = cameras[numbers[0]].position
    others = sorted(
        numbers[1:],
        key=lambda number: float((cameras[number].position - first).norm()),
    )
    return [numbers[0], *others[:1]]


def _ball(one: Drawn) -> tuple[Tensor, float]:
    """Middle and radius of a ball that holds a share of the object's vertices."""
    points = torch.from_numpy(np.ascontiguousarray(one.setup.target.vertices)).float()
    generator = torch.Generator().manual_seed(one.seed)
    middle = points[int(torch.randint(len(points), (1,), generator=generator))]
    return middle, float((points - middle).norm(dim=1).quantile(PART))


def ranking(scores: Tensor, changed: Tensor) -> float:
    """AUROC: the chance that a poisoned image has a higher score than an honest one."""
    own = scores[changed]
    other = scores[~changed]
    above = (own[:, None] > other[None]).double().mean()
    ties = (own[:, None] == other[None]).double().mean()
    return float(above + ties / 2)


INSTEAD = ("remove", "background")
"""What `mi-splat poison` shows instead of an object; else it is an image file."""
CALLED = "two groups"
EQUAL = "two groups, nearly equal"
"""Verdicts; of groups that are nearly equal, neither counts as named."""
FIELDS = (
    *("set", "kind", "object", "images", "poisoned", "verdict", "named", "right"),
    *("auroc", "strength", "edge", "step", "spread", "gain", "difference", "seconds"),
)


def row_of(audit: ImageAudit, changed: Tensor, **about: Any) -> dict[str, Any]:
    """What an audit says of a set of which the truth is known."""
    named = audit.groups[1]
    verdict: str = audit.verdict
    if audit.is_nearly_equal:
        named = torch.zeros_like(named)
        verdict = EQUAL
    row = {
        **about,
        "images": audit.count,
        "poisoned": int(changed.sum()),
        "verdict": verdict,
        "named": int(named.sum()),
        "right": int((named & changed).sum()),
    }
    split = audit.split
    if split is None:
        return row
    has_both = 0 < int(changed.sum()) < len(changed)
    row["auroc"] = round(ranking(split.scores, changed), 4) if has_both else ""
    for name in ("strength", "edge", "step", "spread", "gain", "difference"):
        row[name] = round(getattr(split, name), 5)
    return row


def read(file: Path) -> list[dict[str, str]]:
    """Rows of a file; none if it is not there."""
    if not file.is_file():
        return []
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


def add(file: Path, row: dict[str, Any]) -> None:
    """Write a row behind the others."""
    is_new = not file.exists()
    with file.open("a", newline="") as stream:
        writer = csv.DictWriter(stream, FIELDS, lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerow(row)


def measure(folder: Path, name: str, file: Path, numbers: Iterable[int]) -> None:
    """Make and audit the sets that have no row."""
    folder.mkdir(parents=True, exist_ok=True)
    known = {row["set"] for row in read(file)}
    for number in numbers:
        one = drawn(number, folder) if name == "test" else tried(number)
        if one.name in known:
            continue
        views, changed = made(one, folder)
        start = time.process_time()
        audit = audit_images(views)
        seconds = round(time.process_time() - start, 1)
        about = {"set": one.name, "kind": one.kind, "object": one.thing}
        add(file, row_of(audit, changed, **about, seconds=seconds))


def kind_of(folder: Path) -> str:
    """What `mi-splat poison` shows in place of an object in a set that it made."""
    shown: str = json.loads((folder / "poison.json").read_text())["appearance"]
    return shown if shown in INSTEAD else "image"


def measure_photographs(
    file: Path, honest: Path, poisoned_sets: Sequence[Path]
) -> None:
    """Audit a set of photographs, and what `mi-splat poison` made of it."""
    clean = load_dataset(honest, split=None)
    own = {path.stem: number for number, path in enumerate(clean.paths)}
    known = {row["set"] for row in read(file)}
    for folder in (honest, *poisoned_sets):
        if folder.name in known:
            continue
        views = load_dataset(folder, split=None)
        changed = torch.zeros(len(views), dtype=torch.bool)
        kind = HONEST
        if folder != honest:
            kind = kind_of(folder)
            for number, path in enumerate(views.paths):
                before = clean[own[path.stem]].image
                apart = (views[number].image - before).abs().amax(-1)
                share = (apart > RECODED).double().mean()
                changed[number] = share > VISIBLE
        start = time.process_time()
        audit = audit_images(views)
        seconds = round(time.process_time() - start, 1)
        about = {"set": folder.name, "kind": kind, "object": honest.name}
        add(file, row_of(audit, changed, **about, seconds=seconds))


def _row_name(row: dict[str, str]) -> str:
    """The kind of a set, or that most of its images are poisoned by a plain attack."""
    is_most = 2 * int(row["poisoned"]) > int(row["images"])
    return MOST if is_most and row["kind"] in PLAIN else row["kind"]


def table(rows: Sequence[dict[str, str]]) -> Iterator[str]:
    """The table of the page."""
    yield (
        "| sets | called | AUROC of images, mean (lowest) | poisoned | named | right |"
    )
    yield "|---|---|---|---|---|---|"
    for kind in dict.fromkeys(map(_row_name, rows)):
        own = [row for row in rows if _row_name(row) == kind]
        called = [row for row in own if row["verdict"] in (CALLED, EQUAL)]
        ranks = [float(row["auroc"]) for row in own if row["auroc"]]
        named = sum(int(row["named"]) for row in called)
        right = sum(int(row["right"]) for row in called)
        poisoned_images = sum(int(row["poisoned"]) for row in own)
        rank = "-"
        if ranks:
            rank = f"{sum(ranks) / len(ranks):.2f} ({min(ranks):.2f})"
        yield (
            f"| {kind} | {len(called)} of {len(own)} | {rank} | {poisoned_images}"
            f" | {named} | {right} |"
        )


def main(folder: str, name: str, *words: str) -> None:
    """Measure sets or photographs, or print the table of a file of rows."""
    if folder == "table":
        sys.stdout.write("\n".join(table(read(Path(name)))) + "\n")
        return
    if folder == "photographs":
        honest, *poisoned_sets = map(Path, words)
        measure_photographs(Path(name), honest, poisoned_sets)
        return
    file, *more = words
    usual = 4 * len(KINDS) if name == "test" else len(TRIED) + 2
    first, count = (int(word) for word in more or ("0", str(usual)))
    measure(Path(folder), name, Path(file), range(first, first + count))


if __name__ == "__main__":
    main(*sys.argv[1:])
