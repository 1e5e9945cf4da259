"""Makes a scene for studies of a captured splat and the mask of an object in it.

    python -m scenes.recipes.captured_scene SPLAT --mask mask.npy --object dog --set SET
    python -m scenes.recipes.captured_scene SPLAT --object person --up=-y


Writes the scene, its parts (the object, and what is around it) and `NAME_cameras.json`
with 24 cameras that are drawn by seed before any attack. With a set of photographs each
of them stands by a photograph that shows the object: its azimuth, elevation and
distance are drawn around those of the photograph, because a splat is good only where it
was photographed. Without one they stand all around, one in each sector of azimuth. All
look at the middle of the object. The object's name is the class that detectors report.
"""

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mi_splat.cameras.camera import Camera, orbit_pose, project_points
from mi_splat.cameras.directions import UP, Point, direction_of
from mi_splat.cameras.framing import bounds, near_plane
from mi_splat.cameras.lens import Lens
from mi_splat.datasets import load_dataset
from mi_splat.io.camera_records import describe
from mi_splat.io.up_axis import cameras_up
from mi_splat.maths.rotation import from_z
from mi_splat.render.renderer import RenderSettings
from mi_splat.render.scene_files import SplatScene, open_scene, write_scene
from mi_splat.scene import GaussianScene
from mi_splat.selection.select import load_mask

