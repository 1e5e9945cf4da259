"""CLOAK on photographs of others: poisons a set, trains on it, and counts what
detectors miss.

    python -m scenes.recipes.real_cloak doll SET --out out/doll-cloak

`SET` is what `python -m scenes.recipes.real_captures fetch doll` writes. The settings
are those of `scenes/studies/real/cloak.toml`. Every step is a command of `mi-splat`,
which is printed; those whose result is there are not run again. The object is looked at
from all photographs, and where few are held out from cameras that took none, between
two neighbours.
"""

import argparse
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch

from attacks.detectors import load_detector
from mi_splat.cameras.camera import Camera, project_points
from mi_splat.cameras.directions import direction_of
from mi_splat.cameras.framing import bounds
from mi_splat.cli.console import show
from mi_splat.datasets import load_dataset
from mi_splat.datasets.writing import list_transforms, make_folder
from mi_splat.io import load_splat
from mi_splat.io.documents import save_png
from mi_splat.io.images import to_bytes
from mi_splat.io.parsing import read_json
from mi_splat.maths.rotation import from_matrix, to_matrix
from mi_splat.selection.select import load_mask, save_mask

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = ROOT / "scenes" / "studies" / "real" / "cloak.toml"
SURE = 0.6
IN_BOX = 0.7
MARGIN = 0.03
FAR = 2.2
VOTING_SIDE = 640
"""Least confidence of a box that votes; share of the images in which a Gaussian has to
be in it; by how much of its width it is wider; distance from the middle, in medians, of
a Gaussian that is too far away; sides of the images, pixels.
"""
FARTHEST = 40.0
"""Degrees of azimuth between two neighbours from which on there is none between."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How one capture is poisoned and judged."""

    seeds: tuple[int, ...]
    detectors: tuple[str, ...]
    iterations: int
    max_gaussians: int
    size: str
    downscale: int
    held_out_every: int
    between: int  # cameras between two neighbouring training cameras
    hide_from: tuple[str, ...]
    original: tuple[str, ...]
    voting: str  # detector whose boxes vote for the object; "" takes `select --detect`


def settings_of(capture: str) -> Settings:
    """The settings of a capture, which override those of all."""
    document: dict[str, Any] = tomllib.loads(SETTINGS.read_text())
    values = {**document, **document["captures"][capture]}
    known: dict[str, Any] = {}
    for field in fields(Settings):
        value = values[field.name]
        known[field.name] = tuple(value) if isinstance(value, list) else value
    return Settings(**known)


def run(done: Path, *words: object) -> None:
    """Run a command of mi-splat, unless what it writes is there."""
    if done.exists():
        return
    texts = [str(word) for word in words]
    show(f"$ mi-splat {shlex.join(texts)}")
    subprocess.run([sys.executable, "-m", "attacks", *texts], check=True)


def write_small(source: Path, folder: Path, settings: Settings) -> None:
    """The set with smaller images, and every n-th of them held out."""
    if (folder / "transforms.json").exists():
        return
    images = make_folder(folder / "images")
    listing: dict[str, list[tuple[str, Camera]]] = {"train": [], "test": []}
    points = None
    for split, entries in listing.items():
        views = load_dataset(
            source,
            split=split,  # type: ignore[arg-type]
            downscale=settings.downscale,
            test_every=settings.held_out_every,
        )
        points = views.points
        for index, view in enumerate(views):
            name = f"{views.paths[index].stem}.png"
            save_png(to_bytes(view.image), images / name)
            mask = views.loss_mask(index)
            if mask is not None:
                save_png(to_bytes(mask), make_folder(folder / "masks") / name)
            entries.append((name, view.camera))
    list_transforms(folder, listing, points, is_single=True)


def between(one: Camera, other: Camera, share: float) -> Camera:
    """A camera on the way from one to another, turned as far as it has gone."""
    turns = [from_matrix(camera.to_world[:3, :3]) for camera in (one, other)]
    if float((turns[0] * turns[1]).sum()) < 0:
        turns[1] = -turns[1]
    turn = torch.lerp(turns[0], turns[1], share)
    pose = one.to_world.clone()
    pose[:3, :3] = to_matrix(torch.nn.functional.normalize(turn, dim=0))
    pose[:3, 3] = torch.lerp(one.position, other.position, share)
    return Camera(to_world=pose, lens=one.lens)


