"""A kind of job: a victim trains on a set of pictures, and what it costs is written down.

The costs vary from run to run, and have no part in what the splat is. They are those of the process: its CPU time, its
largest resident memory, and on a GPU torch's largest allocation.
"""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from attacks.cloak.config import fit_config
from attacks.cloak.kinds.parts import SET, StepConfig
from attacks.cloak.kinds.rendering import settings_of
from attacks.cloak.kinds.trained import starting_cloud
from mi_splat.datasets import load_dataset
from mi_splat.errors import MiSplatError
from mi_splat.io import load_splat, save_splat
from mi_splat.io.documents import save_json
from mi_splat.rendering import Renderer, ScreenGradients
from mi_splat.training.initialization import from_points, thinned
from mi_splat.training.loop import Progress
from mi_splat.training.resume import METRICS, SPLAT, train
from mi_splat.training.state import TrainState

if TYPE_CHECKING:
    from mi_splat.ledger import Out

COST = "cost.json"
VARIES = (METRICS, COST)
_EVERY = 100
"""Steps between two looks at the memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VictimConfig(StepConfig):
    """How the victim trains, and how much it can afford.

    Attributes:
        device: "cpu" or "cuda".
        limit: No more Gaussians than this many times those of the input `clean`; None is the training's own limit.
        seconds: The training ends after so long; None is never.
        megabytes: It ends when the process has taken so much memory; None is never.
    """

    device: str = "cpu"
    limit: float | None = None
    seconds: float | None = None
    megabytes: float | None = None


class _TooMuchError(MiSplatError):
    """The victim can afford no more."""


def run(config: VictimConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Train on the `pictures`; a victim that can afford no more keeps what it has, and `COST` says so."""
    study, training = config.asked, config.asked.training
    views = load_dataset(inputs["pictures"] / SET, split="train", background=study.scene.background)
    assert views.points is not None  # a capture writes them
    cloud = starting_cloud(study, views.points, views)
    if config.limit is not None:
        most = max(1, round(config.limit * len(load_splat(inputs["clean"]))))
        training, cloud = replace(training, max_gaussians=most), thinned(cloud, most, seed=study.seeds[0])
    fit = fit_config(training)
    gradients = ScreenGradients() if fit.strategy.needs_screen_gradients else None
    variant = "cuda_ad_rgb" if config.device == "cuda" else ""
    render = Renderer(replace(settings_of(study), variant=variant), screen_gradients=gradients)
    states: list[TrainState] = []
    costs = _Costs(config)

    def after(line: Progress) -> None:
        out.progress("training", line.iteration, fit.iterations)
        costs.look(line)

    start, stopped = from_points(cloud.points, cloud.colours).to(config.device), ""
    try:
        train(
            views,
            start,
            out.partial,
            render=render,
            config=fit,
            seed=study.seeds[0],
            settings={"device": config.device},
            on_start=states.append,
            on_step=after,
        )
        for name in (SPLAT, METRICS):
            os.replace(out.partial / name, out / name)
    except _TooMuchError as error:
        stopped = str(error)
        save_splat(states[0].result(), out / SPLAT)
    went_on = states[0].iteration != costs.steps
    save_json({"stopped": stopped, "steps": states[0].iteration, **({} if went_on else costs.told())}, out / COST)


class _Costs:
    """What a training has taken of this process since this was made."""

    def __init__(self, config: VictimConfig) -> None:
        self._config, self.steps = config, 0
        self._cuda = config.device == "cuda"
        if self._cuda:
            torch.cuda.reset_peak_memory_stats()
        self._peak = peak_memory()
        self._wall, self._processor = time.monotonic(), time.process_time()

    def look(self, line: Progress) -> None:
        """Count a step."""
        self.steps += 1
        seconds, megabytes = self._config.seconds, self._config.megabytes
        if seconds is not None and time.monotonic() - self._wall > seconds:
            raise _TooMuchError(f"after {line.iteration:,} steps: more than {seconds:g} seconds")
        if megabytes is not None and line.iteration % _EVERY == 0 and self._peak() > megabytes:
            raise _TooMuchError(f"after {line.iteration:,} steps: more than {megabytes:g} MB")

    def told(self) -> dict[str, Any]:
        """The costs, in seconds and MB (1e6 bytes)."""
        told: dict[str, Any] = {
            "seconds": round(time.monotonic() - self._wall, 2),
            "cpu_seconds": round(time.process_time() - self._processor, 2),
            "peak_megabytes": round(self._peak(), 1),
        }
        if self._cuda:
            told["gpu_megabytes"] = round(torch.cuda.max_memory_allocated() / 1e6, 1)
            told["gpu"] = torch.cuda.get_device_name()
        return told


def peak_memory() -> Callable[[], float]:
    """What gives the largest resident memory of this process from now on, MB (1e6 bytes).

    On Linux the peak is forgotten first (`/proc/self/clear_refs`); elsewhere it is that since the process began.
    """
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6

    def peak() -> float:
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) * 1024 / 1e6

    return peak
