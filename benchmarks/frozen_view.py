"""How much faster is a step of a `FrozenView` than one of `Renderer`?

A step is an image and the gradient of its SH.

    python benchmarks/frozen_view.py [--rounds 15] [--json]

The same splat, camera and process for both; each runs four times before it is timed,
and the runs are interleaved, since a shared machine changes its speed within minutes.
Reported are the medians over the rounds of the times, of the ratio within a round, and
of that of the processor's time of all threads, which other programs disturb less.
`make` is what making the view takes once it is compiled, in steps of `Renderer`.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from render import shell

from mi_splat.cameras.camera import Camera, orbit_pose
from mi_splat.cameras.lens import Lens
from mi_splat.render import variant
from mi_splat.render.frozen_view import FrozenView
from mi_splat.render.renderer import Renderer
from mi_splat.scene import GaussianScene

SETTINGS = (
    (10_000, 256, 1.0),
    (100_000, 256, 1.0),
    (100_000, 640, 1.0),
    (100_000, 640, 0.2),
)


def step(
    render: Callable[[torch.Tensor], torch.Tensor], sh: torch.Tensor, camera: Camera
) -> Callable[[], None]:
    """An image and its gradient of SH, for a random linear function of the image."""
    weights = torch.randn(
        camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1)
    )
    leaf = sh.clone().requires_grad_(True)

    def run() -> None:
        leaf.grad = None
        (render(leaf) * weights).sum().backward()  # type: ignore[no-untyped-call]

    return run


def seconds(run: Callable[[], object]) -> tuple[float, float]:
    """Wall time and processor time of one run."""
    wall = time.perf_counter()
    processor = time.process_time()
    run()
    return time.perf_counter() - wall, time.process_time() - processor


def measure(count: int, size: int, share: float, rounds: int) -> dict[str, Any]:
    """Median times in ms and the median of their ratios, with this share of the
    Gaussians free: the highest ones.
    """
    scene = shell(count)
    pose = orbit_pose((0.0, 0.0, 0.0), azimuth=30.0, elevation=20.0, distance=3.0)
    camera = Camera(to_world=pose, lens=Lens(focal=float(size), size=(size, size)))
    if share == 1:
        rows = None
    else:
        rows = scene.means[:, 2] >= scene.means[:, 2].quantile(1 - share)
    render = Renderer()
    view = FrozenView(scene, camera, rows=rows)
    fixed = scene.tensors()[:4]
    runs = (
        step(
            lambda sh: render(GaussianScene.unchecked(*fixed, sh), camera),
            scene.sh,
            camera,
        ),
        step(view, scene.sh[view.rows], camera),
        lambda: FrozenView(scene, camera, rows=rows),
    )
    for run in runs:
        for _ in range(4):
            run()
    times = [[seconds(run) for run in runs] for _ in range(rounds)]
    renderer, frozen, _ = (
        round(1e3 * statistics.median(t[0] for t in column), 2)
        for column in zip(*times, strict=True)
    )
    ratios = [
        round(statistics.median(whole[k] / part[k] for whole, part, _ in times), 2)
        for k in range(2)
    ]
    return {
        "gaussians": count,
        "size": size,
        "free": share,
        "Renderer": renderer,
        "FrozenView": frozen,
        "ratio": ratios[0],
        "processor ratio": ratios[1],
        "make": round(
            statistics.median(make[0] / whole[0] for whole, _, make in times), 2
        ),
        "megabytes": round(view.megabytes, 1),
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Time FrozenView beside Renderer.")
    parser.add_argument(
        "--rounds", type=int, default=15, help="interleaved runs of everything"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # torch's threads and Dr.Jit's would fight over the cores
    variant.use()
    rows = [measure(*setting, arguments.rounds) for setting in SETTINGS]
    if arguments.json:
        print(json.dumps(rows, indent=2))  # noqa: T201
        return
    for row in rows:
        print(  # noqa: T201
            f"{row['gaussians']:>7,} at {row['size']}, {row['free']:.0%} free: Renderer"
            f" {row['Renderer']:.1f} ms, FrozenView {row['FrozenView']:.1f} ms,"
            f" {row['ratio']:.1f}x (processor {row['processor ratio']:.1f}x); make"
            f" {row['make']:.1f} steps, {row['megabytes']:.1f} MB"
        )


if __name__ == "__main__":
    main()