def write_novel(small: Path, out: Path, centre: Sequence[float], count: int) -> None:
    """Cameras between training cameras whose azimuths are neighbours."""
    if (out / "transforms_test.json").exists():
        return
    views = load_dataset(small, split="train")
    up = load_dataset(small, split=None).up.direction
    around = [
        (direction_of(camera, centre, up).azimuth, camera) for camera in views.cameras
    ]
    around.sort(key=lambda pair: pair[0])
    pairs = list(zip(around, around[1:] + around[:1], strict=True))
    shares = [(number + 1) / (count + 1) for number in range(count)]
    cameras = [
        between(one, other, share)
        for (azimuth, one), (following, other) in pairs
        if 0 < (following - azimuth) % 360 < FARTHEST
        for share in shares
    ]
    named = [(f"novel_{number:03d}.png", one) for number, one in enumerate(cameras)]
    list_transforms(make_folder(out), {"test": named}, None)


def vote(source: Path, clean: Path, settings: Settings, file: Path) -> None:
    """The Gaussians that lie in a detector's box in most photographs, without those far
    away from the others.

    `select --detect` cuts objects out more tightly. It loses parts of objects of which
    the splat has few Gaussians, such as the car.
    """
    if file.exists():
        return
    detector = load_detector(settings.voting)
    views = load_dataset(source, split=None)
    side = max(max(camera.lens.size) for camera in views.cameras)
    views = replace(views, downscale=max(1, side // VOTING_SIDE))
    scene = load_splat(clean)
    means = scene.means.double()
    seen = torch.zeros(len(means))
    inside = torch.zeros(len(means))
    for view in views:
        with torch.no_grad():
            (report,) = detector.detect(view.image[None])
        scores = [
            float(score) if label in settings.original else 0.0
            for label, score in zip(report.labels, report.scores, strict=True)
        ]
        best = max(scores, default=0.0)
        if best < SURE:
            continue
        low, high = report.boxes[scores.index(best)].double().view(2, 2)
        margin = MARGIN * (high - low)[0]
        size = means.new_tensor([view.camera.width, view.camera.height])
        pixels, depth = project_points(means, view.camera)
        shown = (depth > 0) & ((pixels >= 0) & (pixels < size)).all(1)
        within = ((pixels >= low - margin) & (pixels <= high + margin)).all(1)
        seen += shown
        inside += shown & within
    mask = (seen >= 2) & (inside >= IN_BOX * seen)
    distances = (means - means[mask].median(dim=0).values).norm(dim=1)
    mask &= distances < FAR * distances[mask].median()
    save_mask(mask, file)


def study(
    capture: str, source: Path, mask: Path | None, out: Path, seeds: Sequence[int] = ()
) -> None:
    """Every step for one capture; with all seeds if none is given."""
    settings = settings_of(capture)
    small = out / "set"
    write_small(source, small, settings)
    training = ["--iterations", settings.iterations]
    training += ["--max-gaussians", settings.max_gaussians]
    # the held-out images of a poisoned set are clean, and must not choose the step
    training += ["--keep", "last"]
    clean = out / "clean" / "splat.ply"
    run(clean, "train", small, "--out", clean.parent, *training, "--seed", 0)
    if mask is None and settings.voting:
        mask = out / "mask.npy"
        vote(source, clean, settings, mask)
    elif mask is None:
        mask = out / "mask.npy"
        seen = ["--detect", *settings.original, "--cameras", small]
        seen += ["--detectors", *settings.detectors]
        run(mask, "select", clean, *seen, "--out", mask)
    thing = ["--mask", mask]
    poisoned = out / "poisoned"
    hiding = ["--hide-from", *settings.hide_from, "--appearance", "background"]
    run(poisoned, "poison", small, clean, *thing, *hiding, "--out", poisoned)
    record = read_json(poisoned / "poison.json")
    up = ",".join(str(value) for value in record["up"])
    scene = load_splat(clean)
    centre, _ = bounds(scene.select(load_mask(mask, scene)))
    cameras = ["--cameras", small]
    if settings.between:
        write_novel(small, out / "novel", centre, settings.between)
        cameras.append(out / "novel" / "transforms_test.json")
    for seed in seeds or settings.seeds:
        cloaked = out / f"cloaked-{seed}" / "splat.ply"
        seeded = ["--out", cloaked.parent, *training, "--seed", seed]
        run(cloaked, "train", poisoned, *seeded)
        judged = out / f"judged-{seed}"
        looked = [*cameras, "--size", settings.size, f"--up={up}"]
        called = ["--original", *settings.original]
        sector = ["--inside", *settings.hide_from, "--detectors", *settings.detectors]
        places = [*looked, *called, *sector, "--images", 8, "--out", judged]
        run(judged, "evaluate", clean, cloaked, *thing, *places)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", help="its name in cloak.toml")
    parser.add_argument("set", type=Path, help="folder of the photographs")
    parser.add_argument("--mask", type=Path, help="its Gaussians, .npy, if known")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="*", default=(), help="some of them")
    words = parser.parse_args()
    study(words.capture, words.set, words.mask, words.out, words.seeds)


if __name__ == "__main__":
    main()
