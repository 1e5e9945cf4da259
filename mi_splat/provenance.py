"""Where a result comes from: versions, Mitsuba's variant, the commit of a checkout, and
how images were rendered.
"""

import importlib.metadata
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

_PACKAGES = ("mi-splat", "mitsuba", "drjit", "torch", "torchvision", "numpy", "pillow")

_COMMAND: ContextVar[str | None] = ContextVar("command", default=None)


def origin() -> dict[str, Any]:
    """What every result says of its origin: `command`, `versions`, `variant`, `commit`
    and `torch`.
    """
    made_by = {
        "command": command(),
        "versions": versions(),
        "variant": variant(),
        "commit": commit(),
    }
    return {**made_by, "torch": torch_arithmetic()}


def command() -> str | None:
    """The command line that is running, as a line for a shell; None where no command
    is.
    """
    return _COMMAND.get()


@contextmanager
def running_command(command: Sequence[str]) -> Iterator[None]:
    """Results that are made within name this command line."""
    before = _COMMAND.set(shlex.join(command))
    try:
        yield
    finally:
        _COMMAND.reset(before)


def torch_arithmetic() -> dict[str, Any] | None:
    """What the last bits of torch's sums depend on, besides its version; None where
    torch is not loaded.

    Its convolutions add in an order that depends on the number of threads and on the
    widest instructions of the processor, so that a detector's scores differ by some
    1e-7 between one thread and two. With the same `threads` and `instructions` a result
    has the same bits. Dr.Jit's sums do not depend on its threads.
    """
    torch: Any = sys.modules.get("torch")
    if torch is None:
        return None
    return {
        "threads": torch.get_num_threads(),
        "instructions": torch.backends.cpu.get_cpu_capability(),
    }


def rendered_with(render: object) -> dict[str, Any]:
    """What images depend on besides the splat and the camera, as JSON can hold it."""
    settings: Any = getattr(render, "settings", None)
    if not (hasattr(settings, "background") and hasattr(settings, "near")):
        return {}
    mode = {"antialiased": True} if getattr(settings, "antialiased", False) else {}
    return {
        "background": [float(part) for part in settings.background],
        "near": float(settings.near),
        **mode,
    }


def versions() -> dict[str, str]:
    """Version of Python and of every package that a result depends on; packages that
    are not installed are left out.
    """
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def variant() -> str | None:
    """Mitsuba's variant; None when this process never loaded Mitsuba (the renderer was
    another one).
    """
    mitsuba = sys.modules.get("mitsuba")
    if mitsuba is None:
        return None
    variant: str | None = mitsuba.variant()
    return variant


def commit() -> str | None:
    """The commit of the checkout that holds this file, and `+changes` when tracked
    files differ; None elsewhere.
    """
    here = Path(__file__).resolve()
    # A virtual environment may lie inside some other checkout: only one that tracks
    # this very file counts.
    if _git(here.parent, "ls-files", "--error-unmatch", here.name) is None:
        return None
    return _git(
        here.parent,
        "describe",
        "--always",
        "--abbrev=40",
        "--exclude=*",
        "--dirty=+changes",
    )


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", *arguments],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
