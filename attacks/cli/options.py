"""What the options of several commands take; light, so that --help is fast."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from mi_splat.cli.flags import Flag, Positional, Unprefixed
from mi_splat.cli.options import CameraOptions, ResultOptions
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Fraction, Metavar, above, at_least, between
from mi_splat.selection.config import Selection

Detectors = Annotated[tuple[str, ...], Metavar("DETECTOR")]
OneDetector = Annotated[str, Flag(name="detectors"), Metavar("DETECTOR")]
"""A detector of a command that takes one; the flag is called as where there may be several."""
ClassName = Annotated[str, Metavar("CLASS")]
Confidence = Annotated[Fraction, Metavar("CONFIDENCE")]
PositiveRadius = Annotated[float, above(0, "units of the splat file", "5 is the paper's"), Metavar("RADIUS")]
Seeds = Annotated[int, at_least(1), Metavar("COUNT")]
Workers = Annotated[int, between(0, 1024, "processes")]
_WORKER = 2e9
"""Bytes of memory that a process takes which trains or attacks."""


def chosen_workers(asked: int | None) -> int:
    """Number of processes that do jobs side by side: one for each core if None and the memory allows."""
    if asked is not None:
        return asked
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, int(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / _WORKER)))


def check_result_folder(folder: Path) -> None:
    """Raise unless a command may have written its result there."""
    if not any(folder.glob("*.json")):
        got = "one without a result" if folder.is_dir() else f"a file; pass {folder.parent}" if folder.is_file() else ""
        expected = "a folder that a command of mi-splat has written"
        raise InvalidValueError.of(str(folder), expected, got or "nothing there", "check the path")


@dataclass(frozen=True, kw_only=True)
class DetectorOptions:
    """The detectors that a command uses."""

    detectors: Detectors = ("fasterrcnn_small",)
    """Names of detectors (see `mi-splat detectors`)."""
    weights: tuple[Path, ...] = ()
    """Files with their weights, as many as there are detectors; none takes the shipped or published ones."""


@dataclass(frozen=True, kw_only=True)
class AttackOptions(DetectorOptions, ResultOptions):
    """What an attack on one object takes, from chosen cameras or from a region; what is written is told by each."""

    scene: Positional[Path]
    """Scene XML made of splats, a splat file, or example:car_street or example:stop_sign."""
    selection: Unprefixed[Selection] = field(default_factory=Selection)
    """The object whose Gaussians are attacked; all others stay as they are. If nothing is said, the part called car."""
    view: Unprefixed[CameraOptions] = field(default_factory=CameraOptions)
    """Where the object is looked at from."""
    objective: Annotated[str, Metavar("relabel|hide|untargeted")] = "relabel"
    """The aim: another class (--target), no detection at all, any but the right class, or that of another package."""
    target: ClassName | None = None
    """Class that the detectors shall see there (relabel); None is person."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where splat and detectors are: on the CPU, or on an NVIDIA GPU, where no two attacks have the same bits."""
    confidence: Confidence | None = None
    """Confidence that counts as success: at least so much of the target class (0.7 if None), or less than it (0.3)."""
