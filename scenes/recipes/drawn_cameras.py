"""Draws the cameras of the DAGGER study: `python -m scenes.recipes.drawn_cameras --out
scenes/cameras`.

A camera in each of 24 sectors of azimuth: its azimuth, elevation and distance are drawn
evenly, and it looks at the middle of the object. Distances are factors of that of the
scene's first camera. The car has cameras all around it. The sign has them within 60
degrees of its face, since the images that its splat was trained on reach to 62.
"""

import argparse
import json
import math
from pathlib import Path

import numpy as np

from mi_splat.cameras.camera import Camera, orbit_pose
from mi_splat.cameras.lens import Lens
from mi_splat.io.camera_records import describe
from scenes.recipes.example_scenes import FOCAL, RECIPES, SIZE

SEED = 1
COUNT = 24
ELEVATIONS = (5.0, 35.0)
DISTANCES = (0.9, 1.2)
AZIMUTHS = {"car_street": (0.0, 360.0), "stop_sign": (-60.0, 60.0)}


def cameras(name: str) -> list[tuple[str, Camera]]:
    """The cameras of an example scene, by name."""
    recipe = RECIPES[name]
    generator = np.random.default_rng(SEED)
    low, high = AZIMUTHS[name]
    unit = math.hypot(*next(iter(recipe.sensors.values())))
    drawn = []
    for sector in range(COUNT):
        share = float(generator.uniform())
        azimuth = low + (high - low) * (sector + share) / COUNT
        elevation = float(generator.uniform(*ELEVATIONS))
        factor = float(generator.uniform(*DISTANCES))
        pose = orbit_pose(
            recipe.source.centre,
            azimuth=azimuth,
            elevation=elevation,
            distance=unit * factor,
        )
        label = f"{sector} at {azimuth % 360:.0f} degrees, {elevation:.0f} up"
        drawn.append(
            (label, Camera(to_world=pose, lens=Lens(focal=FOCAL, size=(SIZE, SIZE))))
        )
    return drawn


def main() -> None:
    """Write a file for each scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("scenes/cameras"))
    out = parser.parse_args().out
    out.mkdir(exist_ok=True)
    for name, azimuths in AZIMUTHS.items():
        drawn = {
            "seed": SEED,
            "azimuths": azimuths,
            "elevations": ELEVATIONS,
            "distances": DISTANCES,
        }
        lines = ",\n".join(json.dumps(describe(*camera)) for camera in cameras(name))
        head = json.dumps(drawn).removesuffix("}")
        (out / f"{name}.json").write_text(f'{head}, "cameras": [\n{lines}\n]}}\n')


if __name__ == "__main__":
    main()
