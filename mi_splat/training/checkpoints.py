"""A training run on disk: everything the rest of it depends on, in one safetensors file that is whole or not there.

A run that is taken up again makes the bits that it would have made without the break, on the same number of threads.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor

from mi_splat import provenance
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.documents import save_bytes
from mi_splat.io.noted_tensors import NOTES, check_like, described, read_line, read_noted_tensors
from mi_splat.io.parsing import DocumentReader, Fields
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig
from mi_splat.training.state import Exposures, Progress, TrainState
from mi_splat.training.strategies import strategy_config, strategy_name

FORMAT = 3
"""Of a checkpoint: 2 named its tensors as gsplat does (`sh0`, `shN`), and held the state of any strategy; 3 knows the
pictures of a set by their bytes, and no longer by names and sizes."""
_ADAM = ("exp_avg", "exp_avg_sq", "step")
_STRATEGY, _EXPOSURES = "strategy/", "exposures/"
_MOST_VIEWS = 1 << 31


class CheckpointError(MiSplatError):
    """A checkpoint that cannot be read, or that belongs to another state."""


_READER = DocumentReader(
    expected="a checkpoint of this version", do="train anew in another folder", error=CheckpointError
)


def to_json(config: FitConfig) -> dict[str, Any]:
    """The configuration as plain values; the `kind` of a strategy is the name that it is registered under."""
    plain = asdict(config)
    strategy = {"kind": strategy_name(config.strategy), **plain["strategy"]}
    return {**plain, "strategy": strategy, "trainable": list(config.trainable)}


def from_json(plain: dict[str, Any]) -> FitConfig:
    """The inverse of `to_json`; settings that are not there have their defaults, as in a file of an older version."""
    unknown = plain.keys() - {field.name for field in fields(FitConfig)}
    if unknown:
        do = "end the run with the version that began it, or train anew in another folder"
        raise InvalidValueError.of("settings", "settings that this version knows", ", ".join(sorted(unknown)), do)
    options = dict(plain["strategy"])
    strategy = strategy_config(options.pop("kind"), **options)
    return FitConfig(**{**plain, "strategy": strategy, "trainable": tuple(plain["trainable"])})


def save_state(state: TrainState, path: Path) -> None:
    """Write a run between two steps; the old checkpoint stays until the new one is on the disk."""
    tensors = {f"parameters/{name}": value.detach() for name, value in state.parameters.items()}
    for name in state.trained:
        adam = state.optimiser.state.get(state.parameters[name], {})
        tensors |= {f"{key}/{name}": adam[key] for key in _ADAM if key in adam}
    tensors |= {f"{_STRATEGY}{name}": value for name, value in state.strategy_state.items()}
    if state.exposures is not None:
        tensors |= {f"{_EXPOSURES}{name}": value for name, value in state.exposures.tensors().items()}
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
    packed = save({k: v.contiguous() for k, v in tensors.items()}, metadata={NOTES: json.dumps(notes)})
    save_bytes(packed, path)


def load_state(path: Path) -> tuple[TrainState, int]:
    """Read a run."""
    if not path.is_file():
        raise CheckpointError.of(f"checkpoint {path}", "a file", "nothing there", "train without resuming")
    notes, tensors = read_noted_tensors(path, _READER)
    version = notes.values.get("format", 1)
    if version != FORMAT:
        expected = f"format {FORMAT}, which knows its pictures by their bytes"
        do = "end it with the version that began it, or train anew in another folder"
        raise CheckpointError.of(f"checkpoint {path}", expected, f"format {version!r:.40}", do)
    try:
        return _assemble(notes, tensors), notes.whole("threads", 1, 1 << 20)
    except InvalidValueError as error:
        written = notes.values.get("version") or "an older version"
        raise CheckpointError(f"checkpoint {path}, written by mi-splat {written}: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:  # of settings, which strategies check
        raise _READER.broken(f"checkpoint {path}", f"{type(error).__name__}: {error}") from error


def _assemble(notes: Fields, tensors: dict[str, Tensor]) -> TrainState:
    """The run in a checkpoint, every part of it checked against the others."""
    config = from_json(dict(notes.object("config").values))
    groups = _parts(tensors)
    means = groups["parameters"].get("means")
    if means is None or means.ndim != 2 or not len(means):
        raise _READER.broken(f"{notes.where}, means", described(means), "at least one row of 3 numbers")
    extent, seed = notes.number("scene_extent"), notes.whole("seed", -(1 << 63), (1 << 63) - 1)
    if not extent > 0:
        raise notes.bad("scene_extent", "a number above 0", extent)
    state = TrainState(_blank(len(means), config.sh_degree), config, scene_extent=extent, seed=seed)
    check_like(groups["parameters"], state.parameters, f"{notes.where}, parameters", _READER)
    with torch.no_grad():
        for name, value in groups["parameters"].items():
            state.parameters[name].copy_(value)
    for name in state.trained:
        adam = {key: groups[key][name] for key in _ADAM if name in groups[key]}
        if adam:
            like = state.parameters[name].detach()
            check_like(adam, dict(zip(_ADAM, (like, like, torch.zeros(())), strict=True)), notes.where, _READER)
            state.optimiser.state[state.parameters[name]] = adam
    check_like(groups["strategy"], state.strategy_state, f"{notes.where}, strategy", _READER)
    state.strategy_state = groups["strategy"]
    if config.exposure and groups["exposures"]:
        count = max(1, len(groups["exposures"].get("maps", ())))
        check_like(groups["exposures"], Exposures(count, torch.device("cpu")).tensors(), notes.where, _READER)
        state.exposures = Exposures.of(groups["exposures"], torch.device("cpu"))
    _restore(state, notes, tensors.get("generator"))
    return state


def _parts(tensors: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """The tensors of a checkpoint by what stands before the / in their names."""
    groups: dict[str, dict[str, Tensor]] = {group: {} for group in ("parameters", "strategy", "exposures", *_ADAM)}
    for key, value in tensors.items():
        group, _, name = key.partition("/")
        groups.setdefault(group, {})[name] = value
    return groups


def _blank(count: int, degree: int) -> GaussianScene:
    """A splat of `count` Gaussians, of which only the shapes are right."""
    return GaussianScene(
        torch.zeros(count, 3),
        torch.ones(count, 3),
        torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
        torch.full((count,), 0.5),
        torch.zeros(count, (degree + 1) ** 2, 3),
    )


def _restore(state: TrainState, notes: Fields, generator: Tensor | None) -> None:
    """Bring a run to where it has got to."""
    if generator is None:
        raise _READER.broken(notes.where, "none", "the state of a generator")
    check_like({"generator": generator}, {"generator": state.generator.get_state()}, notes.where, _READER)
    try:
        state.generator.set_state(generator)
    except RuntimeError as error:
        raise _READER.broken(f"{notes.where}, generator", str(error)[:100], "the state of a generator") from error
    state.settings = dict(notes.object("settings", {}).values)
    state.data_digest = notes.text("data_digest")
    state.iteration = notes.whole("iteration", 0, state.config.iterations)
    state.view_queue = notes.wholes("view_queue", 0, _MOST_VIEWS)
    state.history = [read_line(Progress, line) for line in notes.objects("history")]
