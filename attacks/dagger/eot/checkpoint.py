"""A search on disk: everything the rest of it depends on, in one safetensors file that is whole or not there."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from attacks.dagger.eot.image_budget import ImagePrice
from attacks.optimisers import OptimiserState
from attacks.pgd import Parameters, Step
from mi_splat.errors import MiSplatError, message
from mi_splat.io.atomic import atomic_write, write_all

FORMAT = 2
_GROUPS = ("point", "velocity", "square", "best")


class CheckpointError(MiSplatError):
    """A checkpoint that cannot be read, or that belongs to another attack."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SearchState:
    """A search between two steps.

    Attributes:
        point: Where it is.
        optimiser: What the optimiser remembers; its index is the number of steps done.
        best: The best point so far; `point` before anything was judged.
        best_line: Its line of the trace; None before anything was judged.
        price: Of the pictures' squared error; None where it costs nothing.
        trace: Every point before `point`.
        seconds: Time spent so far.
    """

    point: Parameters
    optimiser: OptimiserState
    best: Parameters
    best_line: Step | None
    price: ImagePrice | None
    trace: tuple[Step, ...]
    seconds: float


def save_state(state: SearchState, path: Path, *, key: str) -> None:
    """Write a search; the old checkpoint stays until the new one is on the disk.

    Args:
        state: The search.
        path: The file.
        key: What tells this attack from others.

    Raises:
        SplatFileError: The file cannot be written.
    """
    groups = (state.point, state.optimiser.velocity, state.optimiser.square, state.best)
    tensors = {
        f"{group}/{name}": value.detach().contiguous().clone()
        for group, values in zip(_GROUPS, groups, strict=True)
        for name, value in values.items()
    }
    notes = {
        "format": FORMAT,
        "key": key,
        "index": state.optimiser.index,
        "best_line": None if state.best_line is None else dataclasses.asdict(state.best_line),
        "price": None if state.price is None else dataclasses.asdict(state.price),
        "trace": [dataclasses.asdict(line) for line in state.trace],
        "seconds": state.seconds,
        "threads": torch.get_num_threads(),
    }
    packed = save(tensors, metadata={"notes": json.dumps(notes)})
    with atomic_write(path) as file:
        write_all(file, memoryview(packed))


def load_state(path: Path, *, key: str) -> SearchState | None:
    """Read a search; None if there is none.

    Args:
        path: The file.
        key: What tells this attack from others.

    Raises:
        CheckpointError: The file is no checkpoint, or one of another attack.
    """
    if not path.exists():
        return None
    what, do = f"checkpoint {path}", "delete it, or pass another name"
    try:
        with safe_open(path, framework="pt") as file:
            notes: dict[str, Any] = json.loads(file.metadata()["notes"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if notes["format"] != FORMAT or notes["key"] != key:
            raise CheckpointError(message(what, "one of this very attack", "one of another", do))
        point, velocity, square, best = (
            {name.partition("/")[2]: value for name, value in tensors.items() if name.startswith(f"{group}/")}
            for group in _GROUPS
        )
        line, price = notes["best_line"], notes["price"]
        return SearchState(
            point=point,
            optimiser=OptimiserState(index=notes["index"], velocity=velocity, square=square),
            best=best,
            best_line=None if line is None else Step(**line),
            price=None if price is None else ImagePrice(**price),
            trace=tuple(Step(**one) for one in notes["trace"]),
            seconds=notes["seconds"],
        )
    except (SafetensorError, KeyError, TypeError, ValueError, OSError) as error:
        raise CheckpointError(message(what, "a checkpoint", f"{type(error).__name__}: {error}", do)) from error