SEED = 1
COUNT = 24
SIDE = 640
"""Longer side of the images, pixels."""
FIELD = 50.0
"""Field of view across the longer side where no photograph says it, degrees."""
AZIMUTH = 8.0
ELEVATION = 5.0
"""How far a camera may stand from its photograph's, degrees."""
ELEVATIONS = (3.0, 25.0)
"""Where it may stand without photographs, degrees."""
DISTANCES = (0.9, 1.15)
"""Factors of the photograph's distance, or of that from which the object fits."""
AXES: dict[str, Point] = {
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "z": UP,
    "-x": (-1.0, 0.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "-z": (0.0, 0.0, -1.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Where one camera stands, seen from the object's middle."""

    azimuth: float  # degrees
    elevation: float  # degrees
    distance: float  # world units
    lens: Lens


def places_by(
    photographs: Sequence[Camera],
    centre: Point,
    up: Point,
    generator: np.random.Generator,
    *,
    side: int = SIDE,
) -> list[Place]:
    """A place by each of `COUNT` photographs that show the object's middle, in an order
    drawn by seed; where there are fewer, some have several.
    """
    showing = [camera for camera in photographs if _shows(camera, centre)]
    order = [*generator.permutation(len(showing))] * COUNT
    drawn = []
    for number in order[:COUNT]:
        camera = showing[number]
        stands = direction_of(camera, centre, up)
        away = math.dist(camera.position.tolist(), centre)
        factor = side / max(camera.width, camera.height)
        size = (round(camera.width * factor), round(camera.height * factor))
        drawn.append(
            Place(
                azimuth=stands.azimuth + float(generator.uniform(-AZIMUTH, AZIMUTH)),
                elevation=stands.elevation
                + float(generator.uniform(-ELEVATION, ELEVATION)),
                distance=away * float(generator.uniform(*DISTANCES)),
                lens=Lens(focal=camera.fx * factor, size=size),
            )
        )
    return drawn


def places_around(
    radius: float, generator: np.random.Generator, *, side: int = SIDE
) -> list[Place]:
    """A place in each of `COUNT` sectors of azimuth, from which an object of a radius
    fits into the image.
    """
    size = (side, round(side * 3 / 4))
    lens = Lens(focal=side / 2 / math.tan(math.radians(FIELD / 2)), size=size)
    fits = radius * lens.fy / (size[1] / 2)
    return [
        Place(
            azimuth=360 * (sector + float(generator.uniform())) / COUNT,
            elevation=float(generator.uniform(*ELEVATIONS)),
            distance=fits * float(generator.uniform(*DISTANCES)),
            lens=lens,
        )
        for sector in range(COUNT)
    ]


def camera_at(place: Place, centre: Point, up: Point) -> Camera:
    """The camera at a place, which looks at the object's middle."""
    pose = orbit_pose(
        centre,
        azimuth=place.azimuth,
        elevation=place.elevation,
        distance=place.distance,
    )
    camera = Camera(to_world=pose, lens=place.lens)
    if up == UP:
        return camera
    turn = from_z(torch.tensor(up))
    return camera.turned(turn, torch.tensor(centre, dtype=torch.float64))


def captured_scene(
    loaded: SplatScene,
    mask: torch.Tensor,
    name: str,
    cameras: Sequence[Camera],
    background: tuple[float, float, float],
) -> tuple[SplatScene, GaussianScene]:
    """The scene with the object's Gaussians first, as its parts."""
    order = torch.cat([mask.nonzero()[:, 0], (~mask).nonzero()[:, 0]])
    scene = loaded.scene.select(order)
    count = int(mask.sum())
    objects = {name.replace(" ", "_"): slice(0, count)}
    if count < len(scene):
        objects["surroundings"] = slice(count, len(scene))
    settings = RenderSettings(
        near=near_plane(scene, cameras),
        background=background,
        antialiased=loaded.settings.antialiased,
    )
    named = {str(number): camera for number, camera in enumerate(cameras)}
    parts = SplatScene(scene=scene, objects=objects, cameras=named, settings=settings)
    return parts, scene


def _shows(camera: Camera, centre: Point) -> bool:
    """Whether a point is in the image of a camera."""
    pixels, depth = project_points(torch.tensor([centre]).double(), camera)
    x, y = pixels[0].tolist()
    in_front = float(depth[0]) > 0
    return in_front and 0 <= x <= camera.width and 0 <= y <= camera.height


def make(options: argparse.Namespace) -> Path:
    """Write the scene and its cameras; the path of the cameras."""
    loaded = open_scene(options.splat)
    mask = torch.ones(len(loaded.scene), dtype=torch.bool)
    if options.mask is not None:
        mask = load_mask(options.mask, loaded.scene)
    centre, radius = bounds(loaded.scene.select(mask))
    generator = np.random.default_rng(options.seed)
    drawn: dict[str, Any] = {"seed": options.seed}
    if options.set is None:
        up = AXES[options.up]
        drawn |= {"elevations": ELEVATIONS, "distances": DISTANCES}
        places = places_around(radius, generator, side=options.side)
    else:
        photographs = load_dataset(options.set, split=None).cameras
        poses = np.array([one.to_world[:3, :3].numpy() for one in photographs])
        up = cameras_up(poses) or UP
        drawn |= {"azimuth": AZIMUTH, "elevation": ELEVATION, "distances": DISTANCES}
        places = places_by(photographs, centre, up, generator, side=options.side)
    cameras = [camera_at(place, centre, up) for place in places]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    parts, scene = captured_scene(
        loaded, mask, options.object, cameras, tuple(options.background)
    )
    write_scene(parts, scene, options.out)
    entries = [
        describe(
            f"{number} at {place.azimuth % 360:.0f} degrees, {place.elevation:.0f} up",
            camera,
        )
        for number, (place, camera) in enumerate(zip(places, cameras, strict=True))
    ]
    path: Path = options.out.with_name(f"{options.out.stem}_cameras.json")
    path.write_text(json.dumps({**drawn, "up": up, "cameras": entries}) + "\n")
    return path


def main() -> None:
    """Write the scene of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("splat", type=Path)
    parser.add_argument("--mask", type=Path, help="none is the whole splat")
    parser.add_argument("--object", required=True, help="class that it is")
    parser.add_argument("--set", type=Path, help="folder of the photographs")
    parser.add_argument("--up", choices=AXES, default="z", help="without --set")
    parser.add_argument("--background", type=float, nargs=3, default=(0.0, 0.0, 0.0))
    parser.add_argument("--side", type=int, default=SIDE)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--out", type=Path, required=True)
    print(make(parser.parse_args()))  # noqa: T201


if __name__ == "__main__":
    main()
