"""Bytes, text, JSON and PNG files that appear whole or not at all, and digests of files."""

import hashlib
import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mi_splat.io.atomic import atomic_write, write_all


def file_name(text: str) -> str:
    """A text, for instance the name of a camera, as a file may be called everywhere."""
    return re.sub(r"[^\w.-]", "_", text)


def save_bytes(data: bytes, path: Path) -> None:
    """Write a file."""
    with atomic_write(path) as file:
        write_all(file, memoryview(data))


def save_text(text: str, path: Path) -> None:
    """Write a text file."""
    save_bytes(text.encode(), path)


def save_json(values: Any, path: Path, *, indent: int | None = 2) -> None:
    """Write a JSON file; without an indent on one line."""
    save_text(json.dumps(values, indent=indent, allow_nan=False) + "\n", path)


def save_png(pixels: NDArray[np.uint8], path: Path) -> None:
    """Write (H, W, 3) or (H, W, 4) pixels as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    save_bytes(buffer.getvalue(), path)


def sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    total = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            total.update(part)
    return total.hexdigest()
