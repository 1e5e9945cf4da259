"""What a kind of file is, and how valid ones come to be."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.campaign.mutations import (
    Document,
    Packing,
)
from tests.project.layers import ROOT

Make = Callable[[Path], Path]
Read = Callable[[Path], object]


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """A kind of file.

    Attributes:
        name: What it is called; the words after the first say which form.
        make: Writes a valid file, with all that belongs to it, into a folder, and
            returns the one to damage.
        read: Reads it as the commands do.
        readers: `module:function` of each public reader, and modules of readers in
            commands, that take part.
        document: Where it has JSON; None if it has none.
        packing: How its contents are packed; None if they are not.
        starts: Whether its reader starts a process.
    """

    name: str
    make: Make
    read: Read
    readers: tuple[str, ...]
    document: Document | None = None
    packing: Packing | None = None
    starts: bool = False


def written(name: str, content: Callable[[], Any]) -> Make:
    def make(folder: Path) -> Path:
        values = content()
        data = values if isinstance(values, bytes) else json.dumps(values).encode()
        (folder / name).write_bytes(data)
        return folder / name

    return make


def copied(*names: str) -> Make:
    def make(folder: Path) -> Path:
        for name in names:
            shutil.copy(ROOT / name, folder)
        return folder / Path(names[0]).name

    return make
