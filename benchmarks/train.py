"""Training, step by step: `python benchmarks/train.py SET`, where SET is a folder as
`mi-splat capture` writes it.

Reports iterations a second, the share of time outside of the renderer, peak memory, the
number of Gaussians, and the held-out PSNR and SSIM. Compilation is timed apart: the
first steps are not counted. `--cpu` reports CPU time of one thread. `--until 34` stops
at that PSNR, looked at every 250 steps, and `--published` trains with the SH schedule
of 3DGS. `--curve` lists the PSNR every 250 steps with the seconds of the steps before,
and when it came within 0.3 dB of the last; images are read before. Photographs need
`--downscale`, and `--coarse-until 0.5` is what `mi-splat train` does.

Without a set, and beside other code: `python benchmarks/cpu_time.py benchmarks/train.py
[--against REVISION]` times a step of 20,000 Gaussians at 256 x 256, its parts, and the
loss as published, in plain torch.
"""

import argparse
import contextlib
import functools
import itertools
import json
import resource
import statistics
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from cpu_time import Clock, Run, add_cpu_flag, clock
from torch import Tensor

from mi_splat.cameras.camera import Camera, View, orbit_pose
from mi_splat.cameras.framing import near_plane
from mi_splat.cameras.lens import Lens
from mi_splat.datasets import load_dataset
from mi_splat.io import load_splat
from mi_splat.render.renderer import Renderer, RenderSettings, ScreenGradients
from mi_splat.scene import GaussianScene
from mi_splat.training.evaluation import score
from mi_splat.training.initialization import from_points
from mi_splat.training.loop import FitConfig, Progress, advance, scene_extent
from mi_splat.training.losses import photometric_loss
from mi_splat.training.state import TrainState
from mi_splat.training.strategies import STRATEGIES, FixedConfig, strategy_config

WARM_UP = 40
LOOK = 250
NEAR_ENOUGH = 0.3  # dB
CACHE = 4 << 30
"""Bytes of images in memory, so that all of a set is read once."""
CAR = Path(__file__).resolve().parent.parent / "scenes" / "car_street_car.ply"


class Point(NamedTuple):
    """Where a training has got to."""

    iteration: int
    seconds: float  # of its steps
    psnr: float  # held out, dB


def published_loss(image: Tensor, reference: Tensor) -> Tensor:
    """The loss of the code of 3DGS, operation by operation: windows of 11 x 11 and
    autograd.
    """
    taps = torch.exp(-0.5 * (torch.arange(-5, 6) / 1.5) ** 2)
    window = (
        (torch.outer(taps, taps) / taps.sum() ** 2).expand(3, 1, 11, 11).contiguous()
    )
    x, y = (picture.permute(2, 0, 1) for picture in (image, reference))
    blur = functools.partial(
        torch.nn.functional.conv2d, weight=window, padding=5, groups=3
    )
    mx = blur(x)
    my = blur(y)
    xx = blur(x * x)
    yy = blur(y * y)
    xy = blur(x * y)
    luminance = (2 * mx * my + 0.01**2) / (mx**2 + my**2 + 0.01**2)
    structure = (2 * (xy - mx * my) + 0.03**2) / (xx - mx**2 + yy - my**2 + 0.03**2)
    return 0.8 * (image - reference).abs().mean() + 0.2 * (
        1 - (luminance * structure).mean()
    )


def runs() -> dict[str, Run]:
    """A step at 20,150 Gaussians and 256 x 256, and what it consists of; for
    cpu_time.py.
    """
    car = load_splat(CAR)
    pose = orbit_pose(car.means.mean(0).tolist(), azimuth=40, elevation=20, distance=6)
    camera = Camera(to_world=pose, lens=Lens(focal=300.0, size=(256, 256)))
    render = Renderer()
    view = View(camera, render(car, camera).detach())
    noise = 0.02 * torch.randn(len(car), 3, generator=torch.Generator().manual_seed(0))
    twice = zip(
        car.tensors(), car.replace(means=car.means + noise).tensors(), strict=True
    )
    scene = GaussianScene(*(torch.cat(pair) for pair in twice))
    config = FitConfig(
        iterations=1_000_000,
        strategy=FixedConfig(),
        sh_degree_interval=0,
        eval_interval=0,
    )
    state = TrainState(scene, config, scene_extent=5.0, seed=0)
    leaves = [tensor.clone().requires_grad_(True) for tensor in scene.tensors()]
    image = render(scene, camera)
    upstream = torch.full((256, 256, 3), 1e-6)

    def step() -> None:
        with contextlib.suppress(StopIteration):
            advance(state, [view], render=render, on_step=_stop)

    def with_gradient() -> None:
        render(GaussianScene.unchecked(*leaves), camera).backward(upstream)  # type: ignore[no-untyped-call]

    def loss(of: Callable[[Tensor, Tensor], Tensor]) -> None:
        of(image.clone().requires_grad_(True), view.image).backward()  # type: ignore[no-untyped-call]

    return {
        "step": step,
        "renderer with gradient": with_gradient,
        "renderer": lambda: render(scene, camera),
        "loss with gradient": lambda: loss(photometric_loss),
        "loss as published, with gradient": lambda: loss(published_loss),
    }


def _stop(line: Progress) -> None:
    raise StopIteration


