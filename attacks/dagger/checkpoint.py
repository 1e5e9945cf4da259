"""A search on disk: everything the rest of it depends on, in one safetensors file that is whole or not there."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import save

from attacks.dagger.image_budget import ImagePrice
from attacks.search import OptimiserState, Parameters, SearchState, Step
from mi_splat.errors import MiSplatError
from mi_splat.io.documents import save_bytes
from mi_splat.io.noted_tensors import NOTES, check_like, read_line, read_noted_tensors
from mi_splat.io.parsing import DocumentReader

FORMAT = 3
_POINT, _BEST, _MEMORY = "point", "best", "memory "
"""Groups of tensors; what an optimiser remembers has names of its own behind the last."""


class CheckpointError(MiSplatError):
    """A checkpoint that cannot be read, or that belongs to another attack."""


_READER = DocumentReader(expected="a checkpoint", do="delete it, or pass another name", error=CheckpointError)


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoint:
    """Where a search is kept while it runs.

    Attributes:
        path: The file; removed when the search has ended.
        every: Steps between two writings.
    """

    path: Path
    every: int = 10


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class KeptSearch:
    """A search between two steps, as its file holds it.

    Attributes:
        search: Where it is and what it remembers.
        price: Of the pictures' squared error; None where it costs nothing.
        seconds: Time spent so far.
    """

    search: SearchState
    price: ImagePrice | None
    seconds: float


def save_state(kept: KeptSearch, path: Path, *, key: str) -> None:
    """Write a search; the old checkpoint stays until the new one is on the disk."""
    state = kept.search
    remembered = {f"{_MEMORY}{name}": values for name, values in state.optimiser.tensors.items()}
    groups = {_POINT: state.point, _BEST: state.best, **remembered}
    tensors = {
        f"{group}/{name}": value.detach().contiguous().clone()
        for group, values in groups.items()
        for name, value in values.items()
    }
    notes = {
        "format": FORMAT,
        "key": key,
        "index": state.optimiser.index,
        "numbers": dict(state.optimiser.numbers),
        "best_line": None if state.best_line is None else dataclasses.asdict(state.best_line),
        "price": None if kept.price is None else dataclasses.asdict(kept.price),
        "trace": [dataclasses.asdict(line) for line in state.trace],
        "seconds": kept.seconds,
        "threads": torch.get_num_threads(),
    }
    packed = save(tensors, metadata={NOTES: json.dumps(notes)})
    save_bytes(packed, path)


def load_state(path: Path, *, key: str, device: torch.device | str = "cpu") -> KeptSearch | None:
    """Read a search; None if there is none."""
    if not path.exists():
        return None
    notes, tensors = read_noted_tensors(path, _READER)
    if notes.values.get("format") != FORMAT or notes.values.get("key") != key:
        raise _READER.broken(f"checkpoint {path}", "one of another", "one of this very attack")
    groups: dict[str, Parameters] = {}
    for key, value in tensors.items():
        group, _, name = key.partition("/")
        groups.setdefault(group, {})[name] = value.to(device)
    point, best = groups.pop(_POINT, {}), groups.pop(_BEST, {})
    check_like(best, point, f"{notes.where}, best", _READER)
    for group, memory in groups.items():
        if not group.startswith(_MEMORY):
            raise _READER.broken(notes.where, f"tensors {group}", f"{_POINT}, {_BEST} and what begins with {_MEMORY}")
        check_like(memory, point, f"{notes.where}, {group}", _READER)
    numbers = notes.object("numbers")
    line, price = notes.values.get("best_line"), notes.values.get("price")
    search = SearchState(
        point=point,
        optimiser=OptimiserState(
            index=notes.whole("index", 0, 1 << 31),
            tensors={group.removeprefix(_MEMORY): memory for group, memory in groups.items()},
            numbers={name: numbers.number(name) for name in numbers.values},
        ),
        best=best,
        best_line=None if line is None else read_line(Step, notes.object("best_line")),
        trace=tuple(read_line(Step, entry) for entry in notes.objects("trace")),
    )
    return KeptSearch(
        search=search,
        price=None if price is None else read_line(ImagePrice, notes.object("price")),
        seconds=notes.number("seconds"),
    )


def check_point(state: SearchState, reference: Parameters, steps: int) -> None:
    """Raise unless a search can go on from a state."""
    check_like(state.point, reference, "checkpoint, point", _READER)
    if state.optimiser.index > steps:
        raise _READER.broken("checkpoint, index", state.optimiser.index, f"at most {steps} steps")
