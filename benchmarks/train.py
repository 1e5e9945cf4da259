"""Training, step by step: `python benchmarks/train.py SET`, where SET is a folder as `mi-splat capture` writes it.

Reports iterations a second, the share of time outside of the renderer, peak memory, the number of Gaussians, and the
held-out PSNR and SSIM. Compilation is timed apart: the first steps are not counted.
"""

from __future__ import annotations

import argparse
import itertools
import json
import resource
import statistics
import sys
import time

import torch

from mi_splat.cameras import View
from mi_splat.datasets import has_tests, load_dataset
from mi_splat.rendering import Renderer, RenderSettings, ScreenGradients
from mi_splat.scene import GaussianScene
from mi_splat.training.evaluation import score
from mi_splat.training.initialization import from_points
from mi_splat.training.loop import FitConfig, Progress, fit
from mi_splat.training.losses import photometric_loss
from mi_splat.training.strategies import strategy_config, strategy_names

WARM_UP = 40


def main() -> None:
    """Train once and print what it took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set")
    parser.add_argument("--iterations", type=int, default=7000)
    parser.add_argument("--strategy", choices=strategy_names(), default="classic")
    parser.add_argument("--max-gaussians", type=int, default=40_000)
    parser.add_argument("--background", type=float, nargs=3, default=(0.0, 0.0, 0.0))
    options = parser.parse_args()
    if options.iterations < 2 * WARM_UP:
        parser.error(f"--iterations: at least {2 * WARM_UP}, of which {WARM_UP} are not counted")
    torch.set_num_threads(1)
    background = tuple(options.background)
    views = load_dataset(options.set, split="train", background=background)
    held_out = load_dataset(options.set, split="test", background=background) if has_tests(options.set) else ()
    if views.points is None:
        raise SystemExit("the set has no point cloud; capture it with --points")
    strategy = strategy_config(options.strategy, max_gaussians=options.max_gaussians)
    config = FitConfig(iterations=options.iterations, strategy=strategy, eval_interval=0)
    settings = RenderSettings(background=background)
    render = Renderer(settings, screen_gradients=ScreenGradients() if strategy.needs_screen_gradients else None)
    start = from_points(views.points.points, views.points.colours)
    stamps: list[float] = []

    def after(line: Progress) -> None:
        stamps.append(time.perf_counter())

    found = fit(views, start, render=render, config=config, on_step=after)
    steps = [b - a for a, b in zip(stamps[WARM_UP:], stamps[WARM_UP + 1 :], strict=False)]
    scores = score(found.scene, held_out, render)
    parts = _parts(found.scene, views[0], render)
    report = {
        "strategy": options.strategy,
        "iterations": options.iterations,
        "views": len(views),
        "size": [views[0].camera.width, views[0].camera.height],
        "minutes": sum(steps) / 60 * options.iterations / max(len(steps), 1),
        "iterations_per_second": 1 / statistics.mean(steps),
        "milliseconds_median": 1000 * statistics.median(steps),
        "milliseconds_at_the_end": parts,
        "share_outside_renderer": 1 - (parts["forward"] + parts["backward"]) / parts["step"],
        "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "gaussians": len(found.scene),
        "psnr": scores and scores.psnr,
        "ssim": scores and scores.ssim,
    }
    json.dump(report, sys.stdout, indent=2)
    sys.stdout.write("\n")


def _parts(scene: GaussianScene, view: View, render: Renderer, *, rounds: int = 30) -> dict[str, float]:
    """Milliseconds (medians) of a step's parts with the finished splat: renderer, loss, optimiser."""
    leaves = [tensor.clone().requires_grad_(True) for tensor in scene.tensors()]
    optimiser = torch.optim.Adam(leaves, lr=0.0, fused=True)
    rows: dict[str, list[float]] = {"forward": [], "loss": [], "backward": [], "optimiser": []}
    for _ in range(rounds):
        times = [time.perf_counter()]
        image = render(GaussianScene.unchecked(*leaves), view.camera)
        times.append(time.perf_counter())
        # The loss on a leaf of its own, so that its backward pass can be told from the renderer's.
        leaf = image.detach().requires_grad_(True)
        photometric_loss(leaf, view.image).backward()  # type: ignore[no-untyped-call]
        times.append(time.perf_counter())
        image.backward(leaf.grad)  # type: ignore[no-untyped-call]
        times.append(time.perf_counter())
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)
        times.append(time.perf_counter())
        for name, (a, b) in zip(rows, itertools.pairwise(times), strict=True):
            rows[name].append(1000 * (b - a))
    medians = {name: statistics.median(values) for name, values in rows.items()}
    return {**medians, "step": sum(medians.values())}


if __name__ == "__main__":
    main()
