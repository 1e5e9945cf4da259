"""How much faster are attacks on colours with frozen views?

A step of DAGGER, and of the training of layers' colours.

    python benchmarks/frozen_attacks.py [--rounds 15] [--cpu] [--json]

With and without frozen views in one process and in turn; a shared machine changes its
speed within minutes. Without them the renderer is wrapped in another function, of which
the library cannot know what it does. Reported are the medians over the rounds of the
times and of the ratio within a round. DAGGER: the car of scenes/car_street.xml from its
first camera, with a detector and with one that looks at the mean colour alone. Layers:
a sphere of Gaussians from all around, of which all or the upper ones are trained.
"""

import argparse
import contextlib
import dataclasses
import functools
import json
import statistics
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from cpu_time import Clock, Run, add_cpu_flag, clock, interleaved, ratio
from render import shell

from attacks.cloak.layers import Layering
from attacks.dagger.attack import problem_of
from attacks.dagger.config import DaggerConfig
from attacks.dagger.views import FixedViews
from attacks.detectors.base import Candidates, Detections, Detector
from attacks.detectors.registry import as_detectors
from attacks.objectives.suppression import untargeted
from mi_splat import read_scene
from mi_splat.cameras.camera import Camera, RenderFn, View, orbit_pose
from mi_splat.cameras.lens import Lens
from mi_splat.render import variant
from mi_splat.render.renderer import Renderer
from mi_splat.training.config import FitConfig
from mi_splat.training.loop import advance, scene_extent
from mi_splat.training.state import Progress, TrainState
from mi_splat.training.strategies import FixedConfig

SCENE = Path(__file__).resolve().parent.parent / "scenes" / "car_street.xml"
LAYERS = ((20_000, 0.4), (20_000, 1.0))
SIZE = 256
CAMERAS = 60


class MeanColour:
    """A detector that costs next to nothing, so that the time of a step is that of the
    pictures.
    """

    name = "mean_colour"
    fingerprint = "0" * 16
    min_confidence = 0.05
    classes = ("car", "person")

    def candidates(self, images: Tensor) -> list[Candidates]:
        """One box a class over the whole picture."""
        size = torch.tensor([0.0, 0.0, images.shape[2], images.shape[1]])
        return [
            Candidates(size.expand(1, 2, 4), image.mean((0, 1))[None, :2])
            for image in images
        ]

    def detect(self, images: Tensor) -> list[Detections]:
        """Nothing."""
        return [Detections(torch.zeros(0, 4), torch.zeros(0), ()) for _ in images]


def other(render: Renderer) -> RenderFn:
    """The same pictures by a function of which nothing is known."""
    return lambda scene, camera: render(scene, camera)


def compare(without: Run, frozen: Run, rounds: int, now: Clock) -> dict[str, Any]:
    """Median times in ms and the median of their ratios."""
    times = interleaved({"before": without, "after": frozen}, rounds=rounds, now=now)
    medians = {
        name: round(1e3 * statistics.median(values), 1)
        for name, values in times.items()
    }
    return {**medians, "ratio": round(ratio(times["before"], times["after"]), 2)}


def dagger(detector: Detector, rounds: int, now: Clock) -> dict[str, Any]:
    """One step: a picture, what the detector makes of it, and the gradient of SH."""
    loaded = read_scene(SCENE)
    camera = next(iter(loaded.cameras.values()))
    config = DaggerConfig(sh_degree=None)
    runs = []
    for render in (other(Renderer(loaded.settings)), Renderer(loaded.settings)):
        views = FixedViews(loaded.scene, loaded.objects["car"], camera, render=render)
        problem = problem_of(views, (detector,), untargeted(), config)
        problem = dataclasses.replace(problem, frozen=views.frozen(config))
        clean = problem.subset.parameters(config.attributes)
        runs.append(
            functools.partial(problem.evaluate, clean, views.held_out(config), config)
        )
    without, frozen = runs
    return {"what": f"DAGGER, {detector.name}", **compare(without, frozen, rounds, now)}


def layers(count: int, share: float, rounds: int, now: Clock) -> dict[str, Any]:
    """One step of training: a picture, its loss, the gradient of SH and a step of Adam.

    `make`: the first, seconds.
    """
    scene = shell(count)
    render = Renderer()
    poses = [
        orbit_pose((0.0, 0.0, 0.0), azimuth=222.5 * k, elevation=5.0 + k, distance=3.0)
        for k in range(CAMERAS)
    ]
    cameras = [
        Camera(to_world=pose, lens=Lens(focal=float(SIZE), size=(SIZE, SIZE)))
        for pose in poses
    ]
    painted = scene.replace(
        sh=scene.sh
        + 0.1 * torch.randn(scene.sh.shape, generator=torch.Generator().manual_seed(0))
    )
    with torch.no_grad():
        views = [
            View(camera, render(painted, camera).clamp(0, 1)) for camera in cameras
        ]
    height = scene.means[:, 2]
    trained = height >= height.quantile(1 - share)
    config = FitConfig(
        iterations=3000,
        trainable=("sh",),
        strategy=FixedConfig(),
        sh_degree_interval=0,
        lr_sh=0.04,
        lr_sh_divisor=20,
    )
    layering = Layering(
        scene=scene, trained=trained, views=views, iterations=config.iterations
    )
    without, frozen = (
        training(layering, config, renderer) for renderer in (other(render), render)
    )
    begun = now()
    frozen()
    made = now() - begun
    return {
        "what": f"layers, {count:,} Gaussians, {share:.0%} trained",
        **compare(without, frozen, rounds, now),
        "make": round(made, 1),
    }


def training(
    layering: Layering, config: FitConfig, render: RenderFn
) -> Callable[[], None]:
    """A run that takes one step each time that it is called."""
    state = TrainState(
        layering.scene, config, scene_extent=scene_extent(layering.views), seed=0
    )
    rendered = layering.rendered_by(render)

    class _OneStep(Exception):  # noqa: N818
        pass

    def stop(_: Progress) -> None:
        raise _OneStep

    def step() -> None:
        with contextlib.suppress(_OneStep):
            advance(state, layering.views, render=rendered, on_step=stop)

    return step


def measure(detectors: Sequence[str], rounds: int, now: Clock) -> list[dict[str, Any]]:
    """All rows."""
    outcomes = [
        dagger(detector, rounds, now)
        for detector in (MeanColour(), *as_detectors(detectors))
    ]
    return outcomes + [layers(*setting, rounds, now) for setting in LAYERS]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description="Time attacks on colours with frozen views beside those without."
    )
    parser.add_argument(
        "--rounds", type=int, default=15, help="interleaved runs of everything"
    )
    parser.add_argument(
        "--detectors", nargs="+", default=["fasterrcnn_small"], help="for DAGGER"
    )
    add_cpu_flag(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # torch's threads and Dr.Jit's would fight over the cores
    variant.use()
    rows = measure(arguments.detectors, arguments.rounds, clock(arguments.cpu))
    if arguments.json:
        print(json.dumps(rows, indent=2))  # noqa: T201
        return
    for row in rows:
        made = f"; making all views {row['make']:.1f} s" if "make" in row else ""
        print(  # noqa: T201
            f"{row['what']}: {row['before']} ms, frozen {row['after']} ms,"
            f" {row['ratio']}x{made}"
        )


if __name__ == "__main__":
    main()
