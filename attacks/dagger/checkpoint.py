"""A search on disk: everything the rest of it depends on, in one safetensors file that is whole or not there."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import save

from attacks.dagger.eot.image_budget import ImagePrice
from attacks.optimisers import OptimiserState
from attacks.pgd import Parameters, Step
from mi_splat.errors import MiSplatError
from mi_splat.io.atomic import atomic_write, write_all
from mi_splat.io.noted_tensors import NOTES, check_like, read_line, read_noted_tensors
from mi_splat.io.parsing import DocumentReader

FORMAT = 2
_GROUPS = ("point", "velocity", "square", "best")


class CheckpointError(MiSplatError):
    """A checkpoint that cannot be read, or that belongs to another attack."""


_READER = DocumentReader(expected="a checkpoint", do="delete it, or pass another name", error=CheckpointError)


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
    packed = save(tensors, metadata={NOTES: json.dumps(notes)})
    with atomic_write(path) as file:
        write_all(file, memoryview(packed))


def load_state(path: Path, *, key: str) -> SearchState | None:
    """Read a search; None if there is none.

    Args:
        path: The file.
        key: What tells this attack from others.

    Raises:
        CheckpointError: The file is no checkpoint, or one of another attack; or a part of it does not fit the others.
    """
    if not path.exists():
        return None
    notes, tensors = read_noted_tensors(path, _READER)
    if notes.values.get("format") != FORMAT or notes.values.get("key") != key:
        raise _READER.broken(f"checkpoint {path}", "one of another", "one of this very attack")
    point, velocity, square, best = (
        {name.partition("/")[2]: value for name, value in tensors.items() if name.startswith(f"{group}/")}
        for group in _GROUPS
    )
    check_like(best, point, f"{notes.where}, best", _READER)
    for group, memory in (("velocity", velocity), ("square", square)):
        if memory:  # nothing before the first step, or where nothing needs it
            check_like(memory, point, f"{notes.where}, {group}", _READER)
    line, price = notes.values.get("best_line"), notes.values.get("price")
    return SearchState(
        point=point,
        optimiser=OptimiserState(index=notes.whole("index", 0, 1 << 31), velocity=velocity, square=square),
        best=best,
        best_line=None if line is None else read_line(Step, notes.object("best_line")),
        price=None if price is None else read_line(ImagePrice, notes.object("price")),
        trace=tuple(read_line(Step, one) for one in notes.objects("trace")),
        seconds=notes.number("seconds"),
    )


def check_point(state: SearchState, reference: Parameters, steps: int) -> None:
    """Raise unless a search can go on from a state.

    Args:
        state: Of a checkpoint.
        reference: What is attacked.
        steps: Of the whole search.

    Raises:
        CheckpointError: It is at a point of another kind, or has done more steps.
    """
    check_like(state.point, reference, "checkpoint, point", _READER)
    if state.optimiser.index > steps:
        raise _READER.broken("checkpoint, index", state.optimiser.index, f"at most {steps} steps")
