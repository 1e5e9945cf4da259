"""Changes a checkpoint: its tensors and its notes."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

Change = Callable[[dict[str, Any], dict[str, Tensor]], object]
"""Changes notes and tensors in place."""


def changed(path: Path, change: Change) -> None:
    with safe_open(path, framework="pt") as file:
        notes = json.loads(file.metadata()["notes"])
        tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
    change(notes, tensors)
    save_file(
        {name: value.contiguous() for name, value in tensors.items()},
        path,
        {"notes": json.dumps(notes)},
    )
