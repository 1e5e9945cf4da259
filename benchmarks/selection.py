"""How well selected Gaussians agree with outlines of the object that were drawn by hand
in some photographs of a set.

    python benchmarks/selection.py SPLAT MASK.npy SET OUTLINES.json

OUTLINES.json has polygons by the name of the photograph, without its ending: lists of
points (x, y) as fractions of the width and the height of its file.
"""

import argparse
import sys
from pathlib import Path
from statistics import mean

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from mi_splat import Renderer, load_splat
from mi_splat.cameras.framing import near_plane
from mi_splat.cli.sources import photographs
from mi_splat.datasets import load_dataset
from mi_splat.io.parsing import read_json
from mi_splat.render.renderer import RenderSettings
from mi_splat.selection.agreement import Agreement, agreement
from mi_splat.selection.regions import ImageRegion
from mi_splat.selection.select import load_mask

DRAWN = 1000
"""Pixels of the width at which polygons are drawn."""
LONGEST_SIDE = 640


def drawn(polygons: list[list[list[float]]], aspect: float) -> NDArray[np.float32]:
    """(h, w) zeros and ones, 1 inside of one of the polygons."""
    size = (DRAWN, round(DRAWN / aspect))
    image = Image.new("L", size)
    for polygon in polygons:
        corners = [(x * size[0], y * size[1]) for x, y in polygon]
        ImageDraw.Draw(image).polygon(corners, fill=1)
    return np.asarray(image, np.float32)


def main() -> None:
    """Write a row for each photograph."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("splat", "mask", "set", "outlines"):
        parser.add_argument(name, type=Path)
    options = parser.parse_args()
    scene = load_splat(options.splat)
    mask = load_mask(options.mask, scene)
    views = load_dataset(options.set, split=None)
    outlines = read_json(options.outlines)
    regions = {}
    for image in photographs(views, most=len(views), longest=LONGEST_SIDE):
        if image.name in outlines:
            width, height = image.size()
            plane = drawn(outlines[image.name], width / height)
            inside = (image.region(plane) >= 0.5).float()
            regions[image.name] = ImageRegion(camera=image.camera, inside=inside)
    render = Renderer(RenderSettings(near=near_plane(scene, views.cameras)))
    agreed = agreement(scene, mask, regions, render=render)
    iou = mean(item.iou for item in agreed.values())
    outside = mean(item.outside for item in agreed.values())
    rows = {**agreed, "mean": Agreement(iou=iou, outside=outside)}
    lines = [
        "| photograph | IoU | outside the object, % of the image |",
        "|---|---|---|",
    ]
    lines += [
        f"| {name} | {item.iou:.3f} | {100 * item.outside:.1f} |"
        for name, item in rows.items()
    ]
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
