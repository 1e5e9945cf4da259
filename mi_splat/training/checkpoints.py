"""A training run on disk: everything the rest of it depends on, in one safetensors file that is whole or not there.

A run that is taken up again makes the bits that it would have made without the break, on the same number of threads.
"""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from mi_splat import provenance
from mi_splat.errors import InvalidValueError, MiSplatError, message
from mi_splat.io.atomic import atomic_write, write_all
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig
from mi_splat.training.evaluation import Scores
from mi_splat.training.state import Progress, TrainState
from mi_splat.training.strategies import strategy_config, strategy_name

FORMAT = 3
"""Of a checkpoint: 2 named its tensors as gsplat does (`sh0`, `shN`), and held the state of any strategy; 3 knows the
pictures of a set by their bytes, and no longer by names and sizes."""
_ADAM = ("exp_avg", "exp_avg_sq", "step")
_STRATEGY = "strategy/"


class CheckpointError(MiSplatError):
    """A checkpoint that cannot be read, or that belongs to another state."""


def to_json(config: FitConfig) -> dict[str, Any]:
    """The configuration as plain values; the `kind` of a strategy is the name that it is registered under.

    Raises:
        InvalidValueError: The strategy is not registered.
    """
    plain = asdict(config)
    strategy = {"kind": strategy_name(config.strategy), **plain["strategy"]}
    return {**plain, "strategy": strategy, "trainable": list(config.trainable)}


def from_json(plain: dict[str, Any]) -> FitConfig:
    """The inverse of `to_json`; settings that are not there have their defaults, as in a file of an older version.

    Raises:
        InvalidValueError: It holds settings that this version does not know.
    """
    unknown = plain.keys() - {field.name for field in fields(FitConfig)}
    if unknown:
        do = "end the run with the version that began it, or train anew in another folder"
        known = "settings that this version knows"
        raise InvalidValueError(message("settings", known, ", ".join(sorted(unknown)), do))
    options = dict(plain["strategy"])
    strategy = strategy_config(options.pop("kind"), **options)
    return FitConfig(**{**plain, "strategy": strategy, "trainable": tuple(plain["trainable"])})


def save_state(state: TrainState, path: Path) -> None:
    """Write a run between two steps; the old checkpoint stays until the new one is on the disk.

    Raises:
        SplatFileError: the file cannot be written.
    """
    tensors = {f"parameters/{name}": value.detach() for name, value in state.parameters.items()}
    for name in state.trained:
        adam = state.optimiser.state.get(state.parameters[name], {})
        tensors |= {f"{key}/{name}": adam[key] for key in _ADAM if key in adam}
    tensors |= {f"{_STRATEGY}{name}": value for name, value in state.strategy_state.items()}
    tensors["generator"] = state.generator.get_state()
    notes = {
        "format": FORMAT,
        "config": to_json(state.config),
        "scene_extent": state.scene_extent,
        "seed": state.seed,
        "data_digest": state.data_digest,
        "iteration": state.iteration,
        "view_queue": state.view_queue,
        "settings": state.settings,
        "version": provenance.versions().get("mi-splat"),
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
            if notes.get("format", 1) != FORMAT:
                expected = f"format {FORMAT}, which knows its pictures by their bytes"
                do = "end it with the version that began it, or train anew in another folder"
                raise CheckpointError(message(f"checkpoint {path}", expected, f"format {notes.get('format', 1)}", do))
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        return _assemble(notes, tensors), notes["threads"]
    except InvalidValueError as error:
        written = notes.get("version") or "an older version"
        raise CheckpointError(f"checkpoint {path}, written by mi-splat {written}: {error}") from error
    except (SafetensorError, KeyError, TypeError, ValueError, OSError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise CheckpointError(
            message(f"checkpoint {path}", "a checkpoint of this version", reason, "train anew in another folder")
        ) from error


def _assemble(notes: dict[str, Any], tensors: dict[str, Tensor]) -> TrainState:
    config = from_json(notes["config"])
    names = ("means", "scales", "rotations", "opacities", "sh0", "shN")
    values = {name: tensors[f"parameters/{name}"] for name in names}
    count = len(values["means"])
    blank = GaussianScene(
        torch.zeros(count, 3),
        torch.ones(count, 3),
        torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
        torch.full((count,), 0.5),
        torch.zeros(count, (config.sh_degree + 1) ** 2, 3),
    )
    state = TrainState(blank, config, scene_extent=notes["scene_extent"], seed=notes["seed"])
    with torch.no_grad():
        for name, value in values.items():
            state.parameters[name].copy_(value)
    for name in state.trained:
        adam = {key: tensors[f"{key}/{name}"] for key in _ADAM if f"{key}/{name}" in tensors}
        if adam:
            state.optimiser.state[state.parameters[name]] = adam
    state.strategy_state = {
        name.removeprefix(_STRATEGY): value for name, value in tensors.items() if name.startswith(_STRATEGY)
    }
    state.settings = dict(notes.get("settings", {}))
    state.generator.set_state(tensors["generator"])
    state.history = [_line(line) for line in notes["history"]]
    state.data_digest = notes["data_digest"]
    state.iteration, state.view_queue = notes["iteration"], list(notes["view_queue"])
    return state


def _line(plain: dict[str, Any]) -> Progress:
    held_out = plain["held_out"]
    return Progress(**{**plain, "held_out": None if held_out is None else Scores(**held_out)})
