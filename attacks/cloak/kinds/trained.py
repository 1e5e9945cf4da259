"""A splat that a victim who knows of no attack trains on a set of images; what it
costs is written down.
"""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from attacks.cloak.config import TrainingConfig, fit_config
from attacks.cloak.setup import SET, SplatJob
from mi_splat.cameras.camera import RenderFn, View
from mi_splat.datasets import Dataset, load_dataset
from mi_splat.io import load_splat
from mi_splat.io.documents import save_json
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig
from mi_splat.training.initialization import from_points, thinned, with_outliers
from mi_splat.training.loop import Progress
from mi_splat.training.resume import METRICS, SPLAT, train

if TYPE_CHECKING:
    from mi_splat.ledger import Out

COST = "cost.json"
VARIES = (METRICS, COST)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainedConfig(SplatJob):
    """How the victim trains."""

    training: TrainingConfig
    seed: int = 0
    limit: float | None = None


def run(config: TrainedConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Train on the `pictures`, or go on; `COST` says what an uninterrupted training has
    taken.
    """
    views = load_dataset(
        inputs["pictures"] / SET, split="train", background=config.background
    )
    train_on(views, config, inputs, out)


def train_on(
    views: Dataset, config: TrainedConfig, inputs: Mapping[str, Path], out: Out
) -> None:
    """Train on some images, or go on."""
    training = config.training
    assert views.points is not None  # a capture writes them
    cloud = with_outliers(views.points, views, training.outliers, seed=config.seed)
    if config.limit is not None:
        most = max(1, round(config.limit * len(load_splat(inputs["clean"]))))
        training = replace(training, max_gaussians=most)
        cloud = thinned(cloud, most, seed=config.seed)
    fit = fit_config(training)
    costs = _Costs(config)
    start = from_points(cloud.points, cloud.colours).to(config.device)
    how = {"device": config.device}
    train_into(
        out,
        views,
        start,
        config.renderer(fit),
        fit,
        seed=config.seed,
        after=costs.add,
        settings=how,
    )
    paid = costs.as_dict() if costs.steps == fit.iterations else {}
    save_json({"steps": fit.iterations, **paid}, out / COST)


def train_into(
    out: Out,
    views: Sequence[View],
    start: GaussianScene,
    render: RenderFn,
    fit: FitConfig,
    *,
    seed: int,
    after: Callable[[Progress], None] = lambda line: None,
    settings: Mapping[str, object] | None = None,
) -> None:
    """Train a splat, or go on, and leave its file and its metrics."""

    def follow(line: Progress) -> None:
        out.progress("training", line.iteration, fit.iterations)
        after(line)

    train(
        views,
        start,
        out.partial,
        render=render,
        config=fit,
        seed=seed,
        on_step=follow,
        settings=settings,
    )
    for name in (SPLAT, METRICS):
        os.replace(out.partial / name, out / name)


class _Costs:
    """What a training has taken of this process since this was made."""

    def __init__(self, config: TrainedConfig) -> None:
        self.steps = 0
        self._cuda = config.device == "cuda"
        if self._cuda:
            torch.cuda.reset_peak_memory_stats()
        self._peak = peak_memory()
        self._wall, self._processor = time.monotonic(), time.process_time()

    def add(self, line: Progress) -> None:
        """Count a step."""
        self.steps += 1

    def as_dict(self) -> dict[str, Any]:
        """The costs, in seconds and MB (1e6 bytes)."""
        costs: dict[str, Any] = {
            "seconds": round(time.monotonic() - self._wall, 2),
            "cpu_seconds": round(time.process_time() - self._processor, 2),
            "peak_megabytes": round(self._peak(), 1),
        }
        if self._cuda:
            costs["gpu_megabytes"] = round(torch.cuda.max_memory_allocated() / 1e6, 1)
            costs["gpu"] = torch.cuda.get_device_name()
        return costs


def peak_memory() -> Callable[[], float]:
    """Gives the largest resident memory of this process, MB (1e6 bytes): from now on
    Linux, else since it began.
    """
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6

    def peak() -> float:
        lines = Path("/proc/self/status").read_text().splitlines()
        return (
            int(next(line for line in lines if line.startswith("VmHWM")).split()[1])
            * 1024
            / 1e6
        )

    return peak
