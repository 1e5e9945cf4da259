"""Checkpoints: safetensors files with notes as JSON, read with distrust."""

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from mi_splat.errors import InvalidValueError
from mi_splat.fields import decode
from mi_splat.io.parsing import DocumentReader, Fields

NOTES = "notes"
"""Key of the notes among a file's metadata."""

_Line = TypeVar("_Line")


def read_noted_tensors(
    path: Path, reader: DocumentReader
) -> tuple[Fields, dict[str, Tensor]]:
    """The notes and the tensors of a checkpoint, all of them of finite numbers."""
    what = f"checkpoint {path}"
    try:
        with safe_open(path, framework="pt") as file:
            metadata: dict[str, str] = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, TypeError, RuntimeError) as error:
        raise reader.broken(what, str(error)[:160] or type(error).__name__) from error
    if NOTES not in metadata:
        raise reader.broken(what, "one without notes")
    notes = reader.json_object(metadata[NOTES].encode(), f"{what}, notes")
    name = not_finite(tensors)
    if name:
        raise reader.broken(what, "others", f"finite numbers in {name}")
    return Fields(notes, what, reader.error, reader.do), tensors


def not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """Name of the first tensor that has a number which is not finite; None if there is
    none.
    """
    for name, value in tensors.items():
        if (value.is_floating_point() or value.is_complex()) and not bool(
            torch.isfinite(value.float()).all()
        ):
            return name
    return None


def check_like(
    tensors: Mapping[str, Tensor],
    wanted: Mapping[str, Tensor],
    what: str,
    reader: DocumentReader,
) -> None:
    """Raise unless some tensors have the names, shapes and kinds of numbers of
    others.
    """
    for name, value in wanted.items():
        stored = tensors.get(name)
        if stored is None or stored.shape != value.shape or stored.dtype != value.dtype:
            raise reader.broken(f"{what}, {name}", described(stored), described(value))
    more = sorted(tensors.keys() - wanted.keys())
    if more:
        raise reader.broken(
            what, f"{more[0]} besides", f"the tensors {', '.join(wanted)}"[:160]
        )


def described(value: Tensor | None) -> str:
    """Shape and kind of numbers of a tensor, in words."""
    if value is None:
        return "none"
    return f"{tuple(value.shape)} of {str(value.dtype).removeprefix('torch.')}"


def read_line(kind: type[_Line], fields: Fields) -> _Line:
    """A dataclass from the fields that its `asdict` has written."""
    try:
        return decode(kind, fields.values, fields.where)
    except InvalidValueError as error:
        raise fields.error(str(error)) from error
