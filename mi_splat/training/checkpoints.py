"""A training run on disk: everything the rest of it depends on, in one safetensors file that is whole or not there.

A run that is taken up again makes the bits that it would have made without the break, on the same number of threads.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from mi_splat.errors import MiSplatError, message
from mi_splat.io.atomic import atomic_write, write_all
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig
from mi_splat.training.evaluation import Scores
from mi_splat.training.state import Progress, TrainState
from mi_splat.training.strategies import ClassicConfig, MCMCConfig

_KINDS: dict[str, type[ClassicConfig] | type[MCMCConfig]] = {"classic": ClassicConfig, "mcmc": MCMCConfig}
_MOMENTS = ("exp_avg", "exp_avg_sq", "step")


class CheckpointError(MiSplatError):
    """A checkpoint that cannot be read, or that belongs to another state."""


def to_json(config: FitConfig) -> dict[str, Any]:
    """The configuration as plain values; `densification` says its kind."""
    plain = asdict(config)
    for kind, form in _KINDS.items():
        if isinstance(config.densification, form):
            plain["densification"] = {"kind": kind, **plain["densification"]}
    plain["trainable"] = list(config.trainable)
    return plain


def from_json(plain: dict[str, Any]) -> FitConfig:
    """The inverse of `to_json`."""
    values = dict(plain)
    if values["densification"] is not None:
        inner = dict(values["densification"])
        values["densification"] = _KINDS[inner.pop("kind")](**inner)
    return FitConfig(**{**values, "trainable": tuple(values["trainable"])})


def save_state(state: TrainState, path: Path) -> None:
    """Write a run between two steps; the old checkpoint stays until the new one is on the disk.

    Raises:
        SplatFileError: the file cannot be written.
    """
    tensors = {f"parameters/{name}": value.detach() for name, value in state.parameters.items()}
    for name in state.trained:
        adam = state.optimiser.state.get(state.parameters[name], {})
        tensors |= {f"{key}/{name}": adam[key] for key in _MOMENTS if key in adam}
    tensors |= {"gradient": state.gradient, "visits": state.visits, "generator": state.generator.get_state()}
    notes = {
        "config": to_json(state.config),
        "extent": state.extent,
        "seed": state.seed,
        "data": state.data,
        "iteration": state.iteration,
        "queue": state.queue,
        "was_reset": state.was_reset,
        "threads": torch.get_num_threads(),
        "history": [asdict(line) for line in state.history],
    }
    packed = save({k: v.contiguous() for k, v in tensors.items()}, metadata={"notes": json.dumps(notes)})
    with atomic_write(path) as file:
        write_all(file, memoryview(packed))


def load_state(path: Path) -> tuple[TrainState, int]:
    """Read a run.

    Returns:
        The run's state, and the number of torch threads that it was made with.

    Raises:
        CheckpointError: the file is missing or is no checkpoint.
    """
    if not path.is_file():
        raise CheckpointError(message(f"checkpoint {path}", "a file", "nothing there", "train without resuming"))
    try:
        with safe_open(path, framework="pt") as file:
            notes = json.loads(file.metadata()["notes"])
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        return _assemble(notes, tensors), notes["threads"]
    except (SafetensorError, KeyError, TypeError, ValueError, OSError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise CheckpointError(
            message(f"checkpoint {path}", "a checkpoint of this version", reason, "train anew in another folder")
        ) from error


def _assemble(notes: dict[str, Any], tensors: dict[str, Tensor]) -> TrainState:
    config = from_json(notes["config"])
    names = ("means", "scales", "rotations", "opacities", "dc", "rest")
    values = {name: tensors[f"parameters/{name}"] for name in names}
    count = len(values["means"])
    blank = GaussianScene(
        torch.zeros(count, 3),
        torch.ones(count, 3),
        torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
        torch.full((count,), 0.5),
        torch.zeros(count, (config.sh_degree + 1) ** 2, 3),
    )
    state = TrainState(blank, config, extent=notes["extent"], seed=notes["seed"])
    with torch.no_grad():
        for name, value in values.items():
            state.parameters[name].copy_(value)
    for name in state.trained:
        adam = {key: tensors[f"{key}/{name}"] for key in _MOMENTS if f"{key}/{name}" in tensors}
        if adam:
            state.optimiser.state[state.parameters[name]] = adam
    state.gradient, state.visits = tensors["gradient"], tensors["visits"]
    state.generator.set_state(tensors["generator"])
    state.history = [_line(line) for line in notes["history"]]
    state.data = notes["data"]
    state.iteration, state.queue, state.was_reset = notes["iteration"], list(notes["queue"]), notes["was_reset"]
    return state


def _line(plain: dict[str, Any]) -> Progress:
    held_out = plain["held_out"]
    return Progress(**{**plain, "held_out": None if held_out is None else Scores(**held_out)})
