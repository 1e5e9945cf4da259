"""What a repair brings back: `python -m scenes.recipes.audit_repair FOLDER FILE.csv`.

The splats are the car of `docs/examples/06_cloak_in_the_file.py`, if that was run, and
those of the random set that a training on poisoned images hides something in, beside a
twin that is trained on honest images. Each row is a splat, and from how many views a
detector reports the object; FOLDER gets an image of each, clean, attacked and repaired.
"""

import csv
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from attacks import load_detector
from attacks.audits.recognition import Recognition
from attacks.detectors.base import Detector
from mi_splat import GaussianScene, Renderer, RenderSettings, load_splat, read_scene
from mi_splat.audit import Audit, audit, repaired
from mi_splat.audit.viewpoints import lattice
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.framing import near_plane
from mi_splat.cameras.lens import Lens
from mi_splat.io.images import save_picture, side_by_side
from scenes.recipes.audit_set import LEAST_STRENGTH, Inside, Trained, drawn, made
from tests.audit.scenes import cone, direction

VIEWS = 60
CONFIDENCE = 0.5
DETECTORS = ("fasterrcnn_small", "yolov8n_small")
EXAMPLE = Path("out/06_cloaked.ply")
NUMBERS = (2000, 2018)
SKY = (0.55, 0.7, 0.9)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Case:
    """A splat that hides something, and what it would be without."""

    name: str
    label: str
    clean: GaussianScene
    attacked: GaussianScene
    inside: Inside  # from where it shows
    centre: Tensor
    radius: float  # of a ball that holds the object


@dataclass(frozen=True, kw_only=True)
class Row:
    """From how many views a detector reports the object."""

    file: str
    splat: str
    detector: str
    answer: str  # of the audit
    inside: int
    of_inside: int
    elsewhere: int
    of_elsewhere: int


def cases(folder: Path) -> Iterator[Case]:
    """All that hide something; what is missing of them is made."""
    if EXAMPLE.is_file():
        yield Case(
            name="CLOAK in the file",
            label="car",
            clean=read_scene("scenes/car_street.xml").scene,
            attacked=load_splat(EXAMPLE),
            inside=cone(direction(90.0, 0.0), 45.0),
            centre=torch.tensor([0.0, 0.0, 0.7]),
            radius=2.5,
        )
    for name, item in drawn(*NUMBERS):
        if not isinstance(item, Trained) or item.inside is None:
            continue
        twin = f"{name}, clean"
        made(folder, [(name, item), (twin, replace(item, inside=None))])
        about = json.loads((folder / f"{name}.json").read_text())
        if about["strength"] < LEAST_STRENGTH:
            continue
        low, high = torch.tensor(about["bounds"])
        yield Case(
            name=name,
            label=item.content,
            clean=load_splat(folder / f"{twin}.ply"),
            attacked=load_splat(folder / f"{name}.ply"),
            inside=item.inside,
            centre=(low + high) / 2,
            radius=float((high - low).norm()) / 2,
        )


def cameras(case: Case) -> tuple[list[Camera], Tensor]:
    """Cameras evenly spread over the directions above the ground, and (K,) bool, which
    stand where the attack shows.
    """
    ways = lattice(VIEWS, 8.0, 85.0)
    eyes = case.centre + 2.6 * case.radius * ways
    lens = Lens(focal=290.0, size=(256, 256))
    stands = [
        Camera(to_world=look_at(eye.tolist(), case.centre.tolist()), lens=lens)
        for eye in eyes
    ]
    return stands, case.inside(ways.float())


def reports(detector: Detector, image: Tensor, label: str) -> bool:
    """Whether a detector reports an object in an (H, W, 3) image."""
    (found,) = detector.detect(image[None])
    return any(
        name == label and float(score) >= CONFIDENCE
        for name, score in zip(found.labels, found.scores, strict=True)
    )


def images_of(case: Case, splat: GaussianScene) -> tuple[list[Tensor], Tensor]:
    """Images of a splat, and (K,) bool, which show where the attack does."""
    stands, inside = cameras(case)
    render = Renderer(
        RenderSettings(background=SKY, near=near_plane(case.clean, stands))
    )
    with torch.no_grad():
        return [render(splat, camera).clamp(0, 1) for camera in stands], inside


def rows_of(
    case: Case, splat: str, images: list[Tensor], inside: Tensor, answer: str
) -> Iterator[Row]:
    """The rows of a splat."""
    for kind in DETECTORS:
        detector = load_detector(kind)
        seen = torch.tensor([reports(detector, image, case.label) for image in images])
        yield Row(
            file=case.name,
            splat=splat,
            detector=kind,
            answer=answer,
            inside=int(seen[inside].sum()),
            of_inside=int(inside.sum()),
            elsewhere=int(seen[~inside].sum()),
            of_elsewhere=int((~inside).sum()),
        )


def measured(
    case: Case, again: Callable[[GaussianScene], Audit]
) -> tuple[list[Row], NDArray[np.uint8]]:
    """The rows of all three splats, and an image of each from inside."""
    found = again(case.attacked)
    done = repaired(case.attacked, found, again)
    splats = {
        "clean": (case.clean, again(case.clean).answer),
        "attacked": (case.attacked, found.answer),
        "repaired": (done.scene, done.audit.answer),
    }
    rows = list[Row]()
    shown = list[Tensor]()
    for name, (splat, answer) in splats.items():
        images, inside = images_of(case, splat)
        rows += rows_of(case, name, images, inside, answer)
        shown.append(images[int(inside.nonzero()[:, 0][-1])])
    return rows, side_by_side(shown)


def write(file: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write rows with the same fields as CSV."""
    with file.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def main(folder: str, file: str) -> None:
    """Audit and repair each splat, and compare it with the clean one."""
    again = partial(audit, recogniser=Recognition())
    rows = list[Row]()
    for number, case in enumerate(cases(Path(folder))):
        more, image = measured(case, again)
        rows += more
        save_picture(image, Path(folder) / f"repair-{number}.png")
        write(Path(file), list(map(asdict, rows)))


if __name__ == "__main__":
    main(*sys.argv[1:])
