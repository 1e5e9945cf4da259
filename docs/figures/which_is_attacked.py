"""Draws docs/images/which_is_attacked.png:
`python docs/figures/which_is_attacked.py SCENE RESULT [SCENE RESULT ...]`.

Each RESULT is a folder of `mi-splat dagger --around` on SCENE. A row shows one held-out
view of the object, clean and attacked, in an order that a seed draws; the answers are
printed.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

from mi_splat.io import load_splat
from mi_splat.io.camera_records import recorded_cameras
from mi_splat.io.images import to_bytes
from mi_splat.render.renderer import Renderer
from mi_splat.render.scene_files import read_scene

OUT = Path(__file__).resolve().parents[1] / "images" / "which_is_attacked.png"
SIDE = 300
GAP = 10
MARGIN = 0.15
"""Pixels of one image and between images; share of the object's box around it."""
SEED = 20261129
LETTERS = "AB"


def crop(image: Image.Image, box: list[float]) -> Image.Image:
    """The object and a little around it, as a square."""
    left, top, right, bottom = box
    half = (0.5 + MARGIN) * max(right - left, bottom - top)
    across = (left + right) / 2
    down = (top + bottom) / 2
    corners = (across - half, down - half, across + half, down + half)
    return image.crop(corners).resize((SIDE, SIDE), Image.Resampling.LANCZOS)


def pair(scene: Path, result: Path, view: int) -> list[Image.Image]:
    """The clean and the attacked object in one held-out view."""
    loaded = read_scene(scene)
    render = Renderer(loaded.settings)
    cameras = recorded_cameras(result / "cameras.json") or {}
    camera = list(cameras.values())[view]
    box = json.loads((result / "cameras.json").read_text())["cameras"][view]["box"]
    images = []
    for splat in (loaded.scene, load_splat(result / "attacked.ply")):
        with torch.no_grad():
            image = Image.fromarray(to_bytes(render(splat, camera)))
        images.append(crop(image, box))
    return images


def main() -> None:
    """Write the figure, and print the answers."""
    generator = np.random.default_rng(SEED)
    words = [Path(word) for word in sys.argv[1:]]
    rows = []
    answers = []
    for scene, result in zip(words[::2], words[1::2], strict=True):
        images = pair(scene, result, int(generator.integers(8)))
        if generator.integers(2):
            images.reverse()
            answers.append(LETTERS[0])
        else:
            answers.append(LETTERS[1])
        rows.append(images)
    size = (2 * SIDE + GAP, len(rows) * (SIDE + GAP) - GAP)
    whole = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(whole)
    for number, images in enumerate(rows):
        for column, image in enumerate(images):
            corner = (column * (SIDE + GAP), number * (SIDE + GAP))
            whole.paste(image, corner)
            place = (corner[0] + 6, corner[1] + 4)
            draw.text(
                place,
                f"{number + 1}{LETTERS[column]}",
                fill="white",
                stroke_width=2,
                stroke_fill="black",
            )
    whole.save(OUT)
    sys.stdout.write(
        f"attacked: {', '.join(f'{n + 1}{one}' for n, one in enumerate(answers))}\n"
    )


if __name__ == "__main__":
    main()
