"""What a repair brings back: `python -m scenes.recipes.audit_repair CLOAKED.ply
FILE.csv IMAGE.jpg`.

CLOAKED.ply is what `docs/examples/06_cloak_in_the_file.py` writes. Each row is a splat,
a detector, and from how many views it reports the car; the image shows the view from
above, clean, attacked and repaired.
"""

import csv
import math
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from attacks import load_detector
from attacks.audits.recognition import Recognition
from attacks.detectors.base import Detector
from mi_splat import GaussianScene, Renderer, load_splat, read_scene
from mi_splat.audit import audit, repaired
from mi_splat.audit.viewpoints import lattice
from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.io.images import save_picture, side_by_side

CENTRE = torch.tensor([0.0, 0.0, 0.7])
DISTANCE = 6.5
VIEWS = 60
ABOVE = 45.0  # degrees from which the example shows the road
CONFIDENCE = 0.5
DETECTORS = ("fasterrcnn_small", "yolov8n_small")
LABEL = "car"


@dataclass(frozen=True, kw_only=True)
class Row:
    """From how many views a detector reports the car."""

    splat: str
    detector: str
    above: int
    of_above: int
    elsewhere: int
    of_elsewhere: int


def cameras() -> list[Camera]:
    """Evenly spread over the directions above the ground."""
    eyes = CENTRE + DISTANCE * lattice(VIEWS, 5.0, 88.0)
    lens = Lens(focal=290.0, size=(256, 256))
    return [
        Camera(to_world=look_at(eye.tolist(), CENTRE.tolist()), lens=lens)
        for eye in eyes
    ]


def reports(detector: Detector, image: Tensor) -> bool:
    """Whether a detector reports the car in an (H, W, 3) image."""
    (found,) = detector.detect(image[None])
    return any(
        label == LABEL and float(score) >= CONFIDENCE
        for label, score in zip(found.labels, found.scores, strict=True)
    )


def rows_of(name: str, images: list[Tensor], is_above: list[bool]) -> Iterator[Row]:
    """The rows of a splat."""
    for kind in DETECTORS:
        detector = load_detector(kind)
        seen = [reports(detector, image) for image in images]
        above = [one for one, high in zip(seen, is_above, strict=True) if high]
        rest = [one for one, high in zip(seen, is_above, strict=True) if not high]
        yield Row(
            splat=name,
            detector=kind,
            above=sum(above),
            of_above=len(above),
            elsewhere=sum(rest),
            of_elsewhere=len(rest),
        )


def main(cloaked: str, file: str, image: str) -> None:
    """Audit and repair the splat, and compare it with the clean one."""
    clean = read_scene("scenes/car_street.xml")
    attacked = load_splat(cloaked)
    again = partial(audit, recogniser=Recognition())
    done = repaired(attacked, again(attacked), again)
    sys.stdout.write(f"{done.coloured} coloured anew, {done.left_out} left out\n")
    splats: dict[str, GaussianScene] = {
        "clean": clean.scene,
        "attacked": attacked,
        "repaired": done.scene,
    }
    stands = cameras()
    least = math.sin(math.radians(ABOVE))
    heights = [float(camera.position[2] - CENTRE[2]) / DISTANCE for camera in stands]
    is_above = [height > least for height in heights]
    highest = heights.index(max(heights))
    render = Renderer(clean.settings)
    rows = list[Row]()
    shown = list[Tensor]()
    for name, splat in splats.items():
        with torch.no_grad():
            images = [render(splat, camera).clamp(0, 1) for camera in stands]
        rows += rows_of(name, images, is_above)
        shown.append(images[highest])
    save_picture(side_by_side(shown), Path(image))
    with Path(file).open("w", newline="") as stream:
        writer = csv.DictWriter(stream, asdict(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(map(asdict, rows))


if __name__ == "__main__":
    main(*sys.argv[1:])