def main() -> None:
    """Train once and print what it took."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("set")
    parser.add_argument("--iterations", type=int, default=7000)
    parser.add_argument("--strategy", choices=STRATEGIES, default="classic")
    parser.add_argument("--max-gaussians", type=int, default=40_000)
    parser.add_argument("--background", type=float, nargs=3, default=(0.0, 0.0, 0.0))
    parser.add_argument("--until", type=float, help="stop at this held-out PSNR, dB")
    parser.add_argument(
        "--published",
        action="store_true",
        help="SH degrees every 1,000 steps, at a twentieth",
    )
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--coarse-until", type=float, default=0.0)
    parser.add_argument("--curve", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    add_cpu_flag(parser)
    options = parser.parse_args()
    now = clock(options.cpu)
    if options.iterations < 2 * WARM_UP:
        parser.error(
            f"--iterations: at least {2 * WARM_UP}, of which {WARM_UP} are not counted"
        )
    torch.set_num_threads(1)
    background = tuple(options.background)
    load = functools.partial(
        load_dataset,
        options.set,
        background=background,
        downscale=options.downscale,
        cache_bytes=CACHE,
    )
    views = load(split="train")
    held_out = load(split="test")
    if options.curve:
        for view in itertools.chain(views, held_out):
            del view
    if views.points is None:
        raise SystemExit("the set has no point cloud; capture it with --points")
    strategy = strategy_config(options.strategy, max_gaussians=options.max_gaussians)
    config = FitConfig(
        iterations=options.iterations,
        strategy=strategy,
        coarse_until=options.coarse_until,
        eval_interval=0,
    )
    if options.published:
        config = replace(config, sh_degree_interval=1000, lr_sh_divisor=20)
    start = from_points(views.points.points, views.points.colours)
    near = near_plane(start, views.cameras)
    settings = RenderSettings(background=background, near=near)
    render = Renderer(
        settings,
        screen_gradients=ScreenGradients() if strategy.needs_screen_gradients else None,
    )
    state = TrainState(
        start, config, scene_extent=scene_extent(views), seed=options.seed
    )
    steps: list[float] = []
    curve: list[Point] = []
    last = now()

    def after(line: Progress) -> None:
        nonlocal last
        steps.append(now() - last)
        is_wanted = options.curve or options.until is not None
        if is_wanted and line.iteration % LOOK == 0:
            found = score(state.result(), held_out, render)
            if found is None:
                raise SystemExit("no image of the set is held out")
            curve.append(Point(line.iteration, round(sum(steps), 1), found.psnr))
            if options.until is not None and found.psnr >= options.until:
                raise StopIteration
        last = now()

    with contextlib.suppress(StopIteration):
        advance(state, views, render=render, on_step=after)
    trained = state.result()
    steps = steps[WARM_UP:]
    scores = score(trained, held_out, render)
    parts = _parts(trained, views[0], render, now)
    report = {
        "strategy": options.strategy,
        "iterations": state.iteration,
        "views": len(views),
        "size": [views[0].camera.width, views[0].camera.height],
        "clock": "CPU time of one thread" if options.cpu else "wall time",
        "minutes": sum(steps) / 60 * state.iteration / max(len(steps), 1),
        "iterations_per_second": 1 / statistics.mean(steps),
        "milliseconds_median": 1000 * statistics.median(steps),
        "milliseconds_at_the_end": parts,
        "share_outside_renderer": (
            1 - (parts["forward"] + parts["backward"]) / parts["step"]
        ),
        "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "gaussians": len(trained),
        "psnr": scores and scores.psnr,
        "ssim": scores and scores.ssim,
    }
    if options.curve:
        near_the_last = [
            one for one in curve if one.psnr >= curve[-1].psnr - NEAR_ENOUGH
        ]
        report["curve"] = [one._asdict() for one in curve]
        report["within_0.3_dB_of_the_last"] = near_the_last[0]._asdict()
    json.dump(report, sys.stdout, indent=2)
    sys.stdout.write("\n")


def _parts(
    scene: GaussianScene, view: View, render: Renderer, now: Clock, *, rounds: int = 30
) -> dict[str, float]:
    """Milliseconds (medians) of a step's parts with the finished splat: renderer, loss,
    optimiser.
    """
    leaves = [tensor.clone().requires_grad_(True) for tensor in scene.tensors()]
    optimiser = torch.optim.Adam(leaves, lr=0.0, fused=True)
    rows: dict[str, list[float]] = {
        "forward": [],
        "loss": [],
        "backward": [],
        "optimiser": [],
    }
    for _ in range(rounds):
        times = [now()]
        image = render(GaussianScene.unchecked(*leaves), view.camera)
        times.append(now())
        # The loss on a leaf of its own, so that its backward pass can be told from the
        # renderer's.
        leaf = image.detach().requires_grad_(True)
        photometric_loss(leaf, view.image).backward()  # type: ignore[no-untyped-call]
        times.append(now())
        image.backward(leaf.grad)  # type: ignore[no-untyped-call]
        times.append(now())
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)
        times.append(now())
        for name, (a, b) in zip(rows, itertools.pairwise(times), strict=True):
            rows[name].append(1000 * (b - a))
    medians = {name: statistics.median(values) for name, values in rows.items()}
    return {**medians, "step": sum(medians.values())}


if __name__ == "__main__":
    main()
