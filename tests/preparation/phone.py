"""Photographs as a phone takes them, made of renderings: a lens that bends, both
orientations, a mask.

`python -m tests.preparation.phone FOLDER` writes 30 of them.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import ExifTags, Image

from mi_splat.cameras.camera import Camera
from mi_splat.cameras.framing import bounds, near_plane
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import camera_set
from mi_splat.datasets.frames import turned_clockwise
from mi_splat.datasets.lenses import ImageLens
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import open_scene
from tests.project.layers import ROOT

COUNT = 30
SIZE = (800, 600)
SCENE = ROOT / "scenes" / "car_street.xml"
DISTORTION = (-0.08,)
FOCAL_35MM = 28
"""Millimetres, as a phone writes it."""
MASKED = 3
"""Number of the photograph in which somebody walks by."""
DISTANCE = 7.0
"""From the car, world units."""
_MARGIN = 1.4
"""How much wider than a photograph the rendering is of which it is made."""


def lens() -> ImageLens:
    """The lens of the phone."""
    width, height = SIZE
    focal = FOCAL_35MM / np.hypot(36, 24) * np.hypot(width, height)
    return ImageLens(
        focal=(focal, focal),
        principal=(width / 2, height / 2),
        size=SIZE,
        distortion=DISTORTION,
    )


def photograph(render: Renderer, scene: object, pose: torch.Tensor) -> np.ndarray:
    """(H, W, 3) bytes of a photograph as the phone's sensor has it."""
    import cv2

    bent = lens()
    width, height = (round(_MARGIN * side) for side in SIZE)
    camera = Camera(to_world=pose, lens=Lens(focal=bent.focal, size=(width, height)))
    image = render(scene, camera)[..., :3].clamp(0, 1).numpy()  # type: ignore[arg-type]
    columns, rows = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = bent.rays(np.stack([columns.ravel(), rows.ravel()], 1))
    assert len(rays) == columns.size  # every pixel sees something
    places = rays * bent.focal + np.array([camera.cx, camera.cy]) - 0.5
    across, down = (
        places[:, axis].reshape(columns.shape).astype(np.float32) for axis in (0, 1)
    )
    seen = cv2.remap(image, across, down, cv2.INTER_LINEAR)
    return (np.clip(seen, 0, 1) * 255).round().astype(np.uint8)


def write_photographs(folder: Path, *, count: int = COUNT) -> None:
    """Write photographs, every second one of which was taken with the phone held
    upright, and a mask.
    """
    loaded = open_scene(SCENE)
    middle, _ = bounds(loaded.scene.select(loaded.objects["car"]))
    cameras = camera_set(
        f"orbit:{count}@25",
        middle,
        distance=DISTANCE,
        lens=Lens(focal=500.0, size=SIZE),
    )
    settings = RenderSettings(
        background=(0.5, 0.6, 0.8), near=near_plane(loaded.scene, tuple(cameras))
    )
    render = Renderer(settings)
    folder.mkdir(parents=True)
    for number, camera in enumerate(cameras):
        is_upright = number % 2 == 1
        # Held upright, the sensor lies on its side, and EXIF says how to turn what it
        # has seen.
        pose = turned_clockwise(camera, 3).to_world if is_upright else camera.to_world
        pixels = photograph(render, loaded.scene, pose)
        if number == MASKED:
            pixels[80:500, 250:350] = (200, 40, 160)
            mask = np.full(pixels.shape[:2], 255, np.uint8)
            mask[80:500, 250:350] = 0
            (folder / "masks").mkdir()
            Image.fromarray(mask).save(folder / "masks" / f"IMG_{number:04d}.JPG.png")
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = 6 if is_upright else 1
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = (
            FOCAL_35MM
        )
        Image.fromarray(pixels).save(
            folder / f"IMG_{number:04d}.JPG", quality=95, exif=exif
        )


if __name__ == "__main__":
    write_photographs(Path(sys.argv[1]))
