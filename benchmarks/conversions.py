"""What is left of DAGGER after its splat was converted to each format: the paper's six
pairs, as a Markdown table.

    python benchmarks/conversions.py [--seeds 1] [--image FILE]

Each attack (l2 ball of 5 over SH, 11 steps, the scene's first camera, turned and moved
a little by the seed) is made twice: on SH of degree 3, and on a scene cut to the first
coefficients before the attack. A format keeps an attack when the detector still reports
the target on the object, from the converted file, on an 8-bit image. It takes
minutes.
"""

import argparse
import dataclasses
import math
import statistics
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.detectors import load_detector
from attacks.objectives.relabel import REPORTED, relabel
from attacks.observe.drawing import annotated
from attacks.observe.views import ViewDetections, detect_views, object_boxes
from attacks.studies.attack import jittered
from mi_splat.io import load_splat
from mi_splat.io.splat_files import write_splat_file
from mi_splat.render.renderer import Renderer
from mi_splat.render.scene_files import read_scene

SCENES = Path(__file__).resolve().parent.parent / "scenes"
PAIRS = (
    ("car_street", "car", "person"),
    ("car_street", "car", "elephant"),
    ("car_street", "car", "stop sign"),
    ("stop_sign", "stop_sign", "tv"),
    ("stop_sign", "stop_sign", "train"),
    ("stop_sign", "stop_sign", "bird"),
)
"""The paper's six: scene, object, wanted class."""
CONFIG = DaggerConfig(noise_draws=0, sh_degree=None)
SUFFIXES = (".ply", ".glb", ".usdc", ".compressed.ply", ".sog", ".spz", ".splat")


def views(
    pair: tuple[str, str, str], degree: int, seed: int, folder: Path
) -> dict[str, ViewDetections] | None:
    """What the detector sees of the attacked splat from a file of each format; None if
    the attack itself fails.
    """
    name, object_name, target = pair
    loaded = read_scene(SCENES / f"{name}.xml")
    detector = load_detector("fasterrcnn_small")
    scene = loaded.scene.with_degree(degree)
    rows = loaded.objects[object_name]
    render = Renderer(loaded.settings)
    camera = jittered(
        next(iter(loaded.cameras.values())), scene.means[rows].mean(0), seed=seed
    )
    config = dataclasses.replace(CONFIG, seed=seed)
    result = attack(
        scene, rows, [camera], detector, relabel(target), render=render, config=config
    )
    if not result.success:
        return None
    boxes = object_boxes(scene, rows, [camera], render=render)
    seen = {}
    for suffix in SUFFIXES:
        write_splat_file(result.scene, folder / f"attacked{suffix}")
        again = load_splat(folder / f"attacked{suffix}")
        (seen[suffix],) = detect_views(
            again, [camera], [detector], render=render, boxes=boxes
        )
    return seen


def kept(seen: dict[str, ViewDetections], target: str) -> dict[str, tuple[bool, float]]:
    """For each format whether the target is still reported, and the PSNR beside the
    image from the PLY in dB.
    """
    figures = {}
    for suffix, view in seen.items():
        error = float((view.image - seen[".ply"].image).pow(2).mean())
        figures[suffix] = (
            view.confidence(target) >= REPORTED,
            -10 * math.log10(max(error, 1e-10)),
        )
    return figures


def draw(path: Path, folder: Path) -> None:
    """The first pair from three formats, beside each other."""
    seen = views(PAIRS[0], 3, 0, folder)
    assert seen is not None
    parts = [
        annotated(seen[name].image, seen[name].detections, name)
        for name in (".ply", ".spz", ".splat")
    ]
    Image.fromarray(np.concatenate(parts, axis=1)).save(path, quality=88)


def main() -> None:
    """Run all attacks and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument(
        "--image", type=Path, help="only draw docs/images/formats.jpg, to this file"
    )
    options = parser.parse_args()
    if options.image is not None:
        with tempfile.TemporaryDirectory() as folder:
            draw(options.image, Path(folder))
        return
    lines = [
        "| the attack may change |"
        f" {' | '.join(f'`{suffix}`' for suffix in SUFFIXES)} |"
    ]
    lines.append("|" + "---|" * (1 + len(SUFFIXES)))
    with tempfile.TemporaryDirectory() as folder:
        for degree, words in (
            (3, "all SH, degree 3"),
            (0, "the first SH coefficients, on a scene that has no others"),
        ):
            runs = [
                (pair[2], views(pair, degree, seed, Path(folder)))
                for pair in PAIRS
                for seed in range(options.seeds)
            ]
            done = [kept(seen, target) for target, seen in runs if seen is not None]
            cells = []
            for suffix in SUFFIXES:
                count = sum(run[suffix][0] for run in done)
                middle = statistics.median(run[suffix][1] for run in done)
                cells.append(
                    f"{count} of {len(done)}"
                    + (f", {middle:.0f} dB" if middle < 99 else "")
                )
            lines.append(
                f"| {words} ({len(done)} of {len(runs)} attacks succeed) |"
                f" {' | '.join(cells)} |"
            )
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
